"""Files of recorders: CSV, TDMS, universal files (UFF 58), MATLAB, WAV, MF4.

Each reader returns the channels of a file with their names, units and times. Libraries of formats other than CSV are optional.
"""

from __future__ import annotations

import math
import os
import re
import warnings
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxvib.errors import InputError, open_regular, optional_module, quoted
from jaxvib.exchange.uff import read_uff
from jaxvib.identification.records.recorded import Recorded
from jaxvib.results.table import TextTable, read_table
from jaxvib.units.columns import split_head, unit_factor

_MAX_BYTES = 2**32
_UNKNOWN_SIZE = 2**32 - 1
"""Size in the header of a WAV file if the length was unknown when the header was written."""

_TIME_NAMES = ("time", "t", "times", "timestamp", "x_value", "zeit", "время")
"""Names of a channel of times, in lower case."""

_RATE_NAMES = ("rate", "fs", "sampling rate", "sample rate", "samplerate", "sampling frequency", "sampling_rate", "abtastrate")
"""Names of the sampling rate, in lower case."""

_RATE = re.compile(
    rf"^\W*(?P<head>(?:{'|'.join(_RATE_NAMES)})\b[^\d;,\t]*(?<![-+.]))(?:(?P<mark>[;,\t])[^\w.+-]*)?(?P<cells>[-+.]?\d.*)",
    re.IGNORECASE,
)
"""Line with a sampling rate."""

_RATE_CELL = re.compile(
    r"(?!\d+,\d{3}(?!\d))(?P<number>(?:\d+(?:[.,]\d*)?|\.\d+)(?:e[+-]?\d+)?)\s*(?P<unit>(?:1/)?[^\d\s,].*)?", re.IGNORECASE
)
"""Number and unit of a sampling rate. Three digits after a comma may be thousands or decimals, and are not matched."""

_SI_UNITS = {"acceleration": "m/s^2", "velocity": "m/s", "displacement": "m", "force": "N"}


def read_channels(path: Path, rate: float | None) -> list[Recorded]:
    """Return the channels of a file. The extension of the file's name determines the format; other extensions are read as text.

    **Arguments**: `rate`, Hz, replaces the times of the file.

    **Raises** `InputError` for a file that cannot be read or has no channel, and if a library is not installed.
    """
    if path.suffix.lower() == ".toml":
        raise InputError(str(path), "is a file of jaxvib, not a recording; give a recording, such as run_up.csv")
    reader = _READERS.get(path.suffix.lower(), _read_text)
    try:
        with open_regular(path) as file:
            size = file.seek(0, os.SEEK_END)
    except OSError as error:
        raise InputError(str(path), f"cannot be read ({error.strerror}); give the path of a recording") from error
    if size > _MAX_BYTES:
        raise InputError(str(path), f"is larger than {_MAX_BYTES >> 30} GB; split it")
    try:
        channels = list(reader(path, rate))
    except InputError:
        raise
    except Exception as error:  # libraries raise any class of error for a damaged file
        kind = _NAMES.get(reader, "recording")
        reason = " ".join(str(error).split()) or type(error).__name__
        raise InputError(str(path), f"cannot be read as a {kind} file ({reason}); export it again") from error
    if not channels:
        raise InputError(str(path), "contains no channel of numbers; export the channels that were recorded")
    channels = [channel._replace(values=_floating(channel.values)) for channel in _with_unique_names(channels)]
    if rate is None:
        return channels
    times = {size: np.arange(size) / rate for size in {channel.values.size for channel in channels}}
    return [channel._replace(time=times[channel.values.size]) for channel in channels]


def _floating(values: np.ndarray) -> np.ndarray:
    """Return readings as floating-point numbers. Single precision is kept, because long recordings need much memory."""
    values = np.asarray(values)
    return values if values.dtype in (np.float32, np.float64) else values.astype(float)


