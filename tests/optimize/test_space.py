"""Design spaces: scales, catalogues, ties, what is refused."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import scene

import jaxvib as jv
from jaxvib.display import shown_unit
from jaxvib.machine.files import SCREENS, scene_from_toml
from optimize import DesignSpace, hold, jam_frequency, total

SCENE, THREE = scene("two_mass"), scene("three_mass")


@pytest.mark.parametrize(
    ("bounds", "middle"),
    [
        ((1e4, 9e4), 5e4),
        ((1e4, 1e5), 1e4 * 10.0**0.5),  # a factor of 10 and more is divided by ratio
        ((1e4, 9e4, "log"), 3e4),
        ((1e4, 1e6, "even"), 5.05e5),
        ((0.0, 1e6), 5e5),
    ],
)
def test_ranges_are_divided_evenly_or_by_ratio(bounds, middle):
    space = DesignSpace(SCENE, {"machine.stiffness[0]": bounds})
    for z in (jnp.array([0.5]), np.array([0.5])):
        np.testing.assert_allclose(space.numbers(z), [middle], rtol=1e-12)
        np.testing.assert_allclose(space.shares(space.numbers(z)), z, rtol=1e-12)
    np.testing.assert_allclose(space.numbers(np.array([[0.0], [1.0]])), np.array(bounds[:2])[:, None], rtol=1e-12)
    np.testing.assert_array_equal(space.shares(np.array([[-1.0], [1e9]])), [[0.0], [1.0]])
    fixed = space.within(np.array([5e4]), np.array([5e4]))
    np.testing.assert_allclose(fixed.numbers(np.array([0.0])), [5e4])
    np.testing.assert_array_equal(fixed.shares(np.array([5e4])), [0.0])


def test_catalogues_are_sorted_and_unique():
    catalogue = {"machine.stiffness": ["30 N/mm", 1e4, 3e4, 2e4], "loads.count": [4, 2, 4], "loads.drag": [0.0, 2.0]}
    space = DesignSpace(SCENE, {"machine.link_stiffness": (1e5, 3e5)}, choices=catalogue)
    assert space.counts == (2, 4) and space.size == 4
    assert [(c.name, c.values, c.entry) for c in space.choices] == [
        ("machine.stiffness", (1e4, 2e4, 3e4), 1),
        ("machine.stiffness", (1e4, 2e4, 3e4), 2),
        ("loads.drag", (0.0, 2.0), 3),
    ]
    assert space.logs == (False,) * 4
    wide = DesignSpace(SCENE, {}, choices={"machine.stiffness[0]": [1e4, 2e4, 1e5]})
    np.testing.assert_allclose(wide.numbers(np.array([0.5])), [1e4 * 10.0**0.5])
    counts = DesignSpace(SCENE, {"loads.drag": (1.0, 2.0)}, choices={"loads.count": [2, 3]})
    assert counts.choices == () and counts.size == 1


def test_columns_are_interpolated_between_rows():
    rows = {"machine.stiffness[0]": [1e4, 2e4, 4e4], "machine.damping[0]": [30.0, 90.0, 50.0]}
    space = DesignSpace(SCENE, {}, choices={"spring": rows})
    for stiffness, damping in ((1e4, 30.0), (1.5e4, 60.0), (3e4, 70.0), (4e4, 50.0)):
        np.testing.assert_allclose(space.scene_of(jnp.array([stiffness])).machine.damping[0], damping, rtol=1e-12)


def test_the_ends_of_a_catalogue_have_sensitivities_of_rows():
    rows = {"machine.stiffness[0]": [1e4, 2e4, 4e4], "machine.damping[0]": [30.0, 90.0, 50.0]}
    space = DesignSpace(SCENE, {"loads.drag": (1.0, 2.0)}, choices={"spring": rows})
    for stiffness, damping in ((0.99e4, 29.4), (4.04e4, 49.2)):
        np.testing.assert_allclose(space.scene_of(jnp.array([1.0, stiffness])).machine.damping[0], damping, rtol=1e-12)
    assert [word.endswith(" (with its row)") for word, _ in space.words_of_changes()] == [False, True]


def test_ties_follow_in_order():
    ties = {"machine.stiffness[1]": ("machine.stiffness[0]", 2.0), "machine.link_stiffness": ("machine.stiffness[1]", "keep")}
    space = DesignSpace(THREE, {"machine.stiffness[0]": (1e4, 9e4)}, ties=ties)
    built = space.at(jnp.array([0.5]))
    np.testing.assert_allclose(built.machine.stiffness, [5e4, 1e5, 3e3])
    np.testing.assert_allclose(built.machine.link_stiffness, np.array([1e4, 5e3, 2e4]) / 4e4 * 1e5)
    all_of_them = DesignSpace(SCENE, {"machine.stiffness": (1e4, 9e4)}, ties={"machine.damping": ("machine.stiffness", 1e-3)})
    np.testing.assert_allclose(all_of_them.at(jnp.array([0.0, 1.0])).machine.damping, [10.0, 90.0])


def test_order_of_ties_does_not_matter():
    ties = {"machine.stiffness[0]": "machine.stiffness[1]", "machine.stiffness[1]": ("machine.stiffness[2]", 2.0)}
    for order in (ties, dict(reversed(ties.items()))):
        built = DesignSpace(THREE, {"machine.stiffness[2]": (1e4, 9e4)}, ties=order).at(jnp.array([0.5]))
        np.testing.assert_allclose(built.machine.stiffness, [1e5, 1e5, 5e4])


def test_residual_of_a_held_quantity_is_relative():
    space = DesignSpace(SCENE, {"machine.stiffness": (1e4, 9e4)}, [hold(total("machine.stiffness"), "100 N/mm")])
    from optimize.quantities.evaluation import Evaluation

    np.testing.assert_allclose(space.residuals(Evaluation(space.at(jnp.array([0.5, 1.0])))), [0.4], rtol=1e-12)
    kept = DesignSpace(SCENE, {"machine.stiffness": (1e4, 9e4)}, [hold(total("machine.stiffness"))])
    assert float(kept.held[0].value) == 8e4


FREE = {"machine.stiffness": (1e4, 9e4)}


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: DesignSpace(SCENE, {"machine": {"stiffness": (1, 2)}}), "write the whole name in quotes"),
        (lambda: DesignSpace(SCENE, {"loads.drag": (1.0, 2.0, 3.0, 4.0)}), "give the bounds as"),
        (lambda: DesignSpace(SCENE, {"loads.drag": (1.0, 2.0, "ratio")}), "it must be 'log' or 'even'"),
        (lambda: DesignSpace(SCENE, {"loads.drag": (0.0, 2.0, "log")}), "give a low bound greater than 0"),
        (lambda: DesignSpace(SCENE, {"loads.drag": (2.0, 2.0)}), "must be less than the second"),
        (lambda: DesignSpace(SCENE, {}, choices={"loads.drag": []}), "give a list of values"),
        (lambda: DesignSpace(SCENE, {}, choices={"ball": {"loads.drag": [1.0]}}), "choices.ball needs at least two columns"),
        (
            lambda: DesignSpace(
                SCENE, {"loads.mass": (1.0, 2.0)}, choices={"ball": {"loads.drag": [1, 2], "loads.mass": [1, 2]}}
            ),
            "choices.loads.mass is free or chosen already",
        ),
        (lambda: DesignSpace(SCENE, {}, choices={"loads.drag": [1.0, 1.0]}), "has one value"),
        (lambda: DesignSpace(SCENE, {"loads.drag": (1.0, 2.0)}, choices={"loads.drag": [1.0, 2.0]}), "is free already"),
        (lambda: DesignSpace(SCENE, FREE, ties={"machine.stiffness[0]": "loads.drag"}), "is free, chosen or tied already"),
        (lambda: DesignSpace(SCENE, FREE, ties={"machine.damping": 3.0}), "or (name, factor)"),
        (lambda: DesignSpace(SCENE, FREE, ties={"machine.damping": ("a", "b", "c")}), "or (name, factor)"),
        (lambda: DesignSpace(SCENE, FREE, ties={"machine.damping[0]": "machine.damping"}), "is tied to itself"),
        (
            lambda: DesignSpace(
                SCENE, FREE, ties={"loads.mass": "machine.damping[0]", "machine.damping[0]": ("loads.mass", 2.0)}
            ),
            "is tied to itself through",
        ),
        (lambda: DesignSpace(THREE, FREE, ties={"loads.drag": "machine.damping"}), "name a single entry"),
        (lambda: DesignSpace(SCENE, FREE, ties=[1.0]), "ties is [1.0]; it must be a dictionary"),
        (lambda: DesignSpace(SCENE, 3.0), "free is 3.0; it must be a dictionary"),
        (lambda: DesignSpace(None, FREE), "scene is None; it must be a Scene"),
        (lambda: DesignSpace(SCENE, FREE, hold=3), "hold is 3; it must be a list"),
        (lambda: DesignSpace(SCENE, FREE, ties={"loads.drag": ("machine.damping[0]", 0.0)}), "give a number greater than 0"),
        (lambda: DesignSpace(SCENE, FREE, ties={"loads.drag": ("machine.damping[0]", True)}), "give a number greater than 0"),
        (lambda: DesignSpace(SCENE, FREE, ties={"loads.drag": ("machine.damping[0]", "half")}), "give a number greater than 0"),
        (lambda: DesignSpace(SCENE, FREE, [hold(total("machine.stiffness"), 8e4)] * 2), "more free parameters than held"),
        (lambda: DesignSpace(scene(speed=1e-3), FREE, [hold(jam_frequency(mode=5))]), "give the value that it must keep"),
    ],
)
def test_wrong_spaces_raise_clear_errors(make, says):
    with pytest.raises(jv.InputError) as caught:
        make()
    assert says in str(caught.value) and "\n" not in str(caught.value)


def test_tie_to_a_parameter_of_zero_is_refused():
    """Nor where only one of several numbers is."""
    half = eqx.tree_at(lambda s: s.machine.damping, SCENE, jnp.array([0.0, 9.0]))
    ties = {"machine.stiffness": ("machine.damping", "keep")}
    with pytest.raises(jv.InputError, match=r"machine\.damping, which is 0 in the scene"):
        DesignSpace(half, {"loads.drag": (1.0, 2.0)}, ties=ties)


def test_positions_can_be_mirrored_by_a_tie():
    screen = scene_from_toml(SCREENS["linear_screen"])
    name = "exciters[0].at[0]"
    space = DesignSpace(screen, {name: (0.0, 1.0, "even")}, ties={"exciters[1].at[0]": (name, -1.0)})
    np.testing.assert_allclose(space.at(jnp.array([0.25])).exciters[1].position[0], -0.25)
    for factor in (0.0, float("inf")):
        with pytest.raises(jv.InputError, match="give a number other than 0"):
            DesignSpace(screen, {name: (0.0, 1.0)}, ties={"exciters[1].at[0]": (name, factor)})


def test_absent_springs_stay_absent():
    """Zeros of an array are freed, tied and chosen only if they are named."""
    chain = scene("network")  # supports 1e4, 0, 0, 2e4, 1e3
    space = DesignSpace(chain, {"machine.stiffness": (1e3, 9e4, "even"), "loads.drag": (1.0, 2.0)})
    assert space.size == 4 and [place.name for place in space.free[:2]] == ["machine.stiffness[0]", "machine.stiffness[3]"]
    np.testing.assert_allclose(space.at(jnp.array([0.0, 0.5, 1.0, 0.0])).machine.stiffness, [1e3, 0.0, 0.0, 4.55e4, 9e4])
    assert space.words()[1] == ("stiffness of support 4", "N/m")
    chosen = DesignSpace(chain, {"loads.drag": (1.0, 2.0)}, choices={"machine.stiffness": [1e3, 2e3, 9e3]})
    assert [choice.entry for choice in chosen.choices] == [1, 2, 3] and chosen.size == 4
    np.testing.assert_allclose(chosen.low, [1.0, 1e3, 1e3, 1e3])
    for tie in (("machine.stiffness[0]", 0.5), ("machine.stiffness[0]", "keep"), "machine.stiffness[0]"):
        tied = DesignSpace(chain, {"machine.stiffness[0]": (1e4, 9e4)}, ties={"machine.damping": tie})
        np.testing.assert_array_equal(
            np.asarray(tied.at(jnp.array([0.5])).machine.damping) > 0.0, [True, False, False, True, True]
        )
    named = DesignSpace(chain, {"machine.stiffness[1]": (0.0, 1e4)}, ties={"machine.stiffness[2]": "machine.stiffness[1]"})
    np.testing.assert_allclose(named.at(jnp.array([0.5])).machine.stiffness, [1e4, 5e3, 5e3, 2e4, 1e3])
    free = eqx.tree_at(lambda s: s.machine.stiffness, chain, jnp.zeros(5))
    wanted = {"free": ({"machine.stiffness": (1.0, 2.0)}, {}), "choices": ({}, {"machine.stiffness": [1.0, 2.0]})}
    for argument, (bounds, choices) in wanted.items():
        with pytest.raises(
            jv.InputError, match=rf"^{argument}\.machine\.stiffness is 0 in every entry.*machine\.stiffness\[0\]"
        ):
            DesignSpace(free, bounds, choices=choices)
    one = eqx.tree_at(lambda s: s.loads.drag, SCENE, jnp.asarray(0.0))
    assert DesignSpace(one, {"loads.drag": (0.0, 2.0)}).size == 1  # a number that all loads share is named by itself


@pytest.mark.parametrize("wrong", [None, True, 10**400, np.zeros(0), np.zeros((2, 2)), np.ones(2) + 1j, np.ma.masked])
def test_designs_of_wrong_size_are_refused(wrong):
    space = DesignSpace(SCENE, free={"machine.stiffness[0]": (1e4, 9e4), "machine.stiffness[1]": (1e4, 9e4)})
    for ask, name in ((space.at, "z"), (space.scene_of, "values"), (lambda z: space.within(z, z), "low")):
        with pytest.raises(jv.InputError, match=rf"^{name} (is|has) .*(an array|numbers|masked)"):
            ask(wrong)
    with pytest.raises(jv.InputError, match=r"^scene is 3; it must be a Scene"):
        jam_frequency(mode=3)(3)


def test_frequencies_of_a_supply_are_shown_in_hertz():
    motor = jv.NamePlateMotor("7.5 kW", "1470 rpm", 2.5, 0.2, frequency="50 Hz")
    screen = scene_from_toml(SCREENS["circular_screen"])
    screen = eqx.tree_at(lambda s: s.exciters[0].drive, screen, motor)
    space = DesignSpace(screen, {"drive.frequency": ("45 Hz", "60 Hz")})
    ((words, unit),) = space.words()
    name, factor = shown_unit(unit, 314.0)
    assert words.startswith("frequency of the supply") and name == "Hz"
    np.testing.assert_allclose(100.0 * np.pi * factor, 50.0, rtol=1e-12)
