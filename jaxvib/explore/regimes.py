"""Synchronous regimes of exciters with unbalances, or with loads that stay together: chart over the speed of the drives, and
text."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.display import quantity_text, speed_unit
from jaxvib.draw.charts import log_limits, scaled_amplitudes, segments
from jaxvib.draw.machine.svg import svg
from jaxvib.draw.style import COLORS, GUIDE
from jaxvib.equations.linear import natural_frequencies
from jaxvib.equations.torque_balance import mass_owners
from jaxvib.errors import InputError
from jaxvib.explore.latest import keep_latest
from jaxvib.explore.panel import LEFT_MARGIN, PANEL_GAP, PANEL_HEIGHT, PANEL_WIDTH, RIGHT_MARGIN, ROTOR, WORKING, Panel, legend
from jaxvib.machine.scene import Scene
from jaxvib.runtime.programs import cached
from jaxvib.steady.regimes.collected import collected_regimes, follow_regimes
from jaxvib.steady.regimes.synchronous import SynchronousRegime, SynchronousRegimes, synchronous_regimes
from jaxvib.steady.regimes.working import working_regime

_SPEED_COUNTS = {1: 61, 2: 61, 3: 25}
"""Number of speeds of the chart for each number of exciters; the time for one speed grows steeply with the number."""

_MAX_WITHOUT_LOADS, _MAX_WITH_LOADS = 2, 4
"""Largest numbers of exciters for which all regimes are searched for: without loads, and if at least one exciter has loads. For
more exciters the search takes too long."""

_MAX_SHOWN_REGIMES = 12
"""Largest number of regimes in the list."""

_MAX_FOLLOWED = 4
"""Number of regimes of loads in the chart."""

_LINE = {"lw": 1.5}
_UNSTABLE = {"lw": 1.2, "ls": "--"}
_RESONANCE = {"color": GUIDE, "lw": 0.8, "ls": ":"}
_LEGEND = {"regime": {**_LINE, "color": "black"}, "resonance": _RESONANCE, "working speed": WORKING, "motor speed": ROTOR}
"""Styles of the lines in the legend, by their names."""


class _Curves(NamedTuple):
    """Regimes at n speeds of the drives, one or several curves; values between two curves are NaN.

    **Attributes**: `drive_speed` (n,) and `speed` (n,) of the rotors or loads, rad/s; `phases` (n, mass), rad; `amplitude`
    (n, nd), m or rad; `force` (n,) on the foundation, N; `stable` (n,).
    """

    drive_speed: Array | np.ndarray
    speed: Array | np.ndarray
    phases: Array | np.ndarray
    amplitude: Array | np.ndarray
    force: Array | np.ndarray
    stable: Array | np.ndarray


def regime_chart(scene: Scene, max_speed: float) -> str:
    """Draw the working regime over the speed of the motors: rotor speed, amplitudes, and phases or foundation force.

    For exciters with loads, draw the first regimes of `regimes_of` from the working speed until each of them ends; unstable
    parts are dashed.

    The speeds of all drives are multiplied by one factor. The horizontal axis shows the highest of these speeds, without load.
    A line has a gap if there is no stable regime. The third panel shows the phases of the exciters relative to the first one,
    or the foundation force if there is one exciter.

    **Arguments**: `max_speed`: the highest motor speed in the diagram, rad/s.

    **Returns** the text of an SVG file. **Raises** `InputError` for more than three exciters without loads, for more than four
    exciters of which one has loads, and for a scene without averaged regimes; the message names the part of the scene that
    prevents them.

    >>> import jax; jax.config.update("jax_enable_x64", True)
    >>> import jaxvib as jv
    >>> from jaxvib.machine.files import SCREENS
    >>> "phase, deg" in regime_chart(jv.scene_from_toml(SCREENS["linear_screen"]), max_speed=140.0)
    True
    """
    count = len(scene.exciters)
    if not scene.has_loads and count not in _SPEED_COUNTS:
        problem = f"are {count}; the chart over the motor speed is drawn for at most {max(_SPEED_COUNTS)}"
        raise InputError("exciters", f"{problem}, because it takes too long for more; use jaxvib sweep")
    for k, exciter in enumerate(scene.exciters):
        if "speed" not in exciter.drive.__dataclass_fields__:
            problem = (
                f"is {exciter.drive.kind!r}, whose speed follows from other numbers; the chart needs a drive with speed=..."
            )
            raise InputError(f"{scene.prefix_of(k)}drive", f"{problem}, such as InductionMotor")
    scale, at = speed_unit("rpm")[1], float(scene.top_speed)
    curves = _curves(scene, max_speed)
    resonances = np.asarray(natural_frequencies(scene))
    high = scale * max_speed
    parts, texts = [], []
    panels = _panels(scene, curves, resonances, high)
    for panel, drawn in panels:
        parts += [*panel.frame(), panel.line([scale * at] * 2, panel.y, WORKING)]
        texts += panel.texts()
        parts += [
            panel.line(scale * curves.drive_speed[along], values[along], {**(_LINE if solid else _UNSTABLE), "color": color})
            for values, color in zip(drawn.values(), COLORS, strict=False)
            for along, solid in segments(np.asarray(curves.stable))
            if np.any(np.isfinite(values[along]))
        ]
    speeds = panels[0][0]
    parts += [speeds.line([0.0, high], [scale * w] * 2, _RESONANCE) for w in resonances.tolist() if w <= max_speed]
    parts.append(speeds.line([0.0, high], [0.0, high], ROTOR))
    names = [
        {name: {**_LINE, "color": color} for name, color in zip(drawn, COLORS, strict=False) if name} for _, drawn in panels[1:]
    ]
    unstable = {} if np.all(curves.stable) else {"unstable": {**_UNSTABLE, "color": "black"}}
    keys, words = legend([{**_LEGEND, **unstable}, *names])
    width = LEFT_MARGIN + 3.0 * PANEL_WIDTH + 2.0 * PANEL_GAP + RIGHT_MARGIN
    return svg((0.0, width, -0.95, PANEL_HEIGHT + 1.1), [[*parts, *keys]], [[*texts, *words]], "", 1.0, 0.0)


def _curves(scene: Scene, max_speed: float) -> _Curves:
    """Return the curves of the chart: the working regime of unbalances, or the first regimes of loads, which are followed."""
    at = float(scene.top_speed)
    if not scene.has_loads:
        count = _SPEED_COUNTS[len(scene.exciters)]
        motor_speed = max_speed * np.arange(1, count + 1) / count
        return jax.device_get(_working_regimes(scene, jnp.asarray(motor_speed / at)))
    regimes = regimes_of(scene)[:_MAX_FOLLOWED]
    if not regimes:
        masses, nd = mass_owners(scene).size, len(scene.machine.structure().coordinates)
        empty = np.zeros(1)
        return _Curves(empty, empty, np.zeros((1, masses)), np.zeros((1, nd)), empty, np.ones(1, bool))
    # Missing regimes are copies of the first one, so that one program is sufficient.
    chosen = [*regimes, *[regimes[0]] * (_MAX_FOLLOWED - len(regimes))]
    speed, phases = (np.stack([np.asarray(getattr(each, name)) for each in chosen]) for name in ("speed", "phases"))
    followed = jax.device_get(follow_regimes(scene, speed, phases, np.asarray(1.0 / 64.0), np.asarray(max_speed / at)))
    pieces = [_Curves(at * followed.factor, *(np.asarray(field)[k] for field in followed[1:])) for k in range(len(regimes))]
    gap = _Curves(*(np.full_like(field[:1], True if field.dtype == bool else np.nan) for field in pieces[0]))
    joined = [each for piece in pieces for each in (piece, gap)]
    return _Curves(*(np.concatenate(fields) for fields in zip(*joined, strict=True)))


def _panels(scene: Scene, curves: _Curves, resonances: np.ndarray, high: float) -> list[tuple[Panel, dict[str, np.ndarray]]]:
    """Return the three panels with their curves by name; `high` is the end of the horizontal axis, rpm."""
    structure = scene.machine.structure()
    rotor_speed, amplitude, foundation_force = map(np.asarray, (curves.speed, curves.amplitude, curves.force))
    units, amplitudes = scaled_amplitudes(amplitude, structure.coordinates, structure.units)
    moving = dict(amplitudes)
    if len(moving) > len(COLORS):
        moving = {f"largest of {len(moving)}": np.max([*moving.values()], axis=0)}
    force = {"": foundation_force}
    titles = f"amplitude, {', '.join(dict.fromkeys(units))}, zero to peak", "foundation force, N, zero to peak"

    def logarithmic(k: int, title: str, drawn: dict[str, np.ndarray]) -> tuple[Panel, dict[str, np.ndarray]]:
        limits = log_limits([*drawn.values()], np.asarray(curves.drive_speed), rotor_speed, resonances)
        return _panel(k, title, high, limits, log=True), drawn

    speed = speed_unit("rpm")[1] * rotor_speed
    turning = "load speed, rpm" if scene.has_loads else "rotor speed, rpm"
    found = [(_panel(0, turning, high, (0.0, 1.06 * high)), {"": speed}), logarithmic(1, titles[0], moving)]
    if len(scene.exciters) == 1:
        return [*found, logarithmic(2, titles[1], force)]
    angles = np.rad2deg(np.asarray(curves.phases))
    first = np.unique(mass_owners(scene), return_index=True)[1]
    phases = {f"exciter {k + 1}": _with_gaps(angles[:, first[k]]) for k in range(1, len(scene.exciters))}
    return [*found, (_panel(2, "phase, deg, relative to exciter 1", high, (-185.0, 185.0)), phases)]


def _panel(k: int, title: str, high: float, limits: tuple[float, float], log: bool = False) -> Panel:
    below = "speed of the motors without load, rpm"
    return Panel(LEFT_MARGIN + k * (PANEL_WIDTH + PANEL_GAP), title, (0.0, high), limits, log=log, below=below)


def _with_gaps(phase: np.ndarray) -> np.ndarray:
    """Return phases, deg, with a gap (NaN) at the first point after a jump from 180 to -180 degrees or back."""
    return np.where(np.abs(np.diff(phase, prepend=phase[0])) > 180.0, np.nan, phase)


@cached
def _working_regimes(scene: Scene, factors: Array) -> _Curves:
    def at(factor: Array) -> _Curves:
        speeds = [factor * exciter.drive.speed for exciter in scene.exciters]
        changed = eqx.tree_at(lambda each: [exciter.drive.speed for exciter in each.exciters], scene, speeds)
        regime = working_regime(changed, throw=False)
        drawn = regime.speed, regime.phases, regime.amplitude, regime.foundation_force
        return _Curves(factor * scene.top_speed, *drawn, jnp.asarray(True))

    return jax.vmap(at)(factors)


@keep_latest
def _search(scene: Scene) -> SynchronousRegimes:
    """Return all regimes of a scene with few exciters, in which the loads of each exciter stay together. **Raises**
    `InputError` for more than `_MAX_WITH_LOADS` exciters of which one has loads."""
    if not scene.has_loads:
        return jax.device_get(synchronous_regimes(scene))
    if len(scene.exciters) > _MAX_WITH_LOADS:
        problem = f"are {len(scene.exciters)}; regimes of loads are listed for at most {_MAX_WITH_LOADS} exciters, because the"
        raise InputError("exciters", f"{problem} search takes too long for more; use jaxvib regimes")
    return jax.device_get(collected_regimes(scene))


def _has_list(scene: Scene) -> bool:
    """Return True if the page shows all regimes, False if it shows the working regime alone."""
    return scene.has_loads or len(scene.exciters) <= _MAX_WITHOUT_LOADS


@keep_latest
def regimes_of(scene: Scene) -> list[SynchronousRegime]:
    """Return the regimes that the page lists, the stable ones first; an empty list if there is no regime.

    For one or two exciters, and for exciters with loads, these are the first 12 of all regimes in which the loads of each
    exciter stay together. For three or more exciters without loads it is the working regime alone.

    **Raises** `InputError` for more than four exciters of which one has loads.
    """
    if not _has_list(scene):
        regime = jax.device_get(working_regime(scene, throw=False))
        return [regime] if np.isfinite(regime.speed) else []
    found = _search(scene)
    return [found.select(k) for k in range(min(found.speed.shape[0], _MAX_SHOWN_REGIMES))]


def deck_points(scene: Scene) -> list[tuple[float, float]]:
    """Return three points of the first body in a plane at the height of its centre of mass: at both ends and at the centre.

    The ends are those of the range of its supports and exciters. The list is empty for other machines.
    """
    if scene.machine.places != "plane":
        return []
    supports = [float(each.at[0]) for each in getattr(scene.machine, "supports") if each.body == 0]  # noqa: B009
    axes = [float(each.position[0]) for each in scene.exciters if each.position is not None and each.body == 0]
    ends = min([*supports, *axes, 0.0]), max([*supports, *axes, 0.0])
    return [(x, 0.0) for x in sorted({*ends, 0.0})]


def regime_readings(scene: Scene) -> str:
    """Return the regimes as text: speed, stability, margin and phases of each; force, power, and the motion of `deck_points`
    for the first one.

    >>> import jax; jax.config.update("jax_enable_x64", True)
    >>> import jaxvib as jv
    >>> from jaxvib.machine.files import SCREENS
    >>> print(regime_readings(jv.scene_from_toml(SCREENS["circular_screen"])).splitlines()[0][:25])
    Omega 896.083 rpm, stable
    """
    regimes = regimes_of(scene)
    if not regimes:
        advice = "the exciters turn at different speeds, or a resonance catches them; jaxvib run-up shows the motion from rest"
        return f"no regime: {advice}" if _has_list(scene) else f"no stable synchronous regime: {advice}"
    first, points = regimes[0], deck_points(scene)
    lines = [_with_one_phase_each(scene, each).summary() for each in regimes]
    if not _has_list(scene):
        lines.append("jaxvib regimes lists all regimes")
    elif (others := _search(scene).stable[len(regimes) :]).size:
        lines.append(f"and {others.size} more regimes, {np.sum(others) or 'none'} of them stable")
    lines.append("motion in the first regime:" if len(regimes) > 1 else "motion in this regime:")
    force = f"foundation force {quantity_text(first.foundation_force, 'N', 4)}"
    lines.append(f"{force}, power of the drives {quantity_text(first.power, 'W', 4)}")
    return "\n".join([*lines, *([first.deck(points).summary()] if points else [])])


def _with_one_phase_each(scene: Scene, regime: SynchronousRegime) -> SynchronousRegime:
    """Return the regime with one phase for each exciter if all of its loads have this phase, otherwise unchanged."""
    owners = mass_owners(scene)
    first = np.unique(owners, return_index=True)[1]
    if not np.array_equal(regime.phases, regime.phases[first][owners]):
        return regime
    return dataclasses.replace(regime, phases=regime.phases[first], masses=regime.masses[first])
