"""Contact between loads on one track."""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.errors import InputError
from jaxvib.machine.carrier import Machine, Mount
from jaxvib.machine.effects.base import Effect
from jaxvib.machine.effects.terms import Coordinates, LoadInteraction, Term
from jaxvib.machine.loads import CircularLoads, Loads, ball_radius
from jaxvib.machine.numbers import read_numbers, unit
from jaxvib.units import Number
from jaxvib.units.known import when_known


class LoadContact(Effect):
    """Contact forces between loads with a size, while they overlap.

        force between centres = max(0, k (2 r - s) - c s'),    s the distance of the centres

    r is the loads' `ball_radius`.

    - On a circle s = 2 R sin((phi_{j+1} - phi_j) / 2), and loads never pass each other. Load j+1 follows load j, and load 1
      follows the last one a turn later; there are therefore as many pairs as loads. The angles of a start must be in this
      order, within one turn. Starts by name, such as "rest", place the loads side by side
    - Only loads at one station of a rotor can touch. For loads at several stations `prepare` sets the attribute `tracks`, see
      `Tracks`; otherwise it is None
    - If loads have several coordinates, as in a torus, each pair can touch, s = |p(u_i) - p(u_j)|, and no two loads may start
      nearer than 0.9 times 2 r

    Two loads that collide on a track at rest separate at e times the speed at which they approached. The restitution e is

        e = exp(-(pi - 2 beta) tan beta),    sin beta = zeta = c / (2 sqrt(k mu)),    mu = kappa m / (2 (1 - (r/R)^2)),

    if zeta <= 1, otherwise e = exp(-2 gamma coth gamma) with cosh gamma = zeta. The two loads lose the share 1 - e^2 of the
    energy of their relative motion, including that of rolling; friction between loads is neglected. A contact lasts about pi
    sqrt(mu/k). Equal steps must resolve this time, and the time mu/c of the damper if this is shorter: `ensemble` and `sweep`
    take about 12 steps per contact, `capture` about 6 in its first scan and twice as many after each doubling.

    **Arguments** (SI, or strings with a unit)

    - `stiffness` k, N/m, positive; typical: 4e4 to 1e6, softer than steel so that a contact lasts 1 to 10 ms. Choose
      k = mu (pi/t)^2 for a contact that lasts t, such as a tenth of a turn of the rotor: 8e4 for balls of 44 g at 3000 rpm.
      Loads that collide with the speed v overlap by v sqrt(mu/k). Ten times the stiffness needs about three times the steps
    - `damping` c, N s/m, at least 0 (the default); typical: 2 to 200
    - `restitution` e in place of the damping, above 0, up to 1; typical: 0.3 to 0.9

    **Raises** `InputError` for values that are not allowed, and for both damping and restitution. A scene raises it for loads
    without a ball radius, and for loads of unequal mass if there is a restitution.

    >>> import jaxvib as jv
    >>> float(jv.LoadContact(stiffness=1e6).stiffness)
    1000000.0

    Source: a linear spring and a damper between the centres whose force never pulls (Schwager and Poeschel 2007).
    """

    stiffness: Array = eqx.field(metadata=unit("N/m", low=0.0, open_low=True, words="stiffness of contacts between loads"))
    damping: Array = eqx.field(metadata=unit("N s/m", low=0.0, words="damping of contacts between loads"))
    restitution: Array | None = eqx.field(
        metadata=unit("", low=0.0, open_low=True, high=1.0, words="restitution of contacts between loads")
    )
    tracks: Tracks | None
    kind: str = eqx.field(static=True)

    def __init__(self, stiffness: Number, damping: Number = 0.0, restitution: Number | None = None):
        given = {"stiffness": stiffness, "damping": damping, "restitution": restitution}
        self.stiffness, self.damping, self.restitution = read_numbers(LoadContact, "effects.load_contact", **given).values()
        # The constructor is called again with traced values to check the bounds of an existing scene. The value of the damping
        # is then unknown, and was examined before.
        if restitution is not None and when_known(lambda damping: damping == 0.0, self.damping) is False:
            problem = "excludes damping, which it determines; leave one of them out"
            raise InputError("effects.load_contact.restitution", problem)
        self.tracks, self.kind = None, "load_contact"

    def terms(self) -> tuple[Term, ...]:
        """Return the forces between the loads."""
        return (LoadInteraction(self.energy, self.resistance, self.penetrations, self.validate_start),)

    def validate(self, machine: Machine, loads: Loads) -> None:
        """**Raises** `InputError` for `loads` without a size, and for loads of unequal mass with a restitution."""
        ball_radius(loads, "effects.load_contact")
        if self.restitution is not None and jnp.ndim(loads.mass) > 0:
            raise InputError(
                "effects.load_contact.restitution", "needs loads of equal mass; give the damping of the contacts in its place"
            )

    def validate_start(self, loads: Loads, u: Coordinates, stations: np.ndarray | None = None) -> None:
        """**Raises** `InputError` if the `loads` cannot start at the coordinates `u`.

        Loads on a circle must be in order within one turn, separately for each of the `stations` (count,). Other loads must not
        overlap.
        """
        if not loads.circular:
            self._require_distances(loads, u, stations)
            return
        numbers = np.zeros(loads.count) if stations is None else stations
        for station in np.unique(numbers):
            self._require_order(np.asarray(u[0])[..., numbers == station])

    def _require_order(self, phi: np.ndarray) -> None:
        wrong = ~np.all(np.diff(phi, axis=-1) > 0.0, axis=-1) | ~(phi[..., -1] - phi[..., 0] < 2.0 * np.pi)
        if np.any(wrong):
            which = np.round(phi[wrong][0], 4).tolist()
            problem = (
                "loads in contact cannot pass each other: each angle must be larger than the one before, all within one turn"
            )
            raise InputError(
                "start.angle", f"is {which} rad; {problem} (add 2 pi to angles that are one turn behind, or sort them)"
            )

    def _require_distances(self, loads: Loads, u: tuple[Array, ...], stations: np.ndarray | None) -> None:
        place = loads.position(*u) if np.ndim(u[0]) == 1 else jax.vmap(lambda each, v: each.position(*v))(loads, u)
        points = np.stack([np.asarray(x) for x in place], axis=-1).reshape(-1, loads.count, len(place))
        diameter = 2.0 * np.asarray(ball_radius(loads)).reshape(-1, 1, 1)
        distance = np.linalg.norm(points[:, :, None] - points[:, None], axis=-1) / diameter
        cannot_touch = np.eye(loads.count, dtype=bool) | (False if stations is None else stations[:, None] != stations)
        distance = np.where(cannot_touch, np.inf, distance)
        if np.min(distance) < MIN_DISTANCE:
            run, i, j = np.unravel_index(np.argmin(distance), distance.shape)
            size = float(np.broadcast_to(diameter, (distance.shape[0], 1, 1))[run, 0, 0])
            problem = f"puts loads {i + 1} and {j + 1} inside each other, {round(distance[run, i, j], 6) * size:.4g} m apart"
            raise InputError("start.angle", f"{problem}; start them {size:.4g} m apart, their diameter")

    def fastest_rate(self, loads: Loads, speed: Array) -> Array:
        """Return the natural frequency sqrt(k / mu) of a contact, rad/s, or its decay rate c / mu, 1/s, if this is larger;
        typical: 300 to 5000."""
        mass = self._reduced_mass(loads)
        return jnp.maximum(jnp.sqrt(self.stiffness / mass), self._damping(loads) / mass)

    def prepare(self, loads: Loads, mount: Mount) -> LoadContact:
        """Return the contact with the damping that gives its restitution, and with the tracks of the loads."""
        tracks = None if mount.at_one_point else Tracks.of(mount.distances(loads.count))
        return eqx.tree_at(
            lambda c: (c.damping, c.restitution, c.tracks),
            self,
            (self._damping(loads), None, tracks),
            is_leaf=lambda leaf: leaf is None,
        )

    def energy(self, loads: Loads, u: Coordinates) -> Array:
        """Return k (2 r - s)^2 / 2, (count,) J, of the pairs of `loads` that overlap at the coordinates `u`."""
        parts = [0.5 * self.stiffness * jnp.maximum(-gap, 0.0) ** 2 for gap in _clearances(loads, u, self.tracks)]
        if parts[-1].shape != (loads.count,):  # with an even count there are only half as many pairs of opposite loads
            parts[-1] = jnp.concatenate([parts[-1], jnp.zeros_like(parts[-1])])
        return sum(parts[1:], parts[0])

    def penetrations(self, loads: Loads, u: Coordinates) -> Array:
        """Return the penetrations of the pairs of `loads` at the coordinates `u`, m, negative without contact."""
        return -jnp.concatenate(_clearances(loads, u, self.tracks))

    def resistance(self, loads: Loads, u: Coordinates, rate: Coordinates) -> Coordinates:
        """Return the generalized forces of the damping forces -c s' between `loads` that overlap, (count,) each.

        They are limited so that a contact never pulls. **Arguments**: coordinates `u` and their rates `rate`.
        """
        damping = self._damping(loads)

        def gaps(*v: Array) -> tuple[Array, ...]:
            return tuple(_clearances(loads, v, self.tracks))

        clearances, back = jax.vjp(gaps, *u)
        _, opening_speeds = jax.jvp(gaps, u, rate)
        return back(
            tuple(
                jnp.where(gap < 0.0, jnp.maximum(-damping * opening, self.stiffness * gap), 0.0)
                for gap, opening in zip(clearances, opening_speeds, strict=True)
            )
        )

    def _damping(self, loads: Loads) -> Array:
        """Return c. If the restitution is set, c follows from it."""
        if self.restitution is None:
            return self.damping
        return 2.0 * damping_ratio(self.restitution) * jnp.sqrt(self.stiffness * self._reduced_mass(loads))

    def _reduced_mass(self, loads: Loads) -> Array:
        """Return mu; if the loads differ, its value for the lightest loads."""
        return 0.5 * loads.inertia_factor() * jnp.min(loads.mass) / (1.0 - (ball_radius(loads) / loads.arm()[0]) ** 2)


