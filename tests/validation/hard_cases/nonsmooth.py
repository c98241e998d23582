"""Hard cases of forces that bend or jump: stops, contact, dry friction, each against its sharp law from event to event."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from hard_cases.case import Case, Reference
from hard_cases.reference_integration import Event, by_events, natural_sizes
from hard_cases.reference_model import number_of, reference_model
from hard_cases.shared import away, compared_state, final_state
from jaxvib.machine.drives.drive import ConstantSpeed, Drive, RunUp
from jaxvib.machine.effects.base import Effect, Gravity
from jaxvib.machine.effects.contact import LoadContact
from jaxvib.machine.effects.friction import DryFriction
from jaxvib.machine.effects.supports import Stop
from jaxvib.machine.loads import balls, pendulums
from jaxvib.machine.scene import Scene
from jaxvib.machine.structures.platforms import one_mass
from jaxvib.motion.plan import Tolerance

__all__ = ["CASES", "stop_law"]

Start = Callable[[Scene], np.ndarray]


def stop_law(until: float, start: Start) -> Callable[[Scene], Reference]:
    """A stop above the only platform: it presses where the platform is beyond the gap and k x + c x' does not pull."""

    def reference(scene: Scene) -> Reference:
        p, stop = reference_model(scene), next(e for e in scene.all_effects if e.kind == "stop")
        k, c, gap = (number_of(stop, name) for name in ("stiffness", "damping", "gap"))

        def beyond(t: float, y: np.ndarray) -> float:
            return y[0] - gap

        def force(t: float, y: np.ndarray) -> float:
            return k * (y[0] - gap) + c * y[1]

        def field(t: float, y: np.ndarray, mode: tuple[int, int]) -> np.ndarray:
            return p.field(t, y, -force(t, y) if mode == (1, 1) else 0.0)

        def events(mode: tuple[int, int]) -> list[Event]:
            if c == 0.0:  # both are one
                return [Event(beyond, -mode[0], lambda t, y: (-mode[0], -mode[0]))]
            return [
                Event(beyond, -mode[0], lambda t, y: (-mode[0], mode[1])),
                Event(force, -mode[1], lambda t, y: (mode[0], -mode[1])),
            ]

        began = start(scene)
        mode = (1 if beyond(0.0, began) > 0.0 else -1, 1 if force(0.0, began) > 0.0 else -1)
        out, _ = by_events(field, events, mode, began, until, natural_sizes(p))
        return compared_state(scene, out, unknown=1e-7)

    return reference


def _contact(until: float, start: Start) -> Callable[[Scene], Reference]:
    """Two balls on one track: they press where their centres are nearer than 2 r and k d - c s' does not pull."""

    def reference(scene: Scene) -> Reference:
        p, effect = reference_model(scene), next(e for e in scene.all_effects if e.kind == "load_contact")
        own, radius = (number_of(scene.loads, name) for name in ("ball_radius", "radius"))
        k, c = number_of(effect, "stiffness"), number_of(effect, "damping")

        def gap(y: np.ndarray, pair: int) -> tuple[float, float, float]:
            """Distance beyond 2 r, its rate, and its slope by the angle between the two."""
            between = y[3] - y[2] if pair == 0 else y[2] + 2.0 * np.pi - y[3]
            rate = y[5] - y[4] if pair == 0 else y[4] - y[5]
            slope = radius * np.cos(0.5 * between)
            return 2.0 * radius * np.sin(0.5 * between) - 2.0 * own, slope * rate, slope

        def push(y: np.ndarray, pair: int) -> float:
            s, rate, _ = gap(y, pair)
            return -k * s - c * rate

        def field(t: float, y: np.ndarray, mode: tuple[int, ...]) -> np.ndarray:
            matrix, right = p.forces(t, y)
            for pair, sign in ((0, 1.0), (1, -1.0)):
                if mode[pair] < 0 and mode[2 + pair] > 0:
                    torque = sign * push(y, pair) * gap(y, pair)[2]
                    right[1] -= torque
                    right[2] += torque
            change = np.linalg.solve(matrix, right)
            return np.concatenate([y[1:2], change[:1], y[4:6], change[1:]])

        def events(mode: tuple[int, ...]) -> list[Event]:
            tests = [lambda t, y, pair=pair: gap(y, pair)[0] for pair in (0, 1)]
            tests += [lambda t, y, pair=pair: push(y, pair) for pair in (0, 1)]

            def flipped(which: int) -> Callable[[float, np.ndarray], tuple[int, ...]]:
                return lambda t, y: tuple(-m if j == which else m for j, m in enumerate(mode))

            return [Event(test, -mode[j], flipped(j)) for j, test in enumerate(tests)]

        y = start(scene)
        mode = tuple(1 if x > 0.0 else -1 for x in (gap(y, 0)[0], gap(y, 1)[0], push(y, 0), push(y, 1)))
        out, _ = by_events(field, events, mode, y, until, natural_sizes(p))
        return compared_state(scene, out, unknown=1e-6)

    return reference


