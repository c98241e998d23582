"""Hard cases of numbers: loads heavy and light, one and a thousand, drag none and huge, a micromachine and a quarry screen."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from hard_cases.case import Answer, Case, Reference
from hard_cases.reference_integration import run_out
from hard_cases.reference_model import light_modes, light_speed, platforms, reference_model
from hard_cases.shared import away, compared_state, final_state, jam_case, published, run_case
from jaxvib.machine.drives.drive import ConstantSpeed
from jaxvib.machine.loads import pendulums
from jaxvib.machine.scene import Scene
from jaxvib.machine.structures.platforms import two_mass
from jaxvib.results.status import status_name
from jaxvib.steady.orbits.jam_orbit import jam_orbit

__all__ = ["CASES", "begun"]

_UNTIL = 40.0
"""Duration of runs in the published machine's unit of time: 16 turns of the rotor."""


def begun(scene: Scene) -> np.ndarray:
    """The state that these runs start from: platforms displaced by S/M, loads 0.7 rad apart, at 0.3 of the rotor speed."""
    return away(scene, displacement=1.0, rate=0.3)


_RUN, _RUN_AGAIN = final_state(_UNTIL, begun)


def _heavy() -> Scene:
    """The platform of the exciter has 1 % of what its load has."""
    machine = two_mass(mass=(1.0, 0.01), stiffness=(0.1, 0.1), damping=(0.02, 0.02), link_stiffness=0.4, link_damping=0.02)
    return Scene(machine, pendulums(count=1, mass=1.0, radius=0.5, drag=0.5), ConstantSpeed(3.0))


def _orbit(scene: Scene) -> Answer:
    """Load speed, and amplitudes in natural units, of the exact jam 3."""
    orbit = jam_orbit(scene, mode=3, throw=False)
    name = status_name(orbit.status)
    p = reference_model(scene)
    unit = np.sum(p.m * p.radius) / float(platforms(scene).mass[1])
    values = np.concatenate([[orbit.omega], orbit.amplitude / unit])
    return Answer(values, None, "" if name == "found" else name)  # its error is that of harmonics, rounding is not in it


def _light_again(scene: Scene) -> Reference:
    """The same of light loads: it differs by the loads' share of the mass times the magnification, here some 1e-8."""
    p, speed = reference_model(scene), float(scene.drive.speed)
    omega = light_modes(p, speed)[0]
    _, moved, _ = light_speed(p, omega)
    p = reference_model(scene)
    unit = np.sum(p.m * p.radius) / p.mass[1, 1]
    return Reference(np.concatenate([[omega], np.abs(moved) / unit]), unknown=1e-7)


def _many_once(scene: Scene) -> Reference:
    """Equal loads that start together are one: the run of a load of the same mass and drag in all."""
    p = reference_model(scene)
    alone = dataclasses.replace(
        p, m=np.array([np.sum(p.m)]), radius=p.radius[:1], drag=np.array([np.sum(p.drag)]), kappa=p.kappa[:1]
    )
    nd, n = p.mass.shape[0], p.m.size
    y = _together(scene)
    out = run_out(alone, np.concatenate([y[: 2 * nd], y[2 * nd : 2 * nd + 1], y[2 * nd + n : 2 * nd + n + 1]]), _UNTIL)
    state = np.concatenate([out.state[: 2 * nd], np.repeat(out.state[2 * nd :], n)])
    return compared_state(scene, out._replace(state=state))


def _together(scene: Scene) -> np.ndarray:
    y = begun(scene)
    nd, n = reference_model(scene).mass.shape[0], scene.loads.count
    y[2 * nd : 2 * nd + n] = y[2 * nd]
    return y


def _following(scene: Scene) -> Answer:
    """Displacements of loads that the drag holds to the rotor, from the exact jam of the last mode."""
    orbit = jam_orbit(scene, mode=5, throw=False)
    name = status_name(orbit.status)
    return Answer([orbit.omega, *(orbit.amplitude * 1e3)], None, "" if name == "found" else name)


def _following_again(scene: Scene) -> Reference:
    """A rotor with a fixed imbalance: |D(n)^-1 S n^2|; the loads lag by 1e-9 of a radian."""
    p, speed = reference_model(scene), float(scene.drive.speed)
    _, moved, _ = light_speed(p, speed)
    return Reference([speed, *(np.abs(moved) * 1e3)], unknown=1e-8)