MIN_DISTANCE = 0.9
"""Smallest distance between loads that are not inside each other, in diameters.

It is below 1 because a run may start from a state of another run in which loads press on each other.
"""


def damping_ratio(restitution: Array) -> Array:
    """Return zeta = c / (2 sqrt(k mu)) of a spring and damper that never pull, from the `restitution`.

    >>> import jax.numpy as jnp
    >>> [round(float(damping_ratio(jnp.asarray(e))), 6) for e in (0.9, 0.5, 0.1)]
    [0.034265, 0.255276, 1.243188]
    """
    exponent = -jnp.log(restitution)
    # Newton's method from a fit that is exact at both ends and accurate to 2 % between them.
    ratio = jnp.where(
        exponent < 2.0, exponent / jnp.sqrt(jnp.pi**2 + exponent * (exponent - 4.93)), jnp.cosh(0.5 * (exponent - 2.0))
    )
    for _ in range(_NEWTON_STEPS):
        loss, slope = jax.jvp(_loss, (ratio,), (jnp.ones_like(ratio),))
        ratio = ratio + (exponent - loss) / slope
    return ratio


_NEWTON_STEPS = 5


def _loss(ratio: Array) -> Array:
    """Return -log e of a damping `ratio` zeta, see `LoadContact`."""
    near = ratio - 1.0
    middle = jnp.abs(near) < 1e-3
    under, over = jnp.where(ratio < 0.999, ratio, 0.5), jnp.where(ratio > 1.001, ratio, 2.0)
    below = 2.0 * jnp.arccos(under) * under / jnp.sqrt(1.0 - under**2)
    above = 2.0 * jnp.arccosh(over) * over / jnp.sqrt(over**2 - 1.0)
    series = 2.0 + near * (4.0 / 3.0 - near * (2.0 / 5.0 - near * 16.0 / 105.0))
    return jnp.where(middle, series, jnp.where(near < 0.0, below, above))