def _dry(until: float, start: Start) -> Callable[[Scene], Reference]:
    """A pendulum on a bearing with dry friction, its sign sharp: it slides forward, backward, or sticks to the rotor.

    It sticks as long as what holds it there is below mu2 (d/2) |N|, and slides against what exceeds that.
    """

    def reference(scene: Scene) -> Reference:
        p, effect = reference_model(scene), next(e for e in scene.all_effects if e.kind == "dry_friction")
        lever = 0.5 * number_of(effect, "coefficient") * number_of(effect, "diameter")
        g = number_of(p.effects["gravity"], "g") if "gravity" in p.effects else 0.0
        m, radius = float(p.m[0]), float(p.radius[0])

        def load(y: np.ndarray, a: float) -> float:
            return m * (radius * y[3] ** 2 - np.sin(y[2]) * (a + g))

        def sliding(t: float, y: np.ndarray, sign: int) -> np.ndarray:
            """Accelerations (q'', phi''): the torque sign x lever x |N|, N linear in q''."""
            matrix, right = p.forces(t, y)
            change = np.linalg.solve(matrix, right)
            for side in (1.0, -1.0):
                now, torque = matrix.copy(), right.copy()
                torque[1] += sign * lever * side * load(y, 0.0)
                now[1, 0] += sign * lever * side * m * np.sin(y[2])
                change = np.linalg.solve(now, torque)
                if side * load(y, change[0]) >= 0.0:
                    break
            return change

        def stuck(t: float, y: np.ndarray) -> tuple[float, float, float]:
            """q'', the torque that the bearing has to give, and the largest that it can."""
            matrix, right = p.forces(t, y)
            change = p.rotor(t, y)[2]
            a = (right[0] - matrix[0, 1] * change) / matrix[0, 0]
            return a, matrix[1, 0] * a + matrix[1, 1] * change - right[1], lever * abs(load(y, a))

        def field(t: float, y: np.ndarray, mode: int) -> np.ndarray:
            if mode == 0:
                return np.array([y[1], stuck(t, y)[0], p.rotor(t, y)[1], p.rotor(t, y)[2]])
            a = sliding(t, y, mode)
            return np.array([y[1], a[0], y[3], a[1]])

        def slip(t: float, y: np.ndarray) -> float:
            return p.rotor(t, y)[1] - y[3]

        def held(t: float, y: np.ndarray) -> float:
            _, needed, most = stuck(t, y)
            return most - abs(needed)

        def after(t: float, y: np.ndarray) -> int:
            _, needed, most = stuck(t, y)
            return 0 if abs(needed) <= most else int(np.sign(needed))

        def events(mode: int) -> list[Event]:
            if mode == 0:
                return [Event(held, -1, lambda t, y: int(np.sign(stuck(t, y)[1])))]
            return [Event(slip, -mode, after)]

        began = start(scene)
        mode = after(0.0, began) if slip(0.0, began) == 0.0 else int(np.sign(slip(0.0, began)))
        out, _ = by_events(field, events, mode, began, until, natural_sizes(p))
        return compared_state(scene, out, unknown=1e-6)

    return reference


def _one(*effects: Effect, drive: Drive | None = None, drag: float = 0.5) -> Scene:
    machine = one_mass(mass=50.0, stiffness=4e4, damping=100.0)
    loads = pendulums(count=1, mass=2.0, radius=0.1, drag=drag)
    return Scene(machine, loads, ConstantSpeed(60.0) if drive is None else drive, effects)


