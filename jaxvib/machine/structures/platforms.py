"""Machines of vertically moving platforms: one, two, three masses, or a network."""

from __future__ import annotations

import functools
from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.boundary import with_known_names
from jaxvib.errors import InputError, counted, quoted
from jaxvib.machine.carrier import Carrier, Machine, Mount, Place, read_number_of_place
from jaxvib.machine.numbers import read_numbers, unit
from jaxvib.machine.structures.damping import damping_constants
from jaxvib.units import Number, Numbers, count


class Platforms(Machine):
    """Platforms that translate vertically, on supports and with links between them.

        M_i y_i'' + b_i y_i' + k_i y_i + sum_j [b_ij (y_i' - y_j') + k_ij (y_i - y_j)] = force of the exciters on platform i

    y_i is the upward displacement from static equilibrium, m. Constructors: `one_mass`, `two_mass`, `three_mass`, `network`.

    **Attributes** (n platforms, L links); typical values: see `two_mass`

    - `mass` (n,), kg, of the platforms; the exciter's platform includes the exciter without its loads
    - `stiffness` (n,), N/m, and `damping` (n,), N s/m, of the supports
    - `link_stiffness` (L,), N/m, and `link_damping` (L,), N s/m
    - `links`: the pair of platforms that each link joins, numbered from 1
    - `exciter`: the number of the platform that carries the exciter, unless `Exciter(at=)` names another one

    Source: Filimonikhin et al. 2022, equations (1)-(39) for one, two and three masses.
    """

    mass: Array = eqx.field(metadata=unit("kg", low=0.0, open_low=True, each="platform"))
    stiffness: Array = eqx.field(metadata=unit("N/m", low=0.0, each="support"))
    damping: Array = eqx.field(metadata=unit("N s/m", low=0.0, each="support"))
    link_stiffness: Array = eqx.field(metadata=unit("N/m", low=0.0, words="stiffness", each="link"))
    link_damping: Array = eqx.field(metadata=unit("N s/m", low=0.0, words="damping", each="link"))
    links: tuple[tuple[int, int], ...] = eqx.field(static=True)
    exciter: int = eqx.field(static=True)
    kind: str = eqx.field(static=True)
    places = "platform"

    def carrier(self) -> Carrier:
        """Return the matrices of the platforms."""
        n = self.mass.shape[0]
        # A row for each support, whose other end is the foundation, and for each link.
        ends = np.concatenate([np.eye(n), np.zeros((len(self.links), n))]).astype(self.mass.dtype)
        for row, (i, j) in enumerate(self.links, n):
            ends[row, i - 1], ends[row, j - 1] = 1.0, -1.0

        def assembled(support: Array, link: Array) -> Array:
            return (jnp.concatenate([support, link])[None] * ends.T) @ ends

        return Carrier(
            mass=self.mass[None] * np.eye(n, dtype=self.mass.dtype),
            damping=assembled(self.damping, self.link_damping),
            stiffness=assembled(self.stiffness, self.link_stiffness),
            foundation_stiffness=self.stiffness[None, :],
            foundation_damping=self.damping[None, :],
            coordinates=tuple(f"y{i + 1}" for i in range(n)),
        )

    def mount(self, at: Place = None) -> Mount:
        """Return the mount on the platform with the number `at`, which moves vertically; None is the platform `exciter`."""
        return Mount(rows=(self.rows_at(self.exciter if at is None else at, "at"),), axes=(1,))

    def support_rows(self) -> tuple[Array, Array]:
        """Return the rows of the support of each platform."""
        return jnp.diag(self.stiffness)[:, None], jnp.diag(self.damping)[:, None]

    def upward(self) -> np.ndarray:
        """Return a translation of all platforms."""
        return np.ones(self.mass.shape[0])

    def rows_at(self, place: Place, name: str = "place") -> Array:
        """Return the row of a platform's coordinate; None is the first platform."""
        n = self.mass.shape[0]
        which = read_number_of_place(place, f"the machine has platforms 1 to {n}", n, name)
        return jnp.asarray(np.eye(n)[which - 1 : which], dtype=self.mass.dtype)


