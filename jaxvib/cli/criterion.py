"""Commands `criterion` and `balance` of jaxvib."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

import jaxvib as jv
from jaxvib.cli.app import SPEED, SPEED_TYPE, WITHOUT, Output, command, loaded_scene, table
from jaxvib.cli.output import fields_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from jaxvib.steady.balance.states import BalancedStability


@command("criterion")
@click.option("--check", is_flag=True, help="Also compute the speeds at which balanced motion is stable by the full equations.")
@WITHOUT
def criterion(scene: Path, check: bool, without: tuple[str, ...], output: Output) -> None:
    """List the rotor speeds at which the loads of SCENE gather, and those at which they spread and balance the rotor, according
    to the empirical criterion."""
    from jaxvib.steady.balance.criterion import criterion_table  # slow import, which --help does not need
    from jaxvib.steady.balance.states import balanced_intervals

    loaded = loaded_scene(scene, without)
    result = jv.criterion(loaded)
    document = criterion_table(result)
    top = 1.5 * max([*document["resonances"], *document["damped_resonances"], float(loaded.drive.speed)])
    exact = None
    if check:
        lowest = min((w for w in document["resonances"] if w > 0.0), default=top)
        exact = balanced_intervals(loaded, 0.05 * lowest, top)
        document["exact_balancing"] = exact
        document["exact_up_to"] = top

    def figure() -> Figure:
        import jax
        import jax.numpy as jnp
        import numpy as np

        from jaxvib.draw.criterion import criterion_chart
        from jaxvib.draw.style import panels
        from jaxvib.steady.balance.criterion import criterion_functional

        near = np.concatenate([w + np.geomspace(1e-4, 0.2, 60) * w * s for w in document["resonances"] for s in (-1, 1)])
        speeds = np.unique(np.clip(np.concatenate([np.linspace(1e-3, 1.0, 1200) * top, near]), 1e-3 * top, top))
        functional = jax.vmap(lambda w: criterion_functional(loaded, w))(jnp.asarray(speeds))
        figure, (axis,) = panels(1)
        criterion_chart(axis, speeds, np.asarray(functional), document["balancing"], exact, float(loaded.drive.speed))
        return figure

    output.figure("criterion.png", figure)

    def text() -> str:
        from jaxvib.display import speed_text, speed_unit  # slow import, which --help does not need

        unit, scale = speed_unit()
        rows = [[label, f"{scale * w:.6g}"] for label, w in result.speeds.labelled()]
        damped = [[label, f"{scale * w:.6g}"] for label, w in result.speeds.labelled(damped=True)]
        kinds = [("balancing", "loads spread and balance"), ("gathering", "loads stay together")]
        spans = [[words, *_ends(span, scale)] for name, words in kinds for span in document[name]]
        spans += [["balancing, exactly", *_ends(span, scale)] for span in exact or []]
        lines = [
            document["status"],
            table("characteristic speeds, no damping", ["", unit], rows),
            table("sign changes of the criterion, with this damping", ["", unit], damped),
            table("rotor speeds", ["", f"from, {unit}", f"to, {unit}"], spans),
        ]
        if check:
            lines.append(f"exact stability was computed up to {speed_text(top)}")
        return "\n".join(lines)

    output.done(document, text, "criterion", result)


def _ends(span: Sequence[float | None], scale: float) -> list[str]:
    return ["no end" if end is None else f"{scale * end:.6g}" for end in span]


@command("balance")
@SPEED
@click.option(
    "--between",
    nargs=2,
    type=SPEED_TYPE,
    metavar="LOW HIGH",
    help="Also find the stable ranges of each arrangement between two rotor speeds, such as '300 rpm' '1500 rpm'.",
)
@click.option("--points", type=int, default=200, help="Number of speeds for --between.")
@WITHOUT
def balance(
    scene: Path,
    speed: str | None,
    between: tuple[str, str] | None,
    points: int,
    without: tuple[str, ...],
    output: Output,
) -> None:
    """List the arrangements in which the loads of SCENE balance its rotor, and their exact stability at the rotor speed;
    --out adds a figure.

    The loads must be in one plane or at two stations. The stability follows from Floquet multipliers of the full equations."""
    from jaxvib.units import number  # slow import, which --help does not need

    loaded = loaded_scene(scene, without, speed)
    ends = None if between is None else [float(number(end, "rad/s", "--between", low=0.0)) for end in between]
    states = jv.balanced_states(loaded)
    stabilities = [states.stability(k) for k in range(len(states.angles))]
    stable = [] if ends is None else [states.intervals(*ends, arrangement=k, points=points) for k in range(len(stabilities))]
    output.figure("balance.png", states.plot)
    document = {
        "rotor_speed": loaded.drive.speed,
        "status": states.message,
        "share": states.share,
        "capacity": states.capacity,
        "neutral_directions": states.names,
        "arrangements": [
            {"angles": angles, **fields_of(end, "stable", "is_decided", "growth", "error")}
            | ({"stable_between": stable[k]} if stable else {})
            for k, (angles, end) in enumerate(zip(states.angles, stabilities, strict=True))
        ],
    }
    output.done(document, lambda: _balance_text(states, stabilities, stable), "balance", states)


def _balance_text(states: jv.BalancedStates, stabilities: list[BalancedStability], stable: Sequence[list[list[float]]]) -> str:
    """Return the arrangements as a table, below lines with the answer."""
    from jaxvib.display import speed_text, speed_unit  # slow imports, which --help does not need
    from jaxvib.results.status import status_name
    from jaxvib.steady.jams.patterns import images_text
    from jaxvib.steady.jams.phases import degrees

    unit, scale = speed_unit()
    names = [status_name(stability.status) for stability in stabilities]
    answer = next((name for name in ("stable", "undecided", "unstable") if name in names), "impossible")
    lines = [f"balanced motion at {speed_text(states.scene.drive.speed)}: {answer}", textwrap.fill(states.message, 80)]
    if not len(states.angles):
        lines += states.summary().splitlines()[1:]
    for k, (share, loads) in enumerate(zip(states.share, states.planes, strict=True)):
        several = f"load{'s' if loads.size > 1 else ''} {', '.join(str(j + 1) for j in loads)}"
        plane = f" in plane {k + 1} ({several})" if len(states.share) > 1 else ""
        lines.append(f"imbalance{plane}: {100.0 * share:.4g} % of the unbalance of all loads{' there' if plane else ''}")
    distinct = {each[0]: f"{each[0] + 1}{images_text(each)}" for each in states.distinct}
    rows = [
        [
            number,
            names[k],
            f"{stabilities[k].growth:.4g}",
            " ".join(f"{degrees(float(a)) % 360.0:.4g}" for a in states.angles[k]),
        ]
        for k, number in distinct.items()
    ]
    if rows:
        head = ["arrangement", "", "growth, 1/s", "angles of the loads in the rotor, degrees"]
        lines.append(table("arrangements (growth below 0: disturbances decay)", head, rows))
    if stable:
        spans = [[number, *(f"{scale * end:.6g}" for end in span)] for k, number in distinct.items() for span in stable[k]]
        lines.append(
            table("rotor speeds at which an arrangement is stable", ["arrangement", f"from, {unit}", f"to, {unit}"], spans)
            if spans
            else "stable at none of the speeds between these two"
        )
    if answer == "stable" or any(map(len, stable)):
        reached = (
            "stable: small disturbances decay. A start from rest need not reach this motion, because the loads may jam at a "
            "resonance: jaxvib modes lists the jams, jaxvib simulate --until 100s shows a start"
        )
        lines.append(textwrap.fill(reached, 80))
    return "\n".join(lines)
