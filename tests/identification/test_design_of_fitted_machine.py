"""Design of a machine that was identified: the foundation force at the jam, with the interval from the fit."""

import equinox as eqx
import numpy as np
import pytest
from run_ups_by_scipy import TRUTH, accelerations, record, scene_of

import jaxvib as jv
from jaxvib.machine.numbers.named import find_number, put_numbers
from optimize import DesignSpace, foundation_force, synthesize

T = 0.002 * np.arange(8000)


@pytest.mark.slow
def test_force_of_the_optimum_has_the_spread_of_sampled_machines():
    run = record(T, accelerations(T, [TRUTH])[0], 0.4, np.random.default_rng(0))
    names = ["machine.mass", "machine.stiffness", "machine.damping", "machine.link_stiffness", "machine.link_damping"]
    known = {"machine.mass[1]": "95 kg +- 1 %", "exciters[0].unbalance": "0.05 kg m +- 1 %"}
    fit = jv.identify(scene_of(TRUTH), run, unknown=names, known=known)
    assert fit.status_name == "found"

    loads, drive = jv.balls(count=3, mass=0.8, radius=0.12, drag=1.5), jv.ConstantSpeed("1500 rpm")
    space = DesignSpace(jv.Scene(fit.scene.machine, loads, drive), free={"machine.stiffness": ("20 N/mm", "90 N/mm")}, hold=[])
    best = synthesize(space, foundation_force(mode=3), starts=4, iterations=20, verify=False)
    springs, force = best.scene.machine.stiffness, foundation_force(mode=3)

    def of_design(scene):
        machine = eqx.tree_at(lambda machine: machine.stiffness, scene.machine, springs)
        return float(force(jv.Scene(machine, loads, drive)))

    expected = fit.interval_of(of_design)
    np.testing.assert_allclose(expected.value, of_design(fit.scene), rtol=1e-12)
    numbers = tuple(find_number(fit.scene, name, "unknown") for name in fit.names)
    values = np.array([each.value for each in fit.estimates])
    draws = np.random.default_rng(1).multivariate_normal(np.zeros(values.size), fit.covariance, size=400)
    forces = np.array([of_design(put_numbers(fit.scene, numbers, values * np.exp(draw))) for draw in draws])
    np.testing.assert_allclose(expected.error, np.std(forces), rtol=0.15)
    assert 0.92 < np.mean((forces > expected.low) & (forces < expected.high)) < 0.98