def _with_unique_names(channels: list[Recorded]) -> list[Recorded]:
    """Return the channels with unique names: a number is appended to a name that occurs more than once."""
    counts, occurrences = Counter(channel.name for channel in channels), Counter()
    unique = []
    for channel in channels:
        occurrences[channel.name] += 1
        unique.append(
            channel._replace(name=f"{channel.name} {occurrences[channel.name]}") if counts[channel.name] > 1 else channel
        )
    return unique


def _read_text(path: Path, rate: float | None) -> Iterator[Recorded]:
    table = read_table(path, "time and readings")
    named = table.heads or _commented_heads(table)
    heads = named or [f"column {k + 1}" for k in range(table.width)]
    split = [split_head(head, "s") for head in heads]
    if table.units:
        split = [(name, unit or below) for (name, unit), below in zip(split, table.units, strict=True)]
    clocks = _clocks(split)
    if not named and table.width > 1 and rate is None:
        clocks = [0]
    if rate is None and not clocks:
        rate = _stated_rate(table.remarks, path)
        if rate is None:
            names = ", ".join(heads)
            raise InputError(
                str(path),
                f"has no column of times; its columns are {names}: rename the column of times to 'time (s)', write a line "
                "'# rate: 2000 Hz', or give the sampling rate, `rate`",
            )
    places = [k for k in range(table.width) if k not in clocks]
    if not places:
        raise InputError(str(path), "has a column of times only; give a file with readings")
    time = None
    if rate is None:
        unit = split[clocks[0]][1] or "s"
        factor = unit_factor(unit, "s")
        if factor is None:
            raise InputError(f"{path}: unit of time", f"is {quoted(unit)}, which is not a unit of time; write s, ms, us or min")
        time = table.values(clocks[:1], ["time"])[:, 0] * factor
    values = table.values(places, [split[k][0] for k in places], missing=True)
    if time is None and rate is not None:
        time = np.arange(len(values)) / rate
    for n, k in enumerate(places):
        yield Recorded(split[k][0], split[k][1], time, values[:, n])


def _commented_heads(table: TextTable) -> list[str]:
    """Return the names of the columns from a line that begins with #, as NumPy writes it. The line must contain a name for
    each column, and one of the columns must be that of the times. Return an empty list without such a line."""
    for line in reversed(table.remarks):
        cells = [cell.strip().strip('"') for cell in line.split(table.delimiter)]
        if len(cells) == table.width > 1 and _clocks([split_head(cell, "s") for cell in cells]):
            return cells
    return []


def _clocks(columns: Sequence[tuple[str, str]]) -> list[int]:
    """Return the indices of the columns of times from names and units.

    A column T is a torque or a temperature if its unit is not a unit of time, or if there is another column of times.
    """
    named = [k for k, (name, _) in enumerate(columns) if name.lower() in _TIME_NAMES]
    times = [k for k in named if columns[k][0].lower() != "t" or unit_factor(columns[k][1] or "s", "s") is not None]
    return [k for k in times if columns[k][0] != "T"] or times


def _stated_rate(remarks: list[str], path: Path) -> float | None:
    """Return the sampling rate, Hz, that a line above the table states; None without such a line.

    **Raises** `InputError` for a number or a unit that cannot be read.
    """
    for line in remarks:
        match = _RATE.match(line)
        if match is None:
            continue
        cell, beside, *_ = (each.strip("\"' ") for each in [*re.split(r"[;\t]|,(?!\d)", match["cells"]), ""])
        found = None if match["mark"] == "," and "," in cell else _RATE_CELL.fullmatch(cell)
        rate = math.inf
        if found is not None:
            beside = beside if unit_factor(beside, "Hz") is not None else split_head(match["head"].strip(" :="), "Hz")[1]
            factor = unit_factor((found["unit"] or "").strip("()[]. ") or beside or "Hz", "Hz")
            rate = math.inf if factor is None else float(found["number"].replace(",", ".")) * factor
        if not math.isfinite(rate):
            problem = f"states a sampling rate that cannot be read: {quoted(line)}"
            raise InputError(str(path), f"{problem}; write it as '# rate: 2000 Hz', or give the sampling rate, `rate`")
        if rate > 0.0:
            return rate
    return None


