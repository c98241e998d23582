"""The design layer: what may change, what is held, what is found."""

import inspect

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import published, scene

import jaxvib as jv
from optimize import (
    DesignSpace,
    Quantity,
    amplitude,
    force_per_amplitude,
    foundation_force,
    hold,
    jam_frequency,
    load_design,
    support_frequency_squared,
    synthesize,
    total,
    total_mass,
    worst,
)
from optimize.files import TEMPLATES as DESIGNS

FREE = {"machine.stiffness": (0.01, 0.3), "machine.link_stiffness": (0.1, 1.0)}


def antiphase_space(damping, **more):
    """A machine far from the antiphase one; jam frequency 1 and n1^2 + n2^2 = 2/9 are held."""
    start = published(damping=damping, natural=(0.2, 0.4), **more).scene()
    return DesignSpace(start, FREE, [hold(jam_frequency(mode=3), 1.0), hold(support_frequency_squared(), 2 / 9)])


def ratios(space, found):
    """n2/n1 of the machine where each search ended; with rho = 1 that is the root of the stiffnesses' ratio."""
    stiffness = jax.vmap(lambda z: space.at(z).machine.stiffness)(jnp.asarray(found.designs))
    return np.sqrt(np.asarray(stiffness[:, 1] / stiffness[:, 0]))


@pytest.fixture(scope="module")
def light():
    """200 random starts at dimensionless damping 1e-4, on mode 3 at rotor speed 3."""
    space = antiphase_space(1e-4)
    return space, synthesize(space, force_per_amplitude(mode=3), starts=200, verify=False)


def test_random_starts_find_the_antiphase_machine(light):
    space, found = light
    assert found.starts == 200
    assert found.same >= 190
    assert np.mean(np.abs(ratios(space, found) - 1.0) < 0.02) >= 0.95
    assert found.converged >= 190


def test_held_quantities_keep_their_values(light):
    space, found = light
    for z in found.designs[::40]:
        s = space.at(jnp.asarray(z))
        assert abs(float(jam_frequency(mode=3)(s)) - 1.0) < 1e-7
        assert abs(float(support_frequency_squared()(s)) * 4.5 - 1.0) < 1e-7
    assert np.all((found.designs >= 0.0) & (found.designs <= 1.0))


def test_best_design_is_the_minimum_of_a_dense_scan(light):
    """Two quantities held leave a curve of machines; the search's winner is its lowest point."""
    _, found = light

    def on_curve(angle):
        """n1, n2 from the angle; the link is what brings the jam to frequency 1, found by halving."""
        n1, n2 = np.sqrt(2 / 9) * np.cos(angle), np.sqrt(2 / 9) * np.sin(angle)

        def build(link):
            return published(damping=1e-4, natural=(n1, n2), link_natural=link).scene()

        low, high = 0.55, 0.8
        for _ in range(50):
            middle = (low + high) / 2.0
            low, high = (middle, high) if float(jam_frequency(mode=3)(build(middle))) < 1.0 else (low, middle)
        return float(force_per_amplitude(mode=3)(build((low + high) / 2.0)))

    best = np.arctan2(*np.sqrt(found.after.parameters["machine.stiffness"])[::-1])
    scan = [on_curve(a) for a in best + np.array([-0.2, -0.01, -1e-4, 0.0, 1e-4, 0.01, 0.2])]
    assert np.argmin(scan) == 3
    np.testing.assert_allclose(scan[3], found.after.force_per_amplitude, rtol=1e-5)


def test_antiphase_ratio_tends_to_one_without_damping():
    off = []
    for damping in (1e-3, 1e-4, 1e-5):
        space = antiphase_space(damping)
        found = synthesize(space, force_per_amplitude(mode=3), starts=8, verify=False)
        off.append(abs(ratios(space, found)[int(np.argmin(found.values))] - 1.0))
    assert off[0] > 2.0 * off[1] > 4.0 * off[2]
    assert off[2] < 5e-3


def test_best_design_agrees_with_the_full_equations():
    found = synthesize(antiphase_space(1e-2), force_per_amplitude(mode=3), starts=8)
    assert found.verified is not None and found.run is not None
    assert found.run.drift < 1e-6
    np.testing.assert_allclose(found.verified.omega, found.after.omega, rtol=1e-3)
    np.testing.assert_allclose(found.verified.amplitude, found.after.amplitude, rtol=1e-3)
    np.testing.assert_allclose(found.verified.force_per_amplitude, found.after.force_per_amplitude, rtol=1e-2)
    first, second = np.asarray(found.run.window.state.displacement).T
    measured = float(found.run.foundation_force) / (0.5 * np.ptp(first - second))
    np.testing.assert_allclose(found.verified.force_per_amplitude, measured, rtol=1e-5)
    assert found.after.force_per_amplitude < found.before.force_per_amplitude / 5.0
    assert "this does not show that a start from rest reaches it" in found.summary() and "not verified" not in found.summary()
    assert len(found.plot().axes) == 1 and len(found.plot_convergence().axes) == 1