def _two_balls(stiffness: float, damping: float) -> Scene:
    machine = one_mass(mass=50.0, stiffness=4e4, damping=100.0)
    loads = balls(count=2, mass=0.5, radius=0.1, drag=2.0, ball_radius=0.02)
    return Scene(machine, loads, ConstantSpeed(20.0), (Gravity(), LoadContact(stiffness=stiffness, damping=damping)))


def _moving(scene: Scene) -> np.ndarray:
    return away(scene, displacement=0.5, rate=0.4)


def _meeting(scene: Scene) -> np.ndarray:
    y = away(scene, angle=-2.5)
    y[3], y[4], y[5] = 0.0, 0.0, -5.0
    return y


def _hanging(angle: float, rate: float = 0.0) -> Start:
    def start(scene: Scene) -> np.ndarray:
        y = away(scene, angle=-0.5 * np.pi + angle)
        y[3] = rate
        return np.asarray(y, np.float32).astype(float)

    return start


def _friction(coefficient: float, speed: float, width: float = 1e-4, drive: Drive | None = None) -> Scene:
    """A pendulum of 1 kg on 0.1 m whose bearing of 40 mm holds mu2 g/5 N m, on a platform that hardly gives way."""
    machine = one_mass(mass=200.0, stiffness=2e6, damping=1e4)
    loads = pendulums(count=1, mass=1.0, radius=0.1, drag=0.02)
    effects = (Gravity(), DryFriction(coefficient, diameter=0.04, width=width))
    return Scene(machine, loads, ConstantSpeed(speed) if drive is None else drive, effects)


_FINE_TOLERANCE = (Tolerance(1e-10), None)


def _bent(
    name: str, hard: str, scene: Callable[[], Scene], start: Start, until: float, law: Callable, within: tuple[float, float]
) -> Case:
    return Case(
        name,
        hard=hard,
        quantity="state at the end of a run",
        against="reference model with the non-smooth law, integrated from event to event by SciPy's DOP853",
        scene=scene,
        # the error that a run claims is its own, that of its smoothed friction is not in it
        answer=final_state(until, start, steps=_FINE_TOLERANCE, claims=law is not _dry)[0],
        reference=law(until, start),
        within=within,
    )


CASES = (
    _bent(
        "stop 1e4 times as stiff as the support",
        "a bounce lasts a hundredth of a period, and the slope of the force jumps at its beginning",
        lambda: _one(Stop(4e8, gap=1e-3, side="above")),
        _moving,
        1.0,
        stop_law,
        (1e-4, 0.5),
    ),
    _bent(
        "stop that damps",
        "the force jumps at the beginning and at the end of the contact with the stop",
        lambda: _one(Stop(4e6, gap=1e-3, damping=4e3, side="above")),
        _moving,
        1.0,
        stop_law,
        (1e-4, 0.1),
    ),
    _bent(
        "contact of two balls",
        "many bounces of a millisecond until the balls are at rest relative to each other",
        lambda: _two_balls(1e6, 20.0),
        _meeting,
        0.5,
        _contact,
        (1e-4, 0.1),
    ),
    _bent(
        "friction, from zero speed",
        "a slow rotor carries the pendulum until it slips, and later it sticks again; both happen at a sliding speed of zero",
        lambda: _friction(0.3, 0.25),
        _hanging(0.0, 0.25),
        2.0,
        _dry,
        (2e-3, 2e-2),
    ),
    _bent(
        "friction, reversing",
        "the pendulum swings, its speed relative to the rotor changes sign, and it comes to rest",
        lambda: _friction(0.15, 0.05),
        _hanging(1.2),
        8.0,
        _dry,
        (2e-2, 5e-2),  # creep of the width 1e-4 rad/s for 8 s, times 10 rad/s of the swing, is 0.16 of the rotor speed
    ),
    _bent(
        "friction, sticking to a rotor that runs up",
        "the bearing carries the pendulum over the top, and the friction torque changes sign in each turn",
        lambda: _friction(2.5, 40.0, drive=RunUp(40.0, acceleration=4.0)),
        _hanging(0.0),
        6.0,
        _dry,
        (2e-3, 5e-2),
    ),
)