def _cut_off_error(path: Path, difference: str) -> InputError:
    """Return the error of a file with fewer data than its header states."""
    return InputError(str(path), f"{difference}: the recording was cut off; export it again")


def _read_tdms(path: Path, rate: float | None) -> Iterator[Recorded]:
    tdms = optional_module("nptdms", "tdms").TdmsFile.read(str(path))
    for name, status in (tdms.file_status.channel_statuses or {}).items():
        if status.read_length != status.expected_length:
            header, read_count = status.expected_length, status.read_length
            raise _cut_off_error(path, f"has {read_count} readings of {name} where its header states {header}")
    for group in tdms.groups():
        channels = [channel for channel in group.channels() if np.issubdtype(channel.dtype, np.number)]
        units = [
            str(each.properties.get("unit_string") or each.properties.get("NI_UnitDescription") or "") for each in channels
        ]
        clocks = _clocks([(channel.name, unit) for channel, unit in zip(channels, units, strict=True)])
        clock = channels[clocks[0]] if clocks else None
        for channel, unit in zip(channels, units, strict=True):
            if channel is clock:
                continue
            time = None
            if channel.properties.get("wf_increment"):
                time = channel.properties.get("wf_start_offset", 0.0) + channel.properties["wf_increment"] * np.arange(
                    len(channel)
                )
            elif clock is not None:
                time = np.asarray(clock[:], float)
            yield Recorded(channel.name, unit, time, channel[:])


def _read_uff(path: Path, rate: float | None) -> Iterator[Recorded]:
    for function in read_uff(path).functions:
        if function.kind == "history":
            yield Recorded(
                function.about or f"node {function.response[0]}",
                _SI_UNITS.get(function.quantity, ""),
                function.x,
                np.real(function.values),
            )


def _read_wav(path: Path, rate: float | None) -> Iterator[Recorded]:
    wavfile = optional_module("scipy.io.wavfile", "mat")
    with path.open("rb") as file:
        head, size = file.read(8), file.seek(0, os.SEEK_END)
    stated = int.from_bytes(head[4:], "little") + 8
    if head[:4] == b"RIFF" and size < stated < _UNKNOWN_SIZE:
        raise _cut_off_error(path, f"has {size} bytes where its header states {stated}")
    with warnings.catch_warnings():  # SciPy warns of chunks that contain notes
        warnings.simplefilter("ignore", wavfile.WavFileWarning)
        file_rate, data = wavfile.read(path)
    if np.issubdtype(data.dtype, np.integer):
        half = 2.0 ** (8 * data.dtype.itemsize - 1)
        precise = np.float32 if data.dtype.itemsize < 3 else np.float64
        data = (data.astype(precise) - (half if data.dtype == np.uint8 else 0.0)) / precise(half)
    time = np.arange(len(data)) / file_rate
    for k, values in enumerate(data.reshape(len(data), -1).T, 1):
        yield Recorded(f"channel {k}", "", time, values)


def _read_mf4(path: Path, rate: float | None) -> Iterator[Recorded]:
    with optional_module("asammdf", "mf4").MDF(path) as file:
        for signal in file.iter_channels():
            if signal.samples.ndim == 1 and np.issubdtype(signal.samples.dtype, np.number):
                yield Recorded(signal.name, signal.unit or "", np.array(signal.timestamps, float), np.array(signal.samples))