def test_same_seed_gives_the_same_result():
    space = antiphase_space(1e-2)
    one, two = (synthesize(space, force_per_amplitude(mode=3), starts=4, seed=7, verify=False) for _ in range(2))
    np.testing.assert_array_equal(one.designs, two.designs)
    np.testing.assert_array_equal(one.history, two.history)


def test_without_held_quantities_the_best_may_lie_on_a_bound():
    s = scene("two_mass")
    space = DesignSpace(s, {"machine.stiffness[0]": (1e4, 1e5), "loads.drag": (1.0, 2.0)})
    found = synthesize(space, -amplitude(mode=3, of=1), starts=8, verify=False)
    grid = [
        float(amplitude(mode=3, of=1)(space.at(jnp.array([a, b])))) for a in np.linspace(0, 1, 9) for b in np.linspace(0, 1, 9)
    ]
    assert -found.values.min() >= max(grid) - 1e-12
    assert found.done.any()


def test_one_mass_amplitude_is_that_of_its_platform():
    s = jv.Scene(
        jv.one_mass(mass=50.0, stiffness=4e4, damping=100.0),
        jv.balls(count=1, mass=0.5, radius=0.1, drag=0.5),
        jv.ConstantSpeed(60.0),
    )
    jam = jv.jam_modes(s).select(1)
    np.testing.assert_allclose(force_per_amplitude(mode=1)(s), jam.foundation_force / jam.amplitude[0], rtol=1e-14)


def test_design_vector_and_scene_are_inverse():
    s = scene("three_mass", "pendulums")
    space = DesignSpace(s, {"machine.mass": (1.0, 100.0), "loads.mass[2]": (0.1, 2.0), "drive.speed": ("600 rpm", "3000 rpm")})
    z = jnp.linspace(0.1, 0.9, space.size)
    np.testing.assert_allclose(space.where(space.at(z)), z, rtol=1e-12)
    np.testing.assert_allclose(space.at(space.where(s)).machine.mass, s.machine.mass, rtol=1e-12)
    assert set(space.parameters(s)) == {"machine.mass", "loads.mass[2]", "drive.speed"}
    assert space.at(z).loads.mass[0] == s.loads.mass[0]


def test_gradient_of_a_quantity_is_that_of_finite_differences():
    s = published(damping=0.01).scene()
    for quantity in (force_per_amplitude(mode=3), foundation_force(mode=3), jam_frequency(mode=3), amplitude(mode=3, of=2)):

        def value(k, quantity=quantity):
            return quantity(eqx.tree_at(lambda s: s.machine.stiffness, s, k))

        k = s.machine.stiffness
        step = 1e-6  # halves of the digits: truncation 1e-9, rounding 1e-9 of the value
        finite = [(value(k.at[i].add(step)) - value(k.at[i].add(-step))) / (2 * step) for i in range(2)]
        exact = jax.grad(value)(k)
        np.testing.assert_allclose(exact, finite, rtol=1e-6, atol=1e-7 * float(value(k)))


def space_of(free, held=()):
    return DesignSpace(scene("two_mass"), free, held)


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: space_of({}), "free is empty"),
        (lambda: space_of({"machine.stifness": (1, 2)}), "did you mean 'machine.stiffness'"),
        (lambda: space_of({"machine.stiffness[5]": (1, 2)}), "machine.stiffness has 2 entries"),
        (lambda: space_of({"loads.drag[0]": (1, 2)}), "loads.drag has 1 entries"),
        (lambda: space_of({"machine.stiffness": (2.0, 1.0)}), "the first must be less than the second"),
        (lambda: space_of({"machine.stiffness": (-2.0, 1.0)}), "it must be at least 0"),
        (lambda: space_of({"machine.stiffness": ("1 kg", "2 kg")}), "is not in N/m"),
        (lambda: space_of({"machine.stiffness": 3.0}), "give the bounds as (low, high)"),
        (lambda: space_of({"machine.stiffness": (1, 2), "machine.stiffness[0]": (1, 2)}), "is free already"),
        (lambda: space_of({"loads.drag": (1, 2)}, [hold(total("machine.stiffness"))]), "more free parameters than held"),
        (lambda: space_of({"machine.stiffness": (1, 2)}, [jam_frequency(mode=3)]), "wrap quantities in optimize.hold"),
        (lambda: hold(jam_frequency(mode=3), 0.0), "must differ from 0"),
        (lambda: hold(3.0), "must be a Quantity"),
        (lambda: synthesize(space_of({"loads.drag": (1, 2)}), 3.0), "must be a Quantity"),
        (lambda: synthesize(space_of({"loads.drag": (1, 2)}), foundation_force(mode=9)), "numbered 1 to 5"),
        (lambda: synthesize(space_of({"loads.drag": (1, 2)}), amplitude(mode=3, of=(1, 1))), "pair of different platforms"),
        (lambda: synthesize(space_of({"loads.drag": (1, 2)}), amplitude(mode=3, of=4)), "from 1 to 2"),
        (lambda: synthesize(space_of({"loads.drag": (1, 2)}), foundation_force(mode=3), starts=0), "starts is 0"),
        (lambda: synthesize(space_of({"loads.drag": (1, 2)}), foundation_force(mode=3), rate=2.0), "rate is 2.0"),
    ],
)
def test_wrong_designs_raise_clear_errors(make, says):
    with pytest.raises(jv.InputError) as caught:
        make()
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)


