"""Trees described in JSON."""

import json

import diffrax
import jax
import jax.numpy as jnp
import pytest
from scenes import scene

from jaxvib.equations.state import State
from jaxvib.motion.run import RunStatus
from jaxvib.runtime.structure import Undescribable, describe, rebuild
from jaxvib.steady.jams.folds import Pieces


@pytest.mark.parametrize(
    "tree",
    [
        scene("two_mass", "balls"),
        State(jnp.ones(2), jnp.zeros(2), (jnp.ones(3),), (jnp.zeros(3),), None),
        {"status": RunStatus.done, "list": [1, 2.5, True, float("inf")], "pieces": Pieces(*[None] * len(Pieces._fields))},
        diffrax.PIDController(rtol=1e-6, atol=1e-9),
    ],
    ids=["scene", "state", "enumeration, list, named tuple", "object with functions"],
)
def test_a_tree_comes_back(tree):
    arrays = []
    text = json.dumps(describe(tree, arrays.append))
    again = rebuild(json.loads(text), iter(arrays))
    assert jax.tree.structure(again) == jax.tree.structure(tree)
    assert all(a is b for a, b in zip(jax.tree.leaves(again), jax.tree.leaves(tree), strict=True) if isinstance(a, jax.Array))


@pytest.mark.parametrize("value", [lambda x: x, object(), {1, 2}, 1j, json.JSONDecoder, type("Local", (), {})])
def test_what_has_no_description(value):
    with pytest.raises(Undescribable):
        describe([value], lambda _: None)


@pytest.mark.parametrize(
    "description",
    [
        {"name": "os:system"},
        {"class": "subprocess:Popen", "fields": ["true"]},
        {"name": "jaxvib.errors:os.system"},
        {"class": "jaxvib.runtime.structure:describe", "fields": []},
        {"class": "jaxvib.errors:InputError", "fields": ["a", "b"]},
        {"name": "jaxvib.no_such_module:x"},
        {"other": 1},
    ],
)
def test_a_description_can_name_no_more_than_data(description):
    """Whatever a file says, no class outside the known packages is made and nothing is called."""
    with pytest.raises(Undescribable):
        rebuild(description, iter(()))
