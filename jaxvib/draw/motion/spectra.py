"""Charts of spectra, as lines and as waterfalls, and of paths of points in the plane perpendicular to a rotor's axis."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm

from jaxvib.display import Drawn, SpeedUnit, speed_unit
from jaxvib.draw.style import COLORS, STROKES, axis_unit, color_of, legend_above, panels, resonance_lines, series_look

_LOWEST_AMPLITUDE = 1e-4
"""Lower end of the amplitude scale, relative to the largest amplitude."""


def spectrum_chart(
    frequency: np.ndarray,
    series: Mapping[str, np.ndarray],
    rotor_speeds: np.ndarray,
    load_speeds: np.ndarray,
    resonances: np.ndarray,
    *,
    unit: SpeedUnit | None = None,
    ax: Axes | None = None,
) -> Drawn:
    """Draw spectra as lines, with amplitudes on a logarithmic scale.

    `frequency` has nf values. `series` contains the amplitudes (nf,) of each spectrum by its name, which includes the unit.
    Vertical lines mark the rotor speeds (1, exciters), the load speeds (1, exciters with loads) and the resonances. Frequencies
    and speeds are in rad/s, drawn in `unit`.
    """
    unit, scale = speed_unit(unit)
    figure, (axis,) = panels(1, size=(7.5, 4.0), ax=ax)
    top = max(float(np.max(values)) for values in series.values())
    for k, (name, values) in enumerate(series.items()):
        look = {**series_look(k), "lw": 1.3}
        axis.plot(scale * frequency, values, label=name, **look)
    resonance_lines(axis.axvline, scale * resonances, "resonances")
    marks = (("load speed", load_speeds, (0, (5, 3))), ("rotor speed", rotor_speeds, "-."))
    for name, speeds, stroke in marks:
        for k, speed in enumerate(np.abs(speeds[0])):
            axis.axvline(scale * float(speed), color="black", lw=0.9, ls=stroke, label=None if k else name)
    axis.set(
        yscale="log",
        ylim=(_LOWEST_AMPLITUDE * top, 2.0 * top),
        xlim=(0.0, scale * float(frequency[-1])),
        xlabel=f"frequency, {unit}",
        ylabel="amplitude, zero to peak",
    )
    legend_above(axis)
    return figure if ax is None else ax


def waterfall_chart(
    time: np.ndarray,
    frequency: np.ndarray,
    name: str,
    values: np.ndarray,
    rotor_speeds: np.ndarray,
    load_speeds: np.ndarray,
    resonances: np.ndarray,
    *,
    unit: SpeedUnit | None = None,
    ax: Axes | None = None,
) -> Drawn:
    """Draw amplitudes (P, nf) as shades of grey over P times, s, and nf frequencies.

    `name` is that of the amplitudes, with their unit. The rotor speeds (P, exciters) and the load speeds (P, exciters with
    loads) are drawn as lines, resonances as horizontal lines. Frequencies and speeds are in rad/s, drawn in `unit`.
    """
    unit, scale = speed_unit(unit)
    figure, (axis,) = panels(1, size=(7.5, 4.4), ax=ax)
    top = max(float(np.max(values)), 1e-300)
    shade = axis.pcolormesh(
        time,
        scale * frequency,
        np.maximum(values, _LOWEST_AMPLITUDE * top).T,
        norm=LogNorm(_LOWEST_AMPLITUDE * top, top),
        cmap="Greys",
        shading="nearest",
        rasterized=True,
    )
    figure.colorbar(shade, ax=axis, label=f"{name}, zero to peak")
    axis.grid(False)
    resonance_lines(axis.axhline, scale * resonances, "resonances", color=COLORS[0], lw=1.0)
    marks = (("load speed", load_speeds, COLORS[1], (0, (5, 3))), ("rotor speed", rotor_speeds, COLORS[2], "-."))
    for name, speeds, color, stroke in marks:
        for k, speed in enumerate(np.abs(speeds).T):
            axis.plot(time, scale * speed, color=color, lw=1.4, ls=stroke, label=None if k else name)
    axis.set(ylim=(0.0, scale * float(frequency[-1])), xlabel="time, s", ylabel=f"frequency, {unit}")
    legend_above(axis)
    return figure if ax is None else ax


def path_chart(paths: Mapping[str, tuple[np.ndarray, np.ndarray]], *, ax: Axes | None = None) -> Drawn:
    """Draw paths of points by name: horizontal and vertical coordinates (nt,), m, drawn in mm or µm, with a marker at the last
    point of each path."""
    figure, (axis,) = panels(1, size=(5.0, 4.8), ax=ax)
    unit, factor = axis_unit("m", *(each for path in paths.values() for each in path))
    for k, (name, (x, y)) in enumerate(paths.items()):
        color = color_of(k)
        axis.plot(factor * x, factor * y, color=color, ls=STROKES[k % len(STROKES)], lw=1.2, label=name)
        axis.plot(factor * x[-1:], factor * y[-1:], "o", color=color, mec="black", zorder=3)
    axis.plot([], [], "o", color="white", mec="black", label="end of the path")
    axis.plot([0.0], [0.0], "+", color="black", ms=9.0)
    axis.set_aspect("equal", adjustable="datalim")
    axis.locator_params(nbins=6)
    axis.set(xlabel=f"horizontal, {unit}", ylabel=f"vertical, {unit}")
    legend_above(axis, 2)
    return figure if ax is None else ax
