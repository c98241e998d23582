"""Arguments of public functions against their annotations."""

import copy
import decimal
import inspect
import pathlib
import pickle
from collections.abc import Callable, Mapping, Sequence
from typing import Literal, Union

import jax
import jax.numpy as jnp
import matplotlib.figure
import numpy as np
import pytest
from jax import Array
from jax.typing import ArrayLike as JaxLike
from numpy.typing import ArrayLike
from scenes import scene

import jaxvib as jv
import optimize
from jaxvib.boundary import Axes, Figure, _alternatives, call_user, is_real, is_whole, validated
from jaxvib.errors import require_path
from jaxvib.units import Number


@validated
def mixed_sum(count: int) -> Array:
    return jnp.zeros(1, complex) + jnp.ones(1) * count


def test_strict_promotion_of_types_is_refused_in_a_sentence():
    assert mixed_sum(2)[0] == 2.0
    message = r"^jax_numpy_dtype_promotion is 'strict'; it must be 'standard'"
    with jax.numpy_dtype_promotion("strict"), pytest.raises(jv.InputError, match=message):
        mixed_sum(2)


@validated
def unpromotable_sum(count: int) -> Array:
    return jnp.zeros(1, jnp.float8_e4m3fn) + count * jnp.ones(1, jnp.bfloat16)


def test_other_errors_of_types_pass_unchanged():
    with pytest.raises(jax.dtypes.TypePromotionError):
        unpromotable_sum(2)


@validated
def question(
    *,
    word: str = "",
    flag: bool = False,
    count: int = 1,
    size: float | None = None,
    side: Literal["left", "right"] = "left",
    path: str | pathlib.Path | None = None,
    make: Callable[[float], float] | None = None,
    sizes: Sequence[float] = (),
    pair: tuple[int, int] | int | None = None,
    shares: Mapping[str, float] | None = None,
    array: Array | None = None,
    scene: jv.Scene | None = None,
    speed: Number = 1.0,
    rows: ArrayLike | None = None,
) -> str:
    return "answered"


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ({"word": 3}, "word is 3; it must be a string"),
        ({"flag": 1}, "flag is 1; it must be True or False"),
        ({"count": True}, "count is True; it must be a whole number"),
        ({"count": 2.0}, "count is 2.0; it must be a whole number"),
        ({"count": 10**400}, "count is a whole number of 1329 bits; it must be a whole number of up to 63 bits"),
        ({"count": np.timedelta64(3, "s")}, "count is np.timedelta64(3,'s'); it must be a whole number"),
        ({"size": "3"}, "size is '3'; it must be a number"),
        ({"size": float("nan")}, "size is nan; it must be a number, not NaN"),
        ({"size": 1j}, "size is 1j; it must be a number"),
        ({"size": 10**400}, "size is a whole number of 1329 bits; it must be a number below 1e308"),
        ({"size": jnp.asarray(True)}, "size is Array(True, dtype=bool); it must be a number"),
        ({"side": None}, "side is None; it must be 'left' or 'right'"),
        ({"side": ["left"]}, "side is ['left']; it must be 'left' or 'right'"),
        ({"path": 3}, "path is 3; it must be the path of a file"),
        ({"path": "a\0b"}, r"path is 'a\x00b'; a path cannot contain the character NUL or a lone surrogate"),
        ({"path": ""}, "path is empty; it must be the path of a file"),
        ({"path": "x" * 5000}, f"path has 5000 characters and begins with '{'x' * 55} ...; a path has 4096 at most"),
        ({"make": 3}, "make is 3; it must be a function"),
        ({"sizes": 3.0}, "sizes is 3.0; it must be a list of numbers"),
        ({"sizes": "12"}, "sizes is '12'; it must be a list of numbers"),
        ({"sizes": [1.0, [2.0]]}, "sizes[1] is [2.0]; it must be a number"),
        ({"sizes": range(10**9)}, "sizes is range(0, 1000000000); it must be a list of at most 10000000 entries"),
        ({"sizes": np.zeros((2, 1))}, "sizes[0] is [0.0]; it must be a number"),
        ({"sizes": np.ma.array([1.0, 2.0], mask=[0, 1])}, "sizes is masked_array(data=[1.0, --],"),
        ({"array": float("nan")}, "array is nan; it must be a number or an array of numbers, not NaN"),
        ({"array": decimal.Decimal("NaN")}, "array is Decimal('NaN'); it must be a number or an array of numbers, not NaN"),
        ({"pair": (1, 2, 3)}, "pair is (1, 2, 3); it must be 2 values or a whole number"),
        ({"pair": (1, "a")}, "pair[1] is 'a'; it must be a whole number"),
        ({"shares": [1.0]}, "shares is [1.0]; it must be a dictionary"),
        ({"shares": {"a": True}}, "shares.a is True; it must be a number"),
        ({"shares": {1: 2.0}}, "shares is {1: 2.0}; it must be a dictionary of names, not of 1"),
        ({"array": [[1.0], [2.0, 3.0]]}, "array is [[1.0], [2.0, 3.0]]; it must be an array of numbers"),
        (
            {"array": jnp.asarray(1j)},
            "array is Array(0.+1.j, dtype=complex128, weak_type=True); it must be an array of numbers",
        ),
        ({"rows": [[1.0], [2.0, 3.0]]}, "rows is [[1.0], [2.0, 3.0]]; it must be an array of numbers"),
        ({"rows": [[0.5, True]]}, "rows is [[0.5, True]]; it must be an array of numbers, without Booleans"),
        ({"array": [0.5, True]}, "array is [0.5, True]; it must be an array of numbers, without Booleans"),
        ({"rows": [np.ones(1), np.ones(1, bool)]}, "rows is [array([1.]), array([ True])]; it must be an array of numbers"),
        ({"rows": True}, "rows is True; it must be an array of numbers"),
        ({"rows": np.ones(2) + 1j}, "rows is array([1.+1.j, 1.+1.j]); it must be an array of numbers"),
        ({"scene": None, "count": None}, "count is None; it must be a whole number"),
        ({"scene": "machine.toml"}, "scene is 'machine.toml'; it must be a Scene, for example load_scene('machine.toml')"),
    ],
)
def test_an_argument_of_another_type_ends_in_a_sentence(arguments, sentence):
    with pytest.raises(jv.InputError) as caught:
        question(**arguments)
    assert str(caught.value).startswith(sentence)


