"""A scene is checked once more where a question is asked: `equinox.tree_at` puts in whatever it is given."""

from __future__ import annotations

import dataclasses
import functools
import weakref
from collections.abc import Callable, Hashable

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxvib.boundary import call_user
from jaxvib.errors import InputError, quoted
from jaxvib.machine.files import rebuilt
from jaxvib.machine.scene import Scene, require_comparable
from jaxvib.runtime.compat import evaluating
from jaxvib.units import bounds_of_unknowns, require_real
from jaxvib.units.known import is_known, when_known

__all__ = ["allowed_unknowns", "checked", "made"]

_FOUND_GOOD: weakref.WeakValueDictionary[int, Scene] = weakref.WeakValueDictionary()
"""Scenes that need not be looked at again, by their identity: a scene never changes."""


def checked(scene: Scene) -> Scene:
    """The scene, every number in it an array; where all of them are known, each is one that its constructor would take.

    **Raises** `InputError` for what is no scene, and for a number that is not allowed where it stands.

    >>> import equinox as eqx, jaxvib as jv
    >>> scene = jv.Scene(jv.one_mass(mass=50.0, stiffness=4e4, damping=30.0),
    ...                  jv.balls(count=2, mass=0.5, radius=0.1, drag=1.0), jv.ConstantSpeed(60.0))
    >>> checked(eqx.tree_at(lambda s: s.drive.speed, scene, -60.0))
    Traceback (most recent call last):
        ...
    jaxvib.errors.InputError: drive.speed is -60 rad/s; it must be greater than 0
    """
    if not isinstance(scene, Scene):
        raise InputError("scene", f"is {quoted(scene)}; it must be a Scene, for example load_scene('machine.toml')")
    if _FOUND_GOOD.get(id(scene)) is scene:
        return scene
    leaves, structure = jax.tree_util.tree_flatten_with_path(scene)
    arrays = [_number(f"scene{jax.tree_util.keystr(path)}", leaf) for path, leaf in leaves]
    if any(new is not old for new, (_, old) in zip(arrays, leaves, strict=True)):
        scene = jax.tree.unflatten(structure, arrays)
    if is_known(arrays):
        numbers = structure, *((leaf.shape, leaf.dtype, leaf.tobytes()) for leaf in map(np.asarray, arrays))
        with evaluating():  # a derivative around this has no part in it, and would make it slower
            try:
                hash(structure)
            except TypeError:
                _require_good.__wrapped__(_Asked(numbers, scene))
            else:
                _require_good(_Asked(numbers, scene))
        _FOUND_GOOD[id(scene)] = scene
    return scene


def allowed_unknowns(scene: Scene) -> Array | None:
    """True if constructors would take the numbers of a scene that have no value yet, as one traced Boolean; None if all of
    its numbers are known, and therefore checked.

    >>> import equinox as eqx, jax, jaxvib as jv
    >>> scene = jv.Scene(jv.one_mass(mass=50.0, stiffness=4e4, damping=30.0),
    ...                  jv.balls(count=2, mass=0.5, radius=0.1, drag=1.0), jv.ConstantSpeed(60.0))
    >>> stiff = jax.jit(lambda k: allowed_unknowns(eqx.tree_at(lambda s: s.machine.stiffness, scene, k[None])))
    >>> bool(stiff(4e4)), bool(stiff(-4e4)), allowed_unknowns(scene)
    (True, False, None)
    """
    if is_known(scene):
        return None
    with bounds_of_unknowns() as found:
        _rebuild(scene)
    return jnp.all(jnp.stack(found)) if found else None


def _rebuild(scene: Scene) -> None:
    """Build each part of a scene once more. **Raises** `InputError` for a known number that is not allowed."""
    for section in ("machine", "loads", "drive"):
        rebuilt(getattr(scene, section), section)
    for effect in scene.effects:
        rebuilt(effect, f"effects.{effect.kind}")


@dataclasses.dataclass(frozen=True)
class _Asked:
    """A scene, known by all its numbers: under a derivative a question makes the same one again and again."""

    numbers: Hashable
    scene: Scene = dataclasses.field(compare=False)


@functools.lru_cache(256)
def _require_good(asked: _Asked) -> None:
    """**Raises** `InputError` for a number that is not allowed where it stands."""
    scene = asked.scene
    _rebuild(scene)
    require_comparable(scene.machine, scene.loads, scene.drive)


def made(make: Callable[..., Scene], *values: object) -> Scene:
    """The scene that a user's function makes of some values. **Raises** `InputError` for what is no scene, as `checked` does.

    >>> made(lambda x: None, 1.0)
    Traceback (most recent call last):
        ...
    jaxvib.errors.InputError: make(1.0) is None; it must return a Scene
    """
    scene = call_user(make, "make", *values)
    if not isinstance(scene, Scene):
        call = f"make({', '.join(map(quoted, values))})"
        raise InputError(call, f"is {quoted(scene)}; it must return a Scene")
    return checked(scene)


def _number(name: str, leaf: object) -> Array:
    """A leaf as a floating-point array. **Raises** `InputError` for a text, and for what is known and not finite."""
    if not isinstance(leaf, str):
        require_real(leaf, "", name)
    if not isinstance(leaf, jax.Array) or not jnp.issubdtype(leaf.dtype, jnp.inexact):
        try:
            leaf = jnp.asarray(leaf, dtype=float)
        except (TypeError, ValueError) as error:
            raise InputError(name, f"is {quoted(leaf)}, which is not a number; put one in, in SI units") from error
    when_known(functools.partial(_require_finite, name), leaf)
    return leaf


def _require_finite(name: str, value: np.ndarray | float) -> None:
    if not np.all(np.isfinite(value)):
        wrong = np.asarray(value)[~np.isfinite(value)].ravel()[0]
        raise InputError(name, f"is {wrong}; a finite number is needed, see how it was computed")
