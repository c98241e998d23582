"""Cost of effects, drives, machines and loads: the operations that they add to the traced equations of motion."""

from __future__ import annotations

import contextlib
import inspect
from collections.abc import Callable
from typing import NamedTuple, TypeVar

from jaxvib.errors import InputError
from jaxvib.machine.carrier import Machine
from jaxvib.machine.drives.drive import ConstantSpeed, DCMotor
from jaxvib.machine.files import DRIVES, EFFECTS, LOADS
from jaxvib.machine.loads import balls
from jaxvib.machine.scene import Scene
from jaxvib.machine.structures.platforms import network, one_mass, three_mass, two_mass
from jaxvib.machine.structures.rotor import planar_rotor, rotor
from jaxvib.study.audit.compared import field_operations
from jaxvib.units import Numbers

T = TypeVar("T")


class OperationCount(NamedTuple):
    """Number of operations in the equations of motion of a scene with a given part.

    **Attributes**: `part` ("effect", "drive", "machine", "loads") and its `kind`; `operations`: number of operations with the
    part; `added`: increase over the reference scene; `reference`: machine, loads and drive of the reference scene as text.
    """

    part: str
    kind: str
    operations: int
    added: int
    reference: str


def operation_counts() -> list[OperationCount]:
    """Count the operations that each effect, drive, machine and kind of loads adds to the equations of motion.

    The reference scene is a platform with one ball and a constant rotor speed; for kinds of loads, it is a planar rotor with
    one ball and a constant rotor speed. A rotor with loads at stations has two balls, and its count includes the second ball.
    If the platform with a ball cannot have an effect, the reference scene of this effect has other loads, or is a rotor with
    tilt. The attribute `reference` names the reference scene. The counts do not depend on the values of the parameters.

    **Returns** a list of `OperationCount`.

    >>> rows = operation_counts()
    >>> [row.added for row in rows if row.kind == "constant_speed"], min(row.added for row in rows if row.part == "effect") > 0
    ([0], True)

    Source: this package.
    """
    machines: dict[str, Machine] = {
        "one_mass": one_mass(mass=1.0, stiffness=1.0, damping=1.0),
        "two_mass": two_mass(mass=(1.0,) * 2, stiffness=(1.0,) * 2, damping=(1.0,) * 2, link_stiffness=1.0, link_damping=1.0),
        "three_mass": three_mass(
            mass=(1.0,) * 3, stiffness=(1.0,) * 3, damping=(1.0,) * 3, link_stiffness=(1.0,) * 3, link_damping=(1.0,) * 3
        ),
        "network of four": network(
            mass=[1.0] * 4,
            stiffness=[1.0] * 4,
            damping=[1.0] * 4,
            links=[(1, 2), (2, 3), (3, 4)],
            link_stiffness=[1.0] * 3,
            link_damping=[1.0] * 3,
            exciter=4,
        ),
        "planar_rotor": planar_rotor(mass=1.0, stiffness=1.0, damping=1.0),
        "rotor, loads at one station": _rotor(0.0),
        "rotor, loads at stations": _rotor((0.5, -0.5)),
    }
    loads = {kind: _build_with_halves(build) for kind, build in LOADS.items()}
    constant = ConstantSpeed(1.0)

    def row(part: str, kind: str, scene: Scene, reference: Scene) -> OperationCount:
        operations = field_operations(scene)
        name = f"{reference.machine.kind}, {reference.loads.kind}, {reference.drive.kind}"
        return OperationCount(part, kind, operations, operations - field_operations(reference), name)

    platform, planar = (Scene(machines[kind], loads["ball"], constant) for kind in ("one_mass", "planar_rotor"))
    counts = [
        row("drive", kind, Scene(platform.machine, platform.loads, _build_with_halves(drive)), platform)
        for kind, drive in DRIVES.items()
    ]
    for kind, machine in machines.items():
        loads_of_kind = balls(count=2, mass=0.5, radius=0.5, drag=0.5) if "stations" in kind else platform.loads
        counts.append(row("machine", kind, Scene(machine, loads_of_kind, constant), platform))
    counts += [
        row("loads", kind, Scene(planar.machine, loads_of_kind, constant), planar) for kind, loads_of_kind in loads.items()
    ]
    hosts = [
        Scene(machines[m], loads_of_kind, constant)
        for m in ("one_mass", "rotor, loads at one station")
        for loads_of_kind in loads.values()
    ]
    for kind, effect in EFFECTS.items():
        for host in hosts:
            with contextlib.suppress(InputError):  # this machine or these loads cannot have the effect
                counts.append(
                    row("effect", kind, Scene(host.machine, host.loads, constant, (_build_with_halves(effect),)), host)
                )
                break
    return counts


def _build_with_halves(build: Callable[..., T]) -> T:
    """Build an effect, loads or a drive whose required parameters are 0.5, or a special value if 0.5 is not allowed.

    Balls and rollers also have a `ball_radius`, because some effects require it.
    """
    special_values = {
        "motor": DCMotor(1.0, 1.0, 1.0),
        "reference": ConstantSpeed(1.0),
        "rated_speed": 100.0,
        "breakdown_ratio": 2.0,
        "pole_pairs": 1,
        "times": [0.5, 1.0],
        "speeds": [0.5, 1.0],
        "torques": [0.5, -0.5],
        "count": 1,
        "tube": 0.05,
        "ball_radius": 0.02,
    }
    parameters = inspect.signature(build).parameters.values()
    names = [each.name for each in parameters if each.default is each.empty or each.name == "ball_radius"]
    return build(**{name: special_values.get(name, 0.5) for name in names})


def _rotor(stations: Numbers) -> Machine:
    two, ends = (1.0, 1.0), (0.5, -0.5)
    return rotor(
        mass=1.0, transverse_inertia=1.0, polar_inertia=1.0, stiffness=two, damping=two, position=ends, stations=stations
    )