def test_a_traced_whole_number_is_refused():
    sentence = r"^count is .*Tracer.*; it must be a whole number that is known outside of jit, grad and vmap"
    with pytest.raises(jv.InputError, match=sentence):
        jax.eval_shape(lambda count: len(question(count=count)), 3)


def test_arguments_of_the_right_types_pass():
    kept = dict(word="a", flag=np.True_, count=np.int64(3), size=np.float32(2.0), side="right", path=pathlib.Path("x"))
    more = dict(make=len, sizes=(1.0, np.float64(2.0)), pair=(1, 2), shares={"a": 1}, array=jnp.ones(2), speed="3 rpm")
    assert question(**kept, **more) == question(sizes=np.ones(3), rows=[[1.0], [2.0]], pair=3) == "answered"
    assert jax.jit(lambda x: x * (question(size=x, array=x, sizes=[x]) == "answered"))(2.0) == 2.0


@validated
def passed(*, array: Array | None = None, either: Array | Sequence[float] = (), rows: JaxLike | None = None) -> object:
    return next(value for value in (array, rows, either) if value is not None)


def test_a_list_for_an_array_becomes_an_array_of_floats():
    for given in ([1, 2], (1, 2)):
        found = passed(array=given)
        assert isinstance(found, np.ndarray) and found.dtype == float and found.tolist() == [1.0, 2.0]
    assert passed(array=decimal.Decimal("1.5")) == np.asarray(1.5)
    assert passed(either=[1, 2]) == [1, 2] and passed(rows=[[1], [2]]).tolist() == [[1.0], [2.0]]
    with pytest.raises(jv.InputError, match=r"^rows is \[\[1\], 2\]; it must be an array of numbers"):
        passed(rows=[[1], 2])


def test_whole_numbers_fit_into_an_array():
    assert question(count=2**63 - 1) == question(count=1 - 2**63) == "answered"
    with pytest.raises(jv.InputError, match=r"^count is 9223372036854775808; it must be a whole number"):
        question(count=2**63)


@validated
def twice(sizes: Sequence[float] = ()) -> list[float]:
    return [2.0 * size for size in sizes] if sizes else [0.0]


def test_an_array_in_place_of_a_list_becomes_a_list():
    assert twice(np.zeros(0)) == [0.0] and twice(np.ones(2)) == twice(jnp.ones(2)) == [2.0, 2.0]


@validated
def drawn_on(ax: Axes, figure: Figure | None = None) -> str:
    return "drawn"


def test_objects_of_matplotlib_are_known_without_its_import():
    figure = matplotlib.figure.Figure()
    assert drawn_on(figure.subplots(), figure) == "drawn"
    with pytest.raises(jv.InputError, match=r"^ax is <Figure .*>; it must be an Axes, of matplotlib$"):
        drawn_on(figure)
    with pytest.raises(jv.InputError, match=r"^figure is 3; it must be a Figure, of matplotlib$"):
        drawn_on(figure.axes[0], 3)


