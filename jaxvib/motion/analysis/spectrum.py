"""Spectra of the end of a run, or of successive segments of a run (waterfall diagram)."""

from __future__ import annotations

from typing import Literal

import equinox as eqx
import numpy as np

from jaxvib.boundary import validated
from jaxvib.display import Axes, Drawn, SpeedUnit, quantity_text, speed_text
from jaxvib.equations.linear import estimated_frequencies
from jaxvib.errors import InputError, quoted
from jaxvib.machine.scene import Scene
from jaxvib.machine.scene_field import axis_labels
from jaxvib.motion.analysis.measure import Trajectory
from jaxvib.results.fields import in_unit, names_along
from jaxvib.results.result import Result
from jaxvib.results.status import Computed
from jaxvib.units import count

_ZERO_PADDING_FACTOR = 4
"""Factor by which zero padding reduces the spacing of the computed frequencies. With this factor the heights of peaks are
accurate to 2 %."""

_MAX_FREQUENCY_RATIO = 1.5
"""Largest frequency of spectra, in units of the largest rotor speed."""


class Spectrum(Result):
    """Amplitude spectra of P segments of a run.

    Returned by `Run.spectrum`.

    Each segment is weighted by the Hann window. The height of the peak of a steady vibration is its amplitude, zero to peak,
    within 2 %.

    **Attributes** (P segments, nf frequencies, nd coordinates, nb directions of the force)

    - `time` (P,), s: the middles of the segments
    - `frequency` (nf,), rad/s, up to 1.5 times the largest rotor speed; two vibrations have separate peaks if their
      frequencies differ by at least 4 pi divided by the duration of a segment
    - `amplitude` (P, nf, nd), m (rad for tilts)
    - `force` (P, nf, nb), N, on the foundation
    - `rotor_speeds` (P, E), rad/s, of the E exciters, and `load_speeds` (P, L), rad/s, of the L exciters with loads: means over
      the segments and the loads
    - `resonances` (nd,), rad/s: estimated natural frequencies
    - `coordinates` and `units` (nd,): names of the coordinates, and their units; `directions`: names of the directions of the
      force, if there are several
    """

    status = Computed.done

    time: np.ndarray = eqx.field(metadata=in_unit("s", "segment"))
    frequency: np.ndarray = eqx.field(metadata=in_unit("rad/s", "frequency"))
    amplitude: np.ndarray = eqx.field(metadata=in_unit("m or rad", "segment", "frequency", "coordinate"))
    force: np.ndarray = eqx.field(metadata=in_unit("N", "segment", "frequency", "direction"))
    rotor_speeds: np.ndarray = eqx.field(metadata=in_unit("rad/s", "segment", "exciter"))
    load_speeds: np.ndarray = eqx.field(metadata=in_unit("rad/s", "segment", "exciter_with_loads"))
    resonances: np.ndarray = eqx.field(metadata=in_unit("rad/s", "resonance"))
    coordinates: tuple[str, ...] = eqx.field(static=True, metadata=names_along("coordinate"))
    units: tuple[str, ...] = eqx.field(static=True, metadata=names_along("unit"))
    directions: tuple[str, ...] = eqx.field(default=(), static=True, metadata=names_along("direction"))

    def summary(self) -> str:
        """Return the largest amplitude of each coordinate in the last segment, with its frequency, as text."""
        last = self.amplitude[-1]
        peaks = np.argmax(last, axis=0)
        lines = [
            f"{name}: {quantity_text(last[k, j], unit, 4)} at {speed_text(self.frequency[k])}"
            for j, (name, unit, k) in enumerate(zip(self.coordinates, self.units, peaks, strict=True))
        ]
        return "\n".join(
            [f"{self.time.size} segments; largest amplitudes of the last one, zero to peak:", *(f"  {line}" for line in lines)]
        )

    @validated
    def plot(
        self,
        *,
        show: Literal["displacement", "force"] = "displacement",
        coordinate: str | None = None,
        unit: SpeedUnit | None = None,
        ax: Axes | None = None,
    ) -> Drawn:
        """Plot amplitudes over frequency for one segment, or a waterfall diagram over time for several segments.

        In a waterfall diagram larger amplitudes are darker. Resonances and the speeds of rotor and loads are marked.

        **Arguments**

        - `show`: displacements or the force on the foundation
        - `coordinate`: name of the coordinate that is shown; default: all coordinates, in a waterfall diagram the coordinate
          with the largest amplitude
        - `unit` of frequencies, "rad/s", "rpm" or "Hz"

        **Raises** `InputError` for unknown names of `show`, `coordinate` and `unit`.
        """
        from jaxvib.draw.motion.spectra import spectrum_chart, waterfall_chart  # slow import

        if show not in ("displacement", "force"):
            raise InputError("show", f"is {quoted(show)}; it must be 'displacement' or 'force'")
        if show == "force" and not np.all(np.isfinite(self.force)):
            problem = "is 'force', but the machine is from matrices without a foundation, and its force is unknown"
            raise InputError("show", f"{problem}; use show='displacement'")
        if coordinate is not None and (show == "force" or coordinate not in self.coordinates):
            advice = (
                "a force has no coordinate; leave it out" if show == "force" else f"there are {', '.join(self.coordinates)}"
            )
            raise InputError("coordinate", f"is {quoted(coordinate)}; {advice}")
        series: dict[str, np.ndarray]
        if show == "force":
            names = ["force, N"] if self.force.shape[2] == 1 else ["horizontal force, N", "vertical force, N"]
            series = {name: self.force[:, :, k] for k, name in enumerate(names)}
        else:
            shown = [k for k, name in enumerate(self.coordinates) if coordinate in (None, name)]
            series = {f"{self.coordinates[k]}, m{self.units[k]}": 1e3 * self.amplitude[:, :, k] for k in shown}
        marks = (self.rotor_speeds, self.load_speeds, self.resonances)
        if self.time.size == 1:
            return spectrum_chart(self.frequency, {k: v[0] for k, v in series.items()}, *marks, unit=unit, ax=ax)
        strongest = max(series, key=lambda name: np.max(series[name]))
        return waterfall_chart(self.time, self.frequency, strongest, series[strongest], *marks, unit=unit, ax=ax)