def test_search_without_a_start_has_a_named_status():
    space = DesignSpace(published(speed=0.3).scene(), {"machine.stiffness": (0.1, 0.3)})
    with pytest.raises(jv.ComputationError) as caught:
        synthesize(space, foundation_force(mode=4), starts=4)
    assert caught.value.status == "no_feasible_start"


def test_quantities_of_users_can_be_objectives():
    space = DesignSpace(scene("two_mass"), {"machine.stiffness": (1e4, 1e5)})
    wish = Quantity("distance", "N/m", lambda s, modes: jnp.sum((s.machine.stiffness - 3e4) ** 2))
    found = synthesize(space, wish, starts=4)
    np.testing.assert_allclose(found.after.parameters["machine.stiffness"], [3e4, 3e4], rtol=1e-3)
    assert found.verified is None


def test_design_file_is_read(tmp_path):
    (tmp_path / "machine.toml").write_text(jv.scene_to_toml(scene("two_mass")))
    (tmp_path / "design.toml").write_text(DESIGNS["design"])
    design = load_design(tmp_path / "design.toml")
    assert design.space.size == 3
    assert design.objective.name == "force_per_amplitude" and design.objective.of == (1, 2)
    assert [h.quantity.name for h in design.space.held] == ["jam_frequency", "support_frequency_squared"]
    np.testing.assert_allclose(design.space.held[0].value, 570 * np.pi / 30)
    assert design.search == {"starts": 256, "seed": 0}
    more = (
        DESIGNS["design"]
        .replace("# tolerances", "tolerances")
        .replace("# statistic", "statistic")
        .replace("# [[demand]] ", "[[demand]]  ")
    )
    for name in ('quantity = "amplitude"', "mode = 3", "of = [1, 2]", "at_least", "tier"):
        more = more.replace(f"# {name}", name)
    more = more.replace("# [choices]", "[choices]").replace('# "loads.count"', '"loads.count"')
    (tmp_path / "design.toml").write_text(more)
    design = load_design(tmp_path / "design.toml")
    assert [d.words for d in design.subject_to] == ["amplitude of platform 1 against 2, mode 3, exact at least 2 mm"]
    assert design.space.counts == (2, 3, 4) and design.objective.words.startswith("worst (highest) force per amplitude")
    every = (
        DESIGNS["design"].replace("# iterations", "iterations").replace("# rate", "rate").replace("# polishing", "polishing")
    )
    (tmp_path / "design.toml").write_text(every)
    search = load_design(tmp_path / "design.toml").search
    assert search == {"starts": 256, "seed": 0, "iterations": 100, "rate": 0.05, "polishing": 12}
    defaults = {name: each.default for name, each in inspect.signature(synthesize).parameters.items()}
    assert all(defaults[name] == value for name, value in search.items())


DESIGN = """
scene = "machine.toml"
[free]
"machine.stiffness[0]" = [1e4, 9e4]
"loads.drag" = [1.0, 2.0]
[ties]
"machine.stiffness[1]" = ["machine.stiffness[0]", 0.5]
[[hold]]
quantity = "total"
field = "machine.stiffness"
[[demand]]
quantity = "power"
mode = 3
at_most = "1 kW"
at_least = 5.0
[objective]
quantity = "total_mass"
maximize = true
tolerances = { "machine.mass" = 0.1 }
samples = 8
[search]
starts = 8
seed = 3
"""


