"""Repeated records of one machine, each fitted from wrong first values: share of intervals that contain the true value, and
errors.

One run-up by SciPy serves all records of a case; noise, gains and first values are drawn for each record.
"""

import dataclasses
import functools
import json
import pathlib

import numpy as np
from run_ups_by_scipy import TRUTH, accelerations, bound, ending_ramp, motor_run_up, ramp, record, scene_of

import jaxvib as jv
from repeated_records import jammed, linearized, supports

TIMES = 0.016 * np.arange(1000)
NOISE, JAMMED_NOISE = 0.05, 0.2
"""Standard deviation of the noise of the accelerometers, m/s^2; the balls excite readings up to 40 m/s^2."""
NAMES = ("machine.stiffness", "machine.damping", "machine.link_stiffness", "machine.link_damping", "exciters[0].unbalance")
SINGLE = tuple(name for name in TRUTH if "mass" not in name)

CASES = {
    "white noise": {},
    "coloured noise, correlation 0.9": {"color": 0.9},
    "2 % outliers, 20 times the noise": {"outliers": 0.02},
    "random gains, standard deviation 1 %": {"gain_error": 0.01},
    "motor whose speed falls at the resonances": {"motor": True},
    "one pulse per turn, times rounded to 1 ms": {"pulses": 1, "resolution": 1e-3},
    "run-up that ends within the record": {"ending": True},
    "readings clipped at 60 % of the largest": {"full_scale": 0.6},
    "two jammed balls and an unbalance": {"balls": True},
    "two jammed balls and an unbalance, without an impact": {"balls": True, "impact": 0.0},
}
"""Options of `record` by the name of a case; `motor`: run-up of a motor in place of the prescribed speed; `ending`: its
acceleration jumps to 0; `balls`: records of `repeated_records.jammed`."""

JAMMED_CASES = {
    "two jammed balls, coloured noise, correlation 0.9": {"balls": True, "color": 0.9},
    "two jammed balls, 2 % outliers": {"balls": True, "outliers": 0.02},
    "two jammed balls, readings clipped at 60 %": {"balls": True, "full_scale": 0.6},
}

SUPPORT_CASES = {"stop": {"support": "stop"}, "cubic support": {"support": "cubic"}, "friction": {"support": "friction"}}
"""Cases of `repeated_records.supports`."""

FACTORS = {
    "stop[0].gap": 1.2, "stop[0].stiffness": 1.3, "cubic": 1.3, "force": 1.3, "stiffness": 1.1, "damping": 1.5,
    "loads.mass": 1.1, "drag": 1.2,
}  # fmt: skip
"""Factors on the first values; the first word in the name of a number counts."""


@dataclasses.dataclass
class Repeated:
    """Fits of repeated records.

    **Attributes** (r records, p numbers): `away` (r, p), distances from the truth relative to the standard error; `relative`
    (r, p), relative errors; `bound` (p,), Cramer-Rao bound; `statuses` (r,); `linear` (r, p), relative errors of the linearized
    fit to the same noise, computed for nonlinear supports and for jammed balls with white noise only.
    """

    away: np.ndarray
    relative: np.ndarray
    bound: np.ndarray
    statuses: np.ndarray
    linear: np.ndarray | None = None

    @property
    def wrong(self):
        """True (r,) for fits that are not near the truth: wrong minima."""
        return np.max(np.abs(self.relative / self.bound), axis=1) > 8.0

    @property
    def held(self):
        """Share (p,) of the intervals that contain the true value, wrong minima left out."""
        return np.mean(np.abs(self.away[~self.wrong]) < 1.96, axis=0)

    @property
    def ratio(self):
        """Standard deviation (p,) of the errors relative to the Cramer-Rao bound, wrong minima left out."""
        return np.sqrt(np.mean(self.relative[~self.wrong] ** 2, axis=0)) / self.bound

    @property
    def error_ratio(self):
        """Standard errors (r, p) of the fits relative to the Cramer-Rao bound."""
        return self.relative / self.away / self.bound

    @property
    def linear_held(self):
        """Share (p,) of the intervals of the linearized fits that contain the true value."""
        return np.mean(np.abs(self.linear / self.bound) < 1.96, axis=0)

    @property
    def from_linear(self):
        """Differences (r, p) between the errors of the fits and those of the linearized fits, relative to the bound.

        With a right method they are small in every record, even if its noise makes the errors large.
        """
        return (self.relative - self.linear) / self.bound

    @property
    def row(self):
        """Row of a table: intervals that contain the true value, standard deviation, wrong minima, those with status
        `found`."""
        found = int(np.sum(self.wrong & (self.statuses == "found")))
        held, share = self.held, np.mean(self.statuses == "found")
        return (
            f"{len(self.wrong)} | {min(held):.1%} to {max(held):.1%} | {max(self.ratio):.2f} | {int(np.sum(self.wrong))} | "
            f"{found} | {share:.0%}"
        )