class Tracks(NamedTuple):
    """Tracks of loads at `stations`, m. `follower`: index of the next load on the track; `turns`: 1 if it is a turn later."""

    stations: Array
    follower: Array
    turns: Array

    @staticmethod
    def of(stations: Array) -> Tracks:
        """Return the tracks of loads at `stations`.

        >>> import jax.numpy as jnp
        >>> tracks = Tracks.of(jnp.asarray([0.2, -0.2, 0.2, 0.2]))
        >>> tracks.follower.tolist(), tracks.turns.tolist()
        ([2, 1, 3, 0], [0, 1, 0, 1])
        """
        n = stations.shape[0]
        ahead = np.mod(np.arange(n)[None, :] - np.arange(n)[:, None] - 1, n) + 1
        nearest = jnp.min(jnp.where(stations[:, None] == stations[None, :], ahead, n), axis=1)
        after = jnp.arange(n) + nearest
        return Tracks(stations, after % n, after // n)


def _clearances(loads: Loads, u: tuple[Array, ...], tracks: Tracks | None) -> list[Array]:
    """Return the distances, negative for an overlap, of each load to the k-th load after it; each pair occurs once. On a circle
    there is only k = 1, the next load on the same track."""
    r = ball_radius(loads)
    if isinstance(loads, CircularLoads):
        (phi,) = u
        if tracks is None:
            ahead = jnp.concatenate([phi[1:], phi[:1] + 2.0 * jnp.pi])
        else:
            ahead = phi[tracks.follower] + 2.0 * jnp.pi * tracks.turns
        return [2.0 * loads.radius * jnp.sin(0.5 * jnp.clip(ahead - phi, -jnp.pi, jnp.pi)) - 2.0 * r]
    n, place = loads.count, loads.position(*u)
    clearances = []
    for k in range(1, n // 2 + 1):
        pairs = n // 2 if 2 * k == n else n
        square = sum((jnp.concatenate([x[k:], x[:k]])[:pairs] - x[:pairs]) ** 2 for x in place)
        coincident = square == 0.0
        distance = jnp.where(coincident, 0.0, jnp.sqrt(jnp.where(coincident, 1.0, square)))
        if tracks is not None:
            on_one_track = jnp.roll(tracks.stations, -k)[:pairs] == tracks.stations[:pairs]
            distance = jnp.where(on_one_track, distance, jnp.inf)
        clearances.append(distance - 2.0 * r)
    return clearances or [jnp.ones_like(u[0])]