def test_design_files_equal_designs_in_python(tmp_path, monkeypatch):
    (tmp_path / "machine.toml").write_text(jv.scene_to_toml(scene("two_mass")))
    (tmp_path / "design.toml").write_text(DESIGN)
    design = load_design(tmp_path / "design.toml")
    assert design.objective.operation == "neg" and design.objective.parts[0].statistic == "expected"
    assert design.objective.parts[0].case.samples == 8 and design.objective.parts[0].case.tolerances == (("machine.mass", 0.1),)
    assert [(d.sense, d.constant) for d in design.subject_to] == [("at most", 1e3), ("at least", 5.0)]
    assert float(design.space.held[0].value) == 8e4  # what it is in the scene
    np.testing.assert_allclose(design.space.at(jnp.array([0.5, 0.0])).machine.stiffness, [5e4, 2.5e4])
    asked = []
    monkeypatch.setattr("optimize.design.synthesize", lambda *what, **how: asked.append((what, how)))
    design.run(seed=9)
    assert asked == [((design.space, design.objective), {"subject_to": design.subject_to, "starts": 8, "seed": 9})]
    (tmp_path / "design.toml").write_text(DESIGN.replace("maximize = true", "maximize = false").replace("samples = 8", ""))
    design = load_design(tmp_path / "design.toml")
    assert design.objective.statistic == "expected" and design.objective.case.samples == 64


def test_worst_machine_of_a_maximum_has_the_least_value(tmp_path):
    (tmp_path / "machine.toml").write_text(jv.scene_to_toml(scene("two_mass")))
    over = 'quantity = "total_mass"\ntolerances = { "machine.mass" = 0.1 }\nsamples = 8\nstatistic = "worst"'
    demand = f"[[demand]]\n{over}\nat_least = 1.0\nat_most = 999.0\n"
    text = f'scene = "machine.toml"\n[free]\n"machine.mass" = [1, 99]\n[objective]\n{over}\nmaximize = true\n{demand}'
    (tmp_path / "design.toml").write_text(text)
    design = load_design(tmp_path / "design.toml")
    least, most = (
        s * float(worst(s * total_mass(), {"machine.mass": 0.1}, samples=8)(design.space.scene)) for s in (-1.0, 1.0)
    )
    assert float(design.objective(design.space.scene)) == -least > -most
    assert [float(d.quantity(design.space.scene)) for d in design.subject_to] == [most, least]
    assert [d.words for d in design.subject_to] == [
        f"worst ({x} kg"
        for x in ("highest) mass of platforms and loads at most 999", "lowest) mass of platforms and loads at least 1")
    ]


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (("[free]", "[fre]"), "did you mean 'free'"),
        (('scene = "machine.toml"', ""), "scene is missing"),
        (('scene = "machine.toml"', 'scene = "no.toml"'), "cannot be read"),
        (('"force_per_amplitude"', '"force"'), "objective.quantity is 'force'"),
        (('quantity = "force_per_amplitude"', "x = 1"), "objective.quantity is missing"),
        (
            ("[objective]", '[[demand]]\nquantity = "stroke"\nat_least = "3 mm"\n[objective]'),
            "demand[0].mode is missing; give the number of a jam mode of the loads; for motors with unbalances use",
        ),
        (("of = [1, 2]", "off = [1, 2]"), "did you mean 'of'"),
        (('value = "570 rpm"', 'value = "570 kg"'), "is not in rad/s"),
        (("mode = 3", 'mode = "three"'), "mode is 'three'"),
        (("starts = 256", "start = 256"), "did you mean 'starts'"),
        (("starts = 256", "starts = 0.5"), "must be a whole number"),
        (("# rate = 0.05", "rate = 2.0"), "search.rate is 2; it must be greater than 0 and less than 1"),
        (("# rate = 0.05", "rate = 0"), "search.rate is 0; it must be greater than 0"),
        (("# rate = 0.05", 'rate = "fast"'), "search.rate is 'fast'"),
        (("[free]", "[free"), "is not a TOML file"),
        (("[objective]", '[[demand]]\nquantity = "power"\nmode = 3\n[objective]'), "demand[0] has no limit"),
        (
            ("[objective]", '[[demand]]\nquantity = "power"\nmode = 3\nequal_to = "3 W"\n[objective]'),
            "demand[0].equal_to is not a demand; a quantity keeps a value by [[hold]]",
        ),
        (("[objective]", '[[demand]]\nquantity = "power"\nmode = 3\nat_most = "3 kg"\n[objective]'), "is not in W"),
        (("[objective]", "[ties]\nx = 3\n[objective]"), "ties.x is not a parameter of this scene"),
        (("[objective]", '[choices]\n"loads.drag" = 3\n[objective]'), "give a list of values"),
        (('# statistic = "worst"', 'tolerances = {}\nstatistic = "worts"'), "objective.statistic is 'worts'"),
        (('# statistic = "worst"', 'statistic = "worst"'), "objective.statistic is used only with tolerances"),
    ],
)
def test_wrong_design_files_raise_clear_errors(tmp_path, change, says):
    (tmp_path / "machine.toml").write_text(jv.scene_to_toml(scene("two_mass")))
    text = DESIGNS["design"].replace(*change)
    (tmp_path / "design.toml").write_text(text)
    with pytest.raises(jv.InputError) as caught:
        load_design(tmp_path / "design.toml")
    assert says in str(caught.value)
