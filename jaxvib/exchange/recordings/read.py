"""Reading of recordings, and of runs with described channels from them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

from jaxvib.boundary import validated
from jaxvib.errors import InputError
from jaxvib.exchange.recordings.formats import read_channels
from jaxvib.identification.records.channel import Channel
from jaxvib.identification.records.recorded import Recorded, described_channels
from jaxvib.identification.run import MeasuredRun, run_of
from jaxvib.units import Number, number


@validated
def read_run(
    path: str | Path,
    channels: Sequence[Channel],
    start: Number | None = None,
    until: Number | None = None,
    change: Mapping[str, Number] | None = None,
    rate: Number | None = None,
) -> MeasuredRun:
    """Read a recorded run of a machine from a file.

    - Text (CSV, or columns separated by semicolons, tabs or blanks), with a column of times, or with the sampling rate in a
      line such as "# rate: 2000 Hz"
    - TDMS (`pip install '.[tdms]'`), universal files with dataset 58 (`'.[uff]'`), MATLAB's MAT files of all versions
      (`'.[mat]'`), WAV (`'.[mat]'`), MF4 (`'.[mf4]'`)

    Readings are converted to SI units from the unit of the channel or, if it has none, from the unit in the file. They are
    checked and repaired; `notes` of the result describe the repairs. Values of WAV files are fractions of the full scale; a
    unit such as "50 g" states the full scale.

    **Arguments**

    - `path` of the file; the extension of its name determines the format
    - `channels` that are read, with names as in the file, with or without their units; typical: 1 to 10
    - `start` and `until`, s: beginning and end of the part that is read; default: the whole record
    - `change`: parameters of the scene that were different in this run, as for `MeasuredRun.from_arrays`
    - `rate`: sampling rate, Hz, in place of the times in the file; typical: 500 to 10,000

    **Returns** `MeasuredRun`. **Raises** `InputError` for a file that cannot be read, a channel that the file does not have,
    and samples that cannot be used.

    >>> import pathlib, tempfile, numpy as np, jaxvib as jv
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "run_up.csv"
    >>> rows = [f"{t:.3f},{np.sin(30 * t):.5f}" for t in np.arange(0.0, 2.0, 0.01)]
    >>> _ = path.write_text("time (s),frame (g)\\n" + "\\n".join(rows))
    >>> run = jv.read_run(path, [jv.Channel("frame", "acceleration", at=1)], until="1 s")
    >>> run.values["frame"].size, round(float(np.max(run.values["frame"])), 2)
    (101, 9.81)
    """
    path = Path(path)
    sampling_rate = None if rate is None else float(number(rate, "Hz", "rate", low=0.0, open_low=True))
    low = -math.inf if start is None else float(number(start, "s", "start"))
    high = math.inf if until is None else float(number(until, "s", "until"))
    if low >= high:
        raise InputError("until", f"is {high:g} s; it must be later than start, {low:g} s")
    recorded = read_channels(path, sampling_rate)
    return run_of(channels, *described_channels(recorded, channels, str(path), low, high), change, str(path))


@validated
def read_recording(path: str | Path, rate: Number | None = None) -> tuple[Recorded, ...]:
    """Read all channels of a file, in the units of the file.

    **Arguments**: `path` of a file as for `read_run`; `rate`: sampling rate, Hz, in place of the times in the file; typical:
    500 to 10,000.

    **Returns** a tuple of channels, each with `name`, `unit` ("" if the file does not state it), `time` (n,) s or None, and
    `values` (n,). **Raises** `InputError` for a file that cannot be read.

    >>> import pathlib, tempfile
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "run.csv"
    >>> _ = path.write_text("# rate: 100 Hz\\nframe (g)\\n" + "0.5\\n" * 20)
    >>> [(each.name, each.unit, float(each.time[-1])) for each in read_recording(path)]
    [('frame', 'g', 0.19)]
    """
    return tuple(read_channels(Path(path), None if rate is None else float(number(rate, "Hz", "rate", low=0.0, open_low=True))))