def _sized(mass: float, length: float, time: float) -> Scene:
    """The published machine with a load of eps = 0.05 in other units: kg, m, s that its own are."""
    machine = two_mass(
        mass=(1.0 * mass, 0.95 * mass),
        stiffness=(mass / 9.0 / time**2, mass / 9.0 / time**2),
        damping=(0.02 * mass / time, 0.02 * mass / time),
        link_stiffness=4.0 / 9.0 * mass / time**2,
        link_damping=0.02 * mass / time,
    )
    loads = pendulums(count=1, mass=0.05 * mass, radius=length, drag=0.0025 * mass / time)
    return Scene(machine, loads, ConstantSpeed(3.0 / time))


def _sized_run(time: float) -> tuple[Callable[[Scene], Answer], Callable[[Scene], Reference]]:
    return final_state(float(np.float32(_UNTIL * time)), begun)


def _undragged() -> Scene:
    return eqx.tree_at(lambda s: s.loads.drag, published(eps=0.05), jnp.zeros(()))


def _no_drag(scene: Scene) -> Answer:
    return Answer([jam_orbit(scene, mode=3, throw=False).omega])


CASES = (
    run_case(
        "load 100 times its platform",
        hard="the mass matrix is nearly singular when the load moves in the direction of the platform",
        scene=_heavy,
        answer=_RUN,
        reference=_RUN_AGAIN,
        within=(1e-6, 5e-2),
    ),
    Case(
        "load 1e-9 of its platform",
        hard="the effect of the load is 1e-9 of the motion",
        quantity="load speed and amplitudes of the exact jam 3",
        against="the limit of light loads, by dense complex linear algebra",
        scene=lambda: published(eps=1e-9),
        answer=_orbit,
        reference=_light_again,
        within=(1e-7, 1e-3),
    ),
    run_case(
        "one load",
        hard="none; the total mass is that of the case `1000 loads`",
        scene=lambda: published(eps=0.05),
        answer=_RUN,
        reference=_RUN_AGAIN,
        within=(1e-6, 1e-2),
    ),
    Case(
        "1000 loads",
        hard="a state of 2004 entries, and a sum of a thousand small forces",
        quantity="state at the end of a run",
        against="reference model with one load of the total mass, integrated by SciPy's DOP853",
        scene=lambda: published(eps=0.05 / 1000, beta=1.0, count=1000),
        answer=final_state(_UNTIL, _together)[0],
        reference=_many_once,
        within=(1e-6, 1e-2),
    ),
    run_case(
        "drag 0, run",
        hard="no torque drives the loads, and energy is exchanged without loss",
        scene=_undragged,
        answer=_RUN,
        reference=_RUN_AGAIN,
        within=(1e-6, 1e-2),
    ),
    Case(
        "drag 0, exact jam",
        hard="no jam exists, because no torque drives the loads",
        quantity="load speed of the exact jam 3",
        against="this motion does not exist",
        scene=_undragged,
        answer=_no_drag,
        reference=lambda scene: Reference([0.0], scale=1.0),
        within=(0.0, 0.0),
        named=(("refused",), ("refused",)),
    ),
    Case(
        "drag 1e8 times that of the published machine, exact jam",
        hard="loads turn almost with the rotor: the torque balance is a difference of numbers that are 1e8 times as large",
        quantity="load speed and amplitudes of mode 5",
        against="the closed form of a fixed unbalance",
        scene=lambda: published(eps=0.05, beta=1e8),
        answer=_following,
        reference=_following_again,
        within=(1e-7, 1e-3),
    ),
    run_case(
        "drag 1e3 times that of the published machine, run",
        hard="loads follow the rotor within 1e-3 of its speed, so the equations are stiff",
        scene=lambda: published(eps=0.05, beta=1e3),
        answer=_RUN,
        reference=_RUN_AGAIN,
        within=(1e-5, 1e-2),
    ),
    *(
        case
        for name, hard, mass, length, time in (
            (
                "micromachine of 1e-9 kg",
                "displacements of 1e-10 m and angles of 10 rad: absolute tolerances fail",
                1e-9,
                1e-6,
                1e-4,
            ),
            ("quarry screen of 1e5 kg", "stiffnesses of 1e8 N/m and masses of 1e5 kg", 1e5, 1.0, 2e-2),
        )
        for case in (
            run_case(
                f"{name}, run",
                hard=hard,
                scene=lambda numbers=(mass, length, time): _sized(*numbers),
                answer=_sized_run(time)[0],
                reference=_sized_run(time)[1],
                within=(1e-6, 1e-2),
            ),
            jam_case(
                f"{name}, modes",
                hard=hard,
                scene=lambda numbers=(mass, length, time): _sized(*numbers),
            ),
        )
    ),
)
