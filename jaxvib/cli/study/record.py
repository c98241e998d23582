"""Command `record` of jaxvib."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from jaxvib.cli.app import Output, command, table

if TYPE_CHECKING:
    from jaxvib.exchange.recordings.overview import ChannelOverview

_SHOWN_TIMES = 9
"""Number of times in the table of the rotor speed."""

_VIBRATIONS = frozenset({"acceleration", "velocity", "displacement", "force"})
"""Kinds of channels in the table of vibrations."""


@command("record", "recording")
@click.option("--pulses", help="Name of the channel with the pulses of a tachometer.")
@click.option("--per-turn", type=click.IntRange(min=1), default=1, help="Pulses per turn of the rotor.")
@click.option("--speed", help="Name of the channel with the rotor speed [the first in rpm or rad/s].")
@click.option("--rate", help="Sampling rate in place of the times in the file, such as '2 kHz'.")
def record(recording: Path, pulses: str | None, per_turn: int, speed: str | None, rate: str | None, output: Output) -> None:
    """Describe a RECORDING (CSV, TDMS, UFF, MAT, WAV, MF4): its channels with their units, rates, gaps and clipped readings,
    RMS and main frequency of vibrations, and the rotor speed over time. --out adds the figure."""
    import numpy as np  # slow imports, which --help does not need

    from jaxvib.display import speed_text
    from jaxvib.draw.record import recording_chart
    from jaxvib.exchange.recordings.overview import overview_of, speed_of
    from jaxvib.exchange.recordings.read import read_recording

    channels = read_recording(recording, rate)
    overviews = [overview_of(channel) for channel in channels]
    run = speed_of(channels, pulses, speed, per_turn)
    curve = None if run is None else run.rotor_speed()
    notes = [note for overview in overviews for note in overview.notes] + ([] if run is None else list(run.notes))
    signals = [
        (f"{channel.name}{f', {channel.unit}' if channel.unit else ''}", channel.time, channel.values)
        for channel in channels
        if channel.time is not None
    ]
    output.figure("recording.png", lambda: recording_chart(signals, curve))
    document = {
        "file": str(recording),
        "channels": [{k: v for k, v in overview._asdict().items() if k != "notes"} for overview in overviews],
        "speed": None,
        "notes": notes,
    }
    rows_of_speed: list[list[str]] = []
    if curve is not None:
        time, values = curve
        document["speed"] = {"start": values[0], "end": values[-1], "low": np.min(values), "high": np.max(values)}
        shown_times = np.linspace(time[0], time[-1], _SHOWN_TIMES)
        rows_of_speed = [[f"{t:.4g}", speed_text(float(np.interp(t, time, values)), 5)] for t in shown_times]

    def text() -> str:
        rows = [
            [
                overview.name,
                overview.unit,
                "" if np.isnan(overview.rate) else f"{overview.rate:.6g}",
                f"{overview.samples}",
                "" if np.isnan(overview.start) else f"{overview.start:.4g} to {overview.end:.4g}",
                f"{overview.low:.4g} to {overview.high:.4g}",
                f"{overview.missing or ''}",
                f"{overview.clipped or ''}",
            ]
            for overview in overviews
        ]
        heads = ["channel", "unit", "rate, Hz", "readings", "time, s", "values", "missing", "clipped"]
        lines = [table(str(recording), heads, rows)]
        if vibrations := _vibration_rows(overviews):
            heads = ["channel", "RMS without mean", "main frequency, Hz", "velocity from 10 to 1000 Hz, mm/s RMS"]
            lines.append(table("vibration; valid for a constant speed only", heads, vibrations))
        if rows_of_speed:
            lines.append(table("rotor speed", ["time, s", "speed"], rows_of_speed))
        return "\n".join([*lines, *notes])

    output.done(document, text, "recording")


def _vibration_rows(overviews: Sequence[ChannelOverview]) -> list[list[str]]:
    """Return the rows of the table of vibrations."""
    rows = []
    for each in overviews:
        if each.main_frequency > 0.0 and not _VIBRATIONS.isdisjoint(each.kinds):
            velocity = "" if each.velocity != each.velocity else f"{1e3 * each.velocity:.4g}"
            rows.append([each.name, f"{each.rms:.4g} {each.unit}", f"{each.main_frequency:.4g}", velocity])
    return rows