def _platforms(
    kind: str,
    n: int,
    mass: Numbers,
    stiffness: Numbers,
    damping: Numbers,
    links: Sequence[Sequence[int]],
    link_stiffness: Numbers,
    link_damping: Numbers,
    exciter: int,
) -> Platforms:
    joined = _links(links, n)
    which = count(exciter, "machine.exciter")
    if which > n:
        raise InputError("machine.exciter", f"is {which}; the machine has platforms 1 to {n}")

    read = functools.partial(read_numbers, Platforms, "machine")
    found = read(n, mass=mass, stiffness=stiffness)
    found |= read(n, damping=damping_constants(damping, "machine.damping", found["stiffness"], lambda: found["mass"]))
    of_links = {"link_stiffness": link_stiffness, "link_damping": link_damping}
    for name, value in of_links.items():
        given = len(value) if isinstance(value, (list, tuple)) else getattr(value, "size", 1)
        if not joined and given > 0:
            problem = f"has {counted(given)}, but the machine has no links; leave it out or give links"
            raise InputError(f"machine.{name}", problem)
    if joined:
        found |= read(len(joined), link_stiffness=link_stiffness)

        def joined_mass() -> Array:
            one, other = (found["mass"][np.asarray(joined)[:, end] - 1] for end in (0, 1))
            return one * other / (one + other)

        constants = damping_constants(link_damping, "machine.link_damping", found["link_stiffness"], joined_mass)
        found |= read(len(joined), link_damping=constants)
    else:
        found |= dict.fromkeys(of_links, jnp.asarray(np.zeros(0), dtype=float))
    return Platforms(**found, links=joined, exciter=which, kind=kind)


def _links(links: Sequence[Sequence[int]], n: int) -> tuple[tuple[int, int], ...]:
    if not isinstance(links, (list, tuple)):
        raise InputError("machine.links", f"is {quoted(links)}; it must be a list of pairs of platforms such as [[1, 2]]")
    joined = []
    for index, link in enumerate(links):
        field = f"machine.links[{index}]"
        if not isinstance(link, (list, tuple)) or len(link) != 2:
            raise InputError(field, f"is {quoted(link)}; a link is a pair of platforms such as [1, 2]")
        i, j = (count(end, field) for end in link)
        if i == j or max(i, j) > n:
            raise InputError(field, f"is [{i}, {j}]; a link joins two different platforms of 1 to {n}")
        joined.append((i, j))
    return tuple(joined)


@with_known_names
def one_mass(*, mass: Number, stiffness: Number, damping: Number) -> Platforms:
    """Return one platform on a support, with the exciter.

        M y'' + b y' + k y = force of the loads

    **Arguments** (one number each, SI, or a string with a unit such as "40 N/mm")

    - `mass` M, kg, loads not included; typical: 50 to 5000
    - `stiffness` k of the support, N/m; typical: 1e4 to 1e6. Also a static deflection with the mass or force that causes it,
      "25 mm under 650 kg"
    - `damping` b of the support, N s/m; typical: 20 to 7000, which is 0.01 to 0.05 of the critical damping 2 sqrt(k M). Also
      a ratio to the critical damping, "5 %", or a loss factor of rubber at a frequency of vibration, "loss factor 0.1 at 16
      Hz": b = 0.1 k/omega

    **Returns** `Platforms`. **Raises** `InputError` for a mass that is not positive or a negative coefficient.

    >>> import jaxvib as jv
    >>> jv.one_mass(mass=50.0, stiffness="40 N/mm", damping=30.0).stiffness.tolist()
    [40000.0]

    Source: Filimonikhin et al. 2022, equation (9).
    """
    return _platforms("one_mass", 1, mass, stiffness, damping, (), (), (), 1)


@with_known_names
def two_mass(
    *,
    mass: Sequence[Number],
    stiffness: Sequence[Number],
    damping: Sequence[Number],
    link_stiffness: Number,
    link_damping: Number,
    exciter: int = 2,
) -> Platforms:
    """Return two platforms on supports, joined by a link.

        M_1 y_1'' + b_1 y_1' + k_1 y_1 + b_12 (y_1' - y_2') + k_12 (y_1 - y_2) = 0
        M_2 y_2'' + b_2 y_2' + k_2 y_2 - b_12 (y_1' - y_2') - k_12 (y_1 - y_2) = force of the loads, if they are on platform 2

    **Arguments** (SI, or strings with a unit)

    - `mass` (2,) of the platforms, kg, loads not included; typical: 50 to 5000
    - `stiffness` (2,) of the supports, N/m; typical: 1e4 to 1e6, 0 without a support
    - `damping` (2,) of the supports, N s/m; typical: 20 to 7000, which is 0.01 to 0.05 of the critical damping 2 sqrt(k M) of
      the platform on its support alone. Also a ratio to the critical damping, "5 %", or a loss factor, see `one_mass`
    - `link_stiffness` of the link, N/m; typical: 5e4 to 5e6, that is 1 to 10 times that of a support
    - `link_damping` of the link, N s/m; typical: as `damping`. A ratio is relative to the two platforms on the link alone, that
      is to the mass M_1 M_2/(M_1 + M_2)
    - `exciter`: the number of the platform with the exciter, 1 or 2 (default: 2)

    **Returns** `Platforms`. **Raises** `InputError` for wrong lengths, wrong units, masses that are not positive, or negative
    coefficients.

    >>> import jaxvib as jv
    >>> machine = jv.two_mass(mass=(120.0, 95.0), stiffness=(5e4, 5e4), damping=(40.0, 40.0),
    ...                       link_stiffness=2e5, link_damping=60.0)
    >>> machine.carrier().stiffness.tolist()
    [[250000.0, -200000.0], [-200000.0, 250000.0]]

    Source: the antiphase paper, equation (2); Filimonikhin et al. 2022, equation (20).
    """
    return _platforms("two_mass", 2, mass, stiffness, damping, ((1, 2),), link_stiffness, link_damping, exciter)


