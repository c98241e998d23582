"""The four machines of the guide: files of at most ten lines, equal to the same in Python, that meet their data sheets."""

import pathlib
import re

import jax
import numpy as np
import pytest

import jaxvib as jv
from jaxvib.machine.validation import start_notes

PAGE = (pathlib.Path(__file__).parents[2] / "docs" / "data_sheets.md").read_text(encoding="utf-8")
FILES = dict(re.findall(r"```toml\n# (\w+)\.toml\n(.*?)```", PAGE, flags=re.S))


@pytest.fixture(scope="module")
def scenes():
    """The scenes of the blocks of Python, whose computations are left out."""
    blocks = "\n".join(re.findall(r"```python\n(.*?)```", PAGE, flags=re.S))
    lines = [line for line in blocks.splitlines() if not re.match(r"print|run =|throw =|regime =", line)]
    made = {}
    exec(compile("\n".join(lines), "data_sheets", "exec"), made)
    return {f"my_{name}": made[name] for name in ("screen", "feeder", "table", "rotor")}


@pytest.mark.parametrize("name", FILES)
def test_a_file_of_ten_lines_equals_the_python(name, scenes):
    assert len(FILES[name].strip().splitlines()) <= 10
    from_file = jv.scene_from_toml(FILES[name])
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-12), from_file, scenes[name])
    assert len(FILES) == 4 and len(re.findall(rf"^    jaxvib \w+ {name}\.toml", PAGE, flags=re.M)) == 2


@pytest.mark.parametrize(("name", "stroke", "angle"), [("my_screen", 7.0, 45.0), ("my_feeder", 4.0, 25.0)])
def test_the_deck_has_the_stroke_of_the_data_sheet(name, stroke, angle, scenes):
    regime = jv.synchronous_regimes(scenes[name]).select(0)
    assert bool(regime.stable)
    path = regime.ellipse((0.0, 0.1))
    assert 2e3 * float(path.semi_major) == pytest.approx(stroke, rel=0.12)
    assert np.degrees(float(path.direction)) == pytest.approx(angle, abs=4.0)


@pytest.mark.parametrize("name", ["my_screen", "my_feeder"])
def test_the_motors_lift_their_unbalances(name, scenes):
    assert start_notes(scenes[name]) == []
    weak = PAGE.replace("930 rpm", "970 rpm")
    weak_screen = re.findall(r"```toml\n# my_screen\.toml\n(.*?)```", weak, flags=re.S)[0]
    assert start_notes(jv.scene_from_toml(weak_screen))[0].endswith(
        "needs 32.4 N m, its starting torque is 22.5 N m by Kloss's formula; give that of the catalogue as starting_ratio"
    )
    assert start_notes(jv.scene_from_toml(weak_screen.replace("inertia = 0.6", "inertia = 0.6, starting_ratio = 2.0"))) == []


def test_the_table_has_its_amplitude(scenes):
    jam = jv.jam_modes(scenes["my_table"]).select(1)
    assert bool(jam.stable)
    assert 1e3 * float(jam.amplitude[0]) == pytest.approx(8.0, rel=0.05)
    assert float(jam.omega) * 30.0 / np.pi == pytest.approx(780.0, rel=0.02)


@pytest.mark.slow
def test_the_rotor_is_balanced_by_its_balls(scenes):
    run = jv.simulate(scenes["my_rotor"], "40 s", save="window")
    k, m, w = 5e5, 25.0 + 3 * 0.04, 100.0 * np.pi
    alone = 6e-3 * w**2 / abs(k - m * w**2 + 2j * 0.03 * np.sqrt(k * 25.0) * w)
    assert run.regime.label == "balanced" and alone == pytest.approx(3e-4, rel=0.01)
    assert float(np.max(run.amplitude)) < 1e-3 * alone


def test_the_drag_of_a_wide_bath_is_that_of_the_page(scenes):
    """Larger than the greatest drag with a jam, in a jam; smaller in the balanced motion."""
    oil = dict(radius=0.1, rotor_speed="3000 rpm", ball_radius="11 mm", viscosity="0.5 Pa s", density=870.0)
    jammed, balanced = (float(jv.drag_of("oil", load_speed=speed, **oil)) for speed in ("1350 rpm", "2999.9 rpm"))
    greatest = float(jv.drag_limits(scenes["my_rotor"]).drag[0])
    np.testing.assert_allclose([jammed, balanced, greatest], [1.5, 0.105, 0.36], rtol=0.02)
    assert all(f"{drag} N s/m" in PAGE for drag in ("1.5", "0.1", "0.36"))