def test_figures_of_a_report_are_checked_before_it_is_written(tmp_path):
    modes = jv.jam_modes(scene())
    for figures in (np.zeros((2, 2)), [("a", 1)], [None]):
        with pytest.raises(jv.InputError, match=r"^figures\[0\]"):
            jv.html_report(modes, tmp_path / "page.html", figures=figures)
    assert not list(tmp_path.iterdir())
    assert "a?b" in jv.html_report(modes, tmp_path / "page.html", title="a\ud800b", figures=()).read_text()


def test_users_functions_that_cannot_be_called_are_named():
    for wrong in (lambda: 1.0, int):
        with pytest.raises(jv.InputError, match=r"^make cannot be called with 2 values"):
            call_user(wrong, "make", "a", None)
    with pytest.raises(jv.InputError, match=r"^make needs the value of a number that JAX traces"):
        jax.jit(lambda x: call_user(int, "make", x))(1.0)


def test_a_users_functions_own_error_passes():
    with pytest.raises(TypeError, match=r"^unsupported operand"):
        call_user(lambda x: x + None, "make", 1.0)


def test_an_unknown_name_remains_a_type_error():
    with pytest.raises(TypeError, match="unexpected keyword argument 'colour'"):
        question(colour="red")


@pytest.mark.parametrize(
    ("make", "name", "says"),
    [
        (jv.pendulums, "length", r"^pendulums\(\) .* 'length'; allowed: count, mass, radius, drag, inertia$"),
        (jv.balls, "radious", r"^balls\(\) .*; did you mean 'radius'\? allowed: count, "),
        (jv.ConstantSpeed, "sped", r"^ConstantSpeed\(\) .*; did you mean 'speed'\? allowed: speed$"),
        (jv.Spin, "rotatoin", r"^Spin\(\) .*; allowed: "),
        (jv.Scene, "exciter", r"^Scene\(\) .*; did you mean 'exciters'\? "),
        (jv.simulate, "untill", r"^simulate\(\) .*; did you mean 'until'\? "),
    ],
)
def test_unknown_names_of_arguments_are_explained(make, name, says):
    with pytest.raises(TypeError, match=says):
        make(**{name: 1.0})


PUBLIC = {name: getattr(package, name) for package in (jv, optimize) for name in package.__all__}


def is_made_by_call(public):
    """Return False for values, and for exceptions and enumerations, which users do not make."""
    return (
        callable(public) and not (isinstance(public, type) and issubclass(public, Exception)) and not hasattr(public, "promote")
    )


@pytest.mark.parametrize("name", sorted(name for name, public in PUBLIC.items() if is_made_by_call(public)))
def test_every_public_callable_explains_unknown_names(name):
    with pytest.raises(TypeError, match=rf"^{name}\(\) .* 'no_such'; (did you mean .*allowed|allowed|it has no arguments)"):
        PUBLIC[name](no_such=1.0)


@pytest.mark.parametrize("named", [jv.Tolerance(1e-6), jv.Vibration(*jv.Vibration._fields)])
def test_classes_with_explained_names_remain_classes(named):
    kind = type(named)
    assert isinstance(kind, type) and pickle.loads(pickle.dumps(named)) == named and copy.copy(named) == named
    assert "args" not in inspect.signature(kind).parameters


def test_numbers_and_paths_are_known_by_their_kind():
    assert is_real(2) and is_real(np.ones(3, np.float16)) and is_real(jnp.ones(2, jnp.bfloat16)) and is_whole(np.int8(1))
    assert not any(map(is_real, (True, 1j, "1", None, np.datetime64("2020"), np.asarray([True], dtype=object))))
    assert not is_whole(True) and not is_whole(np.timedelta64(1, "s")) and not is_whole(1.0)
    for wrong in (b"a", "", "a\0", "\ud800", "a\ud800", 5000 * "a", None, ["a"]):
        with pytest.raises(jv.InputError, match=r"^path (is|has) .*; (it must be the path of a file|a path)"):
            require_path(wrong, "path")


@pytest.mark.parametrize("choice", [jv.Tolerance, jv.Accuracy, jv.EqualSteps])
def test_choices_of_steps_hold_numbers_only(choice):
    for wrong in ("small", True, 1j, None, b"12", np.ma.masked):
        with pytest.raises(jv.InputError, match=r"^(tolerance|error|steps) (is .*, which is not a number|has masked values)"):
            choice(wrong)


def test_named_aliases_of_unions_are_resolved():
    """`type ArrayLike = ...` of newer NumPy, which Python 3.11 cannot write."""

    class Alias:
        __value__ = int | Sequence[float]

    assert _alternatives(Alias) == (int, Sequence[float])
    assert _alternatives(Union[Alias, None]) == (int, Sequence[float], type(None))  # noqa: UP007