@with_known_names
def three_mass(
    *,
    mass: Sequence[Number],
    stiffness: Sequence[Number],
    damping: Sequence[Number],
    link_stiffness: Sequence[Number],
    link_damping: Sequence[Number],
    exciter: int = 2,
) -> Platforms:
    """Return three platforms on supports, with a link between each two of them.

        M_i y_i'' + b_i y_i' + k_i y_i + sum_j [ b_ij (y_i' - y_j') + k_ij (y_i - y_j) ] = force of the loads on platform i

    **Arguments** (SI, or strings with a unit)

    - `mass` (3,) of the platforms, kg, loads not included; typical: 50 to 5000
    - `stiffness` (3,) of the supports, N/m; typical: 1e4 to 1e6, 0 without a support
    - `damping` (3,) of the supports, N s/m; typical: 20 to 7000, which is 0.01 to 0.05 of the critical damping 2 sqrt(k M)
    - `link_stiffness` (3,) of the links 1-2, 1-3, 2-3, N/m; typical: 5e4 to 5e6, 0 for an absent link
    - `link_damping` (3,) of these links, N s/m; typical: as `damping`
    - `exciter`: the number of the platform with the exciter, 1 to 3 (default: 2)

    **Returns** `Platforms`. **Raises** `InputError` in the cases of `two_mass`.

    >>> import jaxvib as jv
    >>> jv.three_mass(mass=(10.0, 20.0, 10.0), stiffness=(0.0, 4e4, 0.0), damping=(0.0, 20.0, 0.0),
    ...               link_stiffness=(1e4, 0.0, 1e4), link_damping=(5.0, 0.0, 5.0), exciter=3).links
    ((1, 2), (1, 3), (2, 3))

    Source: Filimonikhin et al. 2022, equation (39), with the misprint for the third platform corrected.
    """
    links = ((1, 2), (1, 3), (2, 3))
    return _platforms("three_mass", 3, mass, stiffness, damping, links, link_stiffness, link_damping, exciter)


@with_known_names
def network(
    *,
    mass: Sequence[Number],
    stiffness: Sequence[Number],
    damping: Sequence[Number],
    links: Sequence[Sequence[int]] = (),
    link_stiffness: Sequence[Number] = (),
    link_damping: Sequence[Number] = (),
    exciter: int,
) -> Platforms:
    """Return a machine of any number of platforms, supports and links.

        M_i y_i'' + b_i y_i' + k_i y_i + sum_j [ b_ij (y_i' - y_j') + k_ij (y_i - y_j) ] = force of the loads on platform i

    **Arguments** (n platforms, L links; SI or texts with a unit)

    - `mass` (n,) of the platforms, kg, loads not included; typical: 50 to 5000
    - `stiffness` (n,) of the supports, N/m; typical: 1e4 to 1e6, 0 for a platform without a support
    - `damping` (n,) of the supports, N s/m; typical: 20 to 7000, which is 0.01 to 0.05 of the critical damping 2 sqrt(k M); 0
      for a platform without a support
    - `links`: L pairs of platforms, numbered from 1
    - `link_stiffness` (L,) of the links, N/m; typical: 5e4 to 5e6
    - `link_damping` (L,) of the links, N s/m; typical: as `damping`
    - `exciter`: the number of the platform with the exciter

    **Returns** `Platforms`. **Raises** `InputError` in the cases of `two_mass`, and for a link to a platform that does not
    exist.

    >>> import jaxvib as jv
    >>> chain = jv.network(mass=[5.0] * 4, stiffness=[1e4, 0, 0, 1e4], damping=[5, 0, 0, 5], links=[(1, 2), (2, 3), (3, 4)],
    ...                    link_stiffness=[2e4] * 3, link_damping=[4.0] * 3, exciter=4)
    >>> chain.carrier().mass.shape
    (4, 4)

    Source: Filimonikhin et al. 2022, equations (1)-(39) for one to three platforms, extended to any number.
    """
    masses = read_numbers(Platforms, "machine", mass=mass)["mass"]
    n = 1 if masses.ndim == 0 else masses.shape[0]
    return _platforms("network", n, masses, stiffness, damping, links, link_stiffness, link_damping, exciter)