def _read_mat(path: Path, rate: float | None) -> Iterator[Recorded]:
    scipy_io = optional_module("scipy.io", "mat")
    objects: list[str] = []
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            content = scipy_io.loadmat(path, squeeze_me=True)
        arrays = dict(_flat({k: v for k, v in content.items() if not k.startswith("__")}, "", objects))
    except NotImplementedError:  # version 7.3
        with optional_module("h5py", "mat").File(path) as file:
            arrays = dict(_flat_hdf(file, "", objects))
    scalars = {name.lower(): float(value) for name, value in arrays.items() if value.size == 1}
    stated = next((scalars[name] for name in _RATE_NAMES if scalars.get(name, 0.0) > 0.0), None)
    clocks = _clocks_of_arrays(arrays, stated)
    has_channel = False
    for name, value in arrays.items():
        if name in clocks or value.size < 2:
            continue
        columns = [value] if value.ndim == 1 else list(value if value.shape[0] < value.shape[1] else value.T)
        folder = name.rpartition(".")[0]
        candidates = [clock for each, clock in clocks.items() if each.rpartition(".")[0] == folder] or list(clocks.values())
        for k, column in enumerate(columns):
            matching = next((clock for clock in candidates if clock.size == column.size), candidates[0] if candidates else None)
            time = np.asarray(matching, float) if matching is not None else np.arange(column.size) / stated if stated else None
            has_channel = True
            yield Recorded(name if len(columns) == 1 else f"{name}[{k}]", "", time, column)
    if objects and not has_channel:
        raise InputError(
            str(path),
            f"holds objects of MATLAB ({', '.join(objects[:5])}), such as timetables or Simulink data, which only MATLAB can "
            "read; in MATLAB, save arrays, for example t = x.Time; a = x.Data; save('run.mat', 't', 'a')",
        )


def _clocks_of_arrays(arrays: dict[str, np.ndarray], rate: float | None) -> dict[str, np.ndarray]:
    """Return the arrays of times by their dotted names. If the file states a sampling rate, `rate`, Hz, an array T contains
    times only if its step agrees with this rate."""
    folders: dict[str, list[tuple[str, str]]] = {}
    for name, value in arrays.items():
        folder, _, last = name.rpartition(".")
        if value.ndim != 1 or (last == "T" and rate is not None and abs(rate * np.median(np.diff(value)) - 1.0) > 0.01):
            continue
        folders.setdefault(folder, []).append((last, name))
    names = [inside[k][1] for inside in folders.values() for k in _clocks([(last, "") for last, _ in inside])]
    return {name: arrays[name] for name in names}


def _flat(value: Any, name: str, objects: list[str]) -> Iterator[tuple[str, np.ndarray]]:
    """Yield dotted names and arrays of numbers of variables and structures; names of objects are appended to `objects`."""
    if type(value).__name__ in ("MatlabOpaque", "MatlabFunction", "MatlabObject"):
        objects.append(name if name not in ("", "None") else "a variable without a name")
        return
    array = np.asarray(value)
    if isinstance(value, dict) or (array.dtype.names is not None and array.ndim == 0):
        for key in value if isinstance(value, dict) else array.dtype.names or ():
            yield from _flat(
                value[key] if isinstance(value, dict) else array[key][()], f"{name}.{key}" if name else key, objects
            )
    elif array.dtype.kind in "iufb" and array.ndim <= 2:
        yield name, array


def _flat_hdf(group: Any, name: str, objects: list[str]) -> Iterator[tuple[str, np.ndarray]]:
    """Yield dotted names and arrays of numbers of a file of version 7.3; names of objects are appended to `objects`."""
    for key, item in group.items():
        if key.startswith("#"):  # storage of references and of objects
            continue
        item_name = f"{name}.{key}" if name else key
        kind = item.attrs.get("MATLAB_class", b"")
        kind = kind.decode() if isinstance(kind, bytes) else str(kind)
        if "MATLAB_object_decode" in item.attrs or kind in ("timetable", "table", "timeseries", "string"):
            objects.append(item_name)
        elif hasattr(item, "items"):
            yield from _flat_hdf(item, item_name, objects)
        elif item.dtype.kind in "iuf" and kind not in ("char", "cell") and item.ndim <= 2:
            yield item_name, np.squeeze(item[()])


_READERS = {
    ".tdms": _read_tdms,
    **dict.fromkeys((".uff", ".unv", ".uf", ".58"), _read_uff),
    ".mat": _read_mat,
    ".wav": _read_wav,
    **dict.fromkeys((".mf4", ".mdf"), _read_mf4),
}

_NAMES = {_read_tdms: "TDMS", _read_uff: "UFF", _read_mat: "MATLAB", _read_wav: "WAV", _read_mf4: "MF4"}