@functools.cache
def run_up(motor, ending=False):
    """Return the accelerations (n, 2) and the turning of the rotor."""
    turning = ending_ramp if ending else ramp
    return motor_run_up(TIMES, TRUTH) if motor else (accelerations(TIMES, [TRUTH], turning=turning)[0], turning)


def repeated(count, seed=0, motor=False, ending=False, balls=False, support=None, store=None, **options):
    """Return the fits of `count` records from stiffnesses 10 % off and dampings 50 % off, in random directions, see `FACTORS`.

    In records of jammed balls, the mass and the drag of the balls are 10 % and 20 % off. Fits that the file `store` contains
    are not repeated, and each new fit is added to it.
    """
    clean, turning = (jammed.clean(), None) if balls else run_up(motor, ending)
    if "full_scale" in options:
        options = options | {"full_scale": options["full_scale"] * np.max(np.abs(clean))}
    truth, scene = (jammed.TRUTH, jammed.scene_of) if balls else (TRUTH, scene_of)
    names = (*NAMES, "loads.mass", "loads.drag") if balls else NAMES
    if support:
        truth, scene = supports.truth(support), supports.scene_of
        names = [*NAMES, *(name for name in truth if name.startswith("effects") and "width" not in name)]
    fits, runs, path = [], [], pathlib.Path(store) if store else None
    stored = list(map(json.loads, path.read_text().splitlines())) if path and path.exists() else []
    for k in range(count):
        rng = np.random.default_rng([seed, k])
        if balls:
            run = jammed.jammed_record(JAMMED_NOISE, rng, **options)
        elif support:
            run = supports.support_record(support, NOISE, rng, **options)
        else:
            run = record(TIMES, clean, NOISE, rng, turning=turning, **options)
        first = {
            name: value * next((f for word, f in FACTORS.items() if word in name), 1.0) ** rng.choice([-1.0, 1.0])
            for name, value in truth.items()
        }
        runs.append(run)
        if k < len(stored):
            fits.append(stored[k])
            continue
        fit = jv.identify(scene(first), run, unknown=names, throw=False)
        estimates = {name: [each.value, each.error] for name, each in zip(fit.names, fit.estimates, strict=True)}
        fits.append({"status": fit.status_name, "estimates": estimates})
        if path:
            with path.open("a") as file:
                file.write(json.dumps(fits[-1]) + "\n")
    order = tuple(fits[0]["estimates"])
    true, statuses = np.array([truth[name] for name in order]), np.array([each["status"] for each in fits])
    values, errors = np.moveaxis(np.array([list(each["estimates"].values()) for each in fits]), 2, 0)
    away, relative = (values - true) / errors, values / true - 1.0
    linear, is_white = None, options.keys() <= {"impact"}
    options.pop("full_scale", None)
    if support or (balls and is_white):
        estimates = supports.estimator_of_supports(support, order) if support else jammed.estimator_of_loads(order, **options)
        clean = supports.clean_motion(support) if support else jammed.clean(**options)
        least = linearized.bound(estimates, NOISE if support else JAMMED_NOISE)
        linear = np.array([linearized.linear_errors(estimates, run, clean) for run in runs])
    else:
        least = jammed.bound(order, JAMMED_NOISE, **options) if balls else _bound(turning, **options)
    return Repeated(away, relative, least, statuses, linear)


def _bound(turning, color=0.0, gain_error=0.0, outliers=0.0, resolution=0.0, pulses=24, **_):
    """Return the Cramer-Rao bound of a record with known places of outliers, an angle that is known but for a common delay of
    rounded pulses, and without clipping."""
    noise, pulse_error = NOISE / np.sqrt(1.0 - outliers), resolution / np.sqrt(12.0)
    return bound(TIMES, SINGLE, noise, color, gain_error, turning, pulse_error=pulse_error, pulses=pulses)