def spectrum_of(scene: Scene, window: Trajectory, trajectory: Trajectory | None, parts: int) -> Spectrum:
    """Return the spectrum of the window of a run if `parts` is 1, otherwise the spectra of `parts` segments of its
    trajectory."""
    count(parts, "parts")
    if parts > 1 and trajectory is None:
        raise InputError("parts", f"is {parts}, but the run saved only its end; simulate with save='all', or give 1")
    source = window if parts == 1 or trajectory is None else trajectory
    time = np.asarray(source.time, float)
    # Neighbouring segments overlap by one half, because the Hann window suppresses the ends of each segment.
    size = time.size if parts == 1 else 2 * time.size // (parts + 1)
    if size < 64:
        raise InputError(
            "parts", f"is {parts}, which leaves {size} samples for each segment; at least 64 are needed; give fewer parts"
        )
    starts = np.linspace(0, time.size - size, parts).astype(int)
    step = float(np.ptp(time)) / (time.size - 1)  # the mean, because single precision rounds each time
    points = _ZERO_PADDING_FACTOR * 2 ** int(np.ceil(np.log2(size)))
    frequency = 2.0 * np.pi * np.fft.rfftfreq(points, step)
    speeds = np.stack([np.asarray(item, float) for item in source.rotor_speeds], axis=1)
    rates = [np.mean(np.asarray(item.rate[0], float), axis=1) for item in source.state.exciters if item.rate]
    top = max(float(np.max(np.abs(speeds))), 1e-300)
    if np.pi / step < _MAX_FREQUENCY_RATIO * top:
        stored = f"is {parts}, but the run has {2.0 * np.pi / (step * top):.2g} states for each turn of the rotor"
        needed = f"{2.0 * _MAX_FREQUENCY_RATIO:g} are needed; simulate with more samples, or give 1"
        raise InputError("parts", f"{stored}, and at least {needed}")
    is_shown = frequency <= _MAX_FREQUENCY_RATIO * top
    weight = np.hanning(size)

    def amplitudes(values: np.ndarray) -> np.ndarray:
        segments = np.stack([values[s : s + size] for s in starts])
        segments = (segments - np.mean(segments, axis=1, keepdims=True)) * weight[:, None]
        return 2.0 / np.sum(weight) * np.abs(np.fft.rfft(segments, points, axis=1))[:, is_shown]

    def means(values: np.ndarray) -> np.ndarray:
        return np.array([np.mean(values[s : s + size], axis=0) for s in starts])

    labels = axis_labels(scene)
    return Spectrum(
        time=np.array([0.5 * (time[s] + time[s + size - 1]) for s in starts]),
        frequency=frequency[is_shown],
        amplitude=amplitudes(np.asarray(source.state.displacement, float)),
        force=amplitudes(np.asarray(source.foundation_force, float)),
        rotor_speeds=means(speeds),
        load_speeds=means(np.stack(rates, axis=1) if rates else np.zeros((time.size, 0))),
        resonances=np.asarray(estimated_frequencies(scene), float),
        coordinates=labels["coordinate"],
        units=labels["unit"],
        directions=labels["direction"],
    )
