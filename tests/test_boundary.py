"""Arguments of public functions against their annotations."""

import pathlib
from collections.abc import Callable, Mapping, Sequence
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import Array
from numpy.typing import ArrayLike

import jaxvib as jv
from jaxvib.boundary import is_real, is_whole, require_path, validated
from jaxvib.units import Number


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
        ({"word": 3}, "word is 3; it must be a text"),
        ({"flag": 1}, "flag is 1; it must be True or False"),
        ({"count": True}, "count is True; it must be a whole number"),
        ({"count": 2.0}, "count is 2.0; it must be a whole number"),
        ({"count": 10**400}, "count is a whole number of 1329 bits; it must be a whole number"),
        ({"count": np.timedelta64(3, "s")}, "count is np.timedelta64(3,'s'); it must be a whole number"),
        ({"size": "3"}, "size is '3'; it must be a number"),
        ({"size": float("nan")}, "size is nan; it must be a number, not NaN"),
        ({"size": 1j}, "size is 1j; it must be a number"),
        ({"size": 10**400}, "size is a whole number of 1329 bits; it must be a number below 1e308"),
        ({"size": jnp.asarray(True)}, "size is Array(True, dtype=bool); it must be a number"),
        ({"side": None}, "side is None; it must be 'left' or 'right'"),
        ({"side": ["left"]}, "side is ['left']; it must be 'left' or 'right'"),
        ({"path": 3}, "path is 3; it must be the path of a file"),
        ({"path": "a\0b"}, r"path is 'a\x00b'; it must be the path of a file, without the character NUL"),
        ({"make": 3}, "make is 3; it must be a function"),
        ({"sizes": 3.0}, "sizes is 3.0; it must be a list of numbers"),
        ({"sizes": "12"}, "sizes is '12'; it must be a list of numbers"),
        ({"sizes": [1.0, [2.0]]}, "sizes[1] is [2.0]; it must be a number"),
        ({"sizes": range(10**9)}, "sizes is range(0, 1000000000); it must be a list of at most 10000000 entries"),
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
        ({"rows": True}, "rows is True; it must be an array of numbers"),
        ({"rows": np.ones(2) + 1j}, "rows is array([1.+1.j, 1.+1.j]); it must be an array of numbers"),
        ({"scene": None, "count": None}, "count is None; it must be a whole number"),
        ({"scene": "machine.toml"}, "scene is 'machine.toml'; it must be a Scene, for example load_scene('machine.toml')"),
    ],
)
def test_an_argument_of_another_type_ends_in_a_sentence(arguments, sentence):
    with pytest.raises(jv.InputError) as caught:
        question(**arguments)
    assert str(caught.value) == sentence


def test_arguments_of_the_right_types_pass():
    kept = dict(word="a", flag=np.True_, count=np.int64(3), size=np.float32(2.0), side="right", path=pathlib.Path("x"))
    more = dict(make=len, sizes=(1.0, np.float64(2.0)), pair=(1, 2), shares={"a": 1}, array=jnp.ones(2), speed="3 rpm")
    assert question(**kept, **more) == question(sizes=np.ones(3), rows=[[1.0], [2.0]], pair=3) == "answered"
    assert jax.jit(lambda x: x * (question(size=x, array=x, sizes=[x]) == "answered"))(2.0) == 2.0


def test_an_unknown_name_remains_a_type_error():
    with pytest.raises(TypeError, match="unexpected keyword argument 'colour'"):
        question(colour="red")


def test_numbers_and_paths_are_known_by_their_kind():
    assert is_real(2) and is_real(np.ones(3, np.float16)) and is_real(jnp.ones(2, jnp.bfloat16)) and is_whole(np.int8(1))
    assert not any(map(is_real, (True, 1j, "1", None, np.datetime64("2020"), np.asarray([True], dtype=object))))
    assert not is_whole(True) and not is_whole(np.timedelta64(1, "s")) and not is_whole(1.0)
    for wrong in (b"a", "", "a\0", "\ud800", 5000 * "a", None, ["a"]):
        with pytest.raises(jv.InputError, match=r"^path is .*; it must be the path of a file"):
            require_path(wrong, "path")
