"""Quantities of the machine itself: stiffness budgets, sums and products, weight, sag, cost."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
from jax import Array

from jaxvib.equations.linear import linear_model
from jaxvib.errors import InputError
from jaxvib.machine.platforms import Platforms
from jaxvib.machine.scene import Scene
from jaxvib.units import FIELD_UNITS, Number, count
from optimize.wishes.answers import Answers
from optimize.wishes.given import number_in
from optimize.wishes.quantity import Asking, Quantity, Tier

__all__ = ["product", "spring_cost", "static_deflection", "support_frequency_squared", "total", "total_mass"]

_GRAVITY = 9.80665


def _asking(name: str, unit: str, function: Callable[..., Array], text: str, *settings: object) -> Quantity:
    return Asking(name, unit, function, tiers=("leading",), text=text, settings=settings)


def _platforms(scene: Scene, what: str) -> Platforms:
    if not isinstance(scene.machine, Platforms):
        raise InputError("machine.kind", f"is {scene.machine.kind!r}; {what} is that of a machine of platforms")
    return scene.machine


def support_frequency_squared() -> Quantity:
    """sum_i k_i/M_i over the platforms, loads included in M, (rad/s)^2: the stiffness budget n_1^2 + n_2^2 of the papers.

    **Returns** `Quantity`. A machine without platforms raises `InputError` where the quantity is computed.

    >>> import jaxvib as jv
    >>> from optimize import support_frequency_squared
    >>> form = jv.Dimensionless("antiphase", natural=(1/3, 1/3), damping=(0.01, 0.01), link_natural=2/3, link_damping=0.01,
    ...                         rho=1.0, eps=1e-3, beta=1.0, speed=3.0)
    >>> round(float(support_frequency_squared()(form.scene())), 6)
    0.222222

    Source: the antiphase paper, section 5.1.
    """
    return _asking("support_frequency_squared", "rad^2/s^2", _budget, "stiffness budget of the supports, sum of k/M")


def _budget(answers: Answers, tier: Tier) -> Array:
    machine = _platforms(answers.scene, "the budget")
    return jnp.sum(machine.stiffness / jnp.diagonal(answers.model.mass))


def _entries(field: str, what: str) -> tuple[str, str, str]:
    part, _, name = field.partition(".") if isinstance(field, str) else ("", "", "")
    if part not in ("machine", "loads") or name not in FIELD_UNITS:
        raise InputError("field", f"is {field!r}; it must name numbers of a scene, for example 'machine.stiffness'")
    return part, name, f"{what} {field}"


def _leaf(scene: Scene, part: str, name: str) -> Array:
    leaf = getattr(getattr(scene, part), name, None)
    if not isinstance(leaf, jax.Array):
        raise InputError("field", f"is '{part}.{name}', which this scene does not have")
    return leaf


def total(field: str) -> Quantity:
    """The sum of an array of the scene, such as "machine.stiffness", in the unit of its entries.

    **Returns** `Quantity`. **Raises** `InputError` for a name that no scene has.

    >>> from optimize import total
    >>> total("machine.stiffness").unit
    'N/m'
    """
    part, name, called = _entries(field, "total")
    return _asking(called, FIELD_UNITS[name], _total, f"sum of all {_WORDS.get(name, name)}", part, name)


def _total(answers: Answers, tier: Tier, part: str, name: str) -> Array:
    return jnp.sum(_leaf(answers.scene, part, name))


def product(field: str) -> Quantity:
    """The product of an array of the scene, such as "machine.stiffness"; its unit is that of its entries' product, left out.

    **Returns** `Quantity`. **Raises** `InputError` for a name that no scene has.

    >>> from optimize import product
    >>> product("machine.mass").words
    'product of all masses of platforms'
    """
    part, name, called = _entries(field, "product of")
    return _asking(called, "", _product, f"product of all {_WORDS.get(name, name)}", part, name)


def _product(answers: Answers, tier: Tier, part: str, name: str) -> Array:
    return jnp.prod(_leaf(answers.scene, part, name))


_WORDS = {
    "mass": "masses of platforms",
    "stiffness": "support stiffnesses",
    "damping": "support dampings",
    "link_stiffness": "link stiffnesses",
    "link_damping": "link dampings",
}


def total_mass() -> Quantity:
    """Mass of the platforms and the loads, kg.

    **Returns** `Quantity`. A machine without platforms raises `InputError` where the quantity is computed.

    >>> from optimize import total_mass
    >>> total_mass().unit
    'kg'
    """
    return _asking("total_mass", "kg", _mass, "mass of platforms and loads")


def _mass(answers: Answers, tier: Tier) -> Array:
    scene = answers.scene
    machine = _platforms(scene, "the mass")
    return jnp.sum(machine.mass) + jnp.sum(jnp.broadcast_to(scene.loads.mass, (scene.loads.count,)))


def static_deflection(of: int | None = None) -> Quantity:
    """How far a platform sags under the weight of platforms and loads, m: K y = M g, g = 9.80665 m/s^2.

    **Arguments**: `of` the platform; the largest of all unless said otherwise.

    **Returns** `Quantity`, NaN where nothing carries the platforms. A machine without platforms, or without that one, raises
    `InputError` where the quantity is computed.

    >>> import jaxvib as jv
    >>> from optimize import static_deflection
    >>> machine = jv.one_mass(mass=50.0, stiffness=4e4, damping=0.0)
    >>> scene = jv.Scene(machine, jv.balls(count=1, mass=1.0, radius=0.1, drag=1.0), jv.ConstantSpeed(100.0))
    >>> round(float(static_deflection()(scene)), 5)     # 51 g / 4e4
    0.0125
    """
    if of is not None:
        count(of, "of")
    text = "static deflection" + (f" of platform {of}" if of is not None else "")
    return _asking("static_deflection", "m", _sag, text, of)


def _sag(answers: Answers, tier: Tier, of: int | None) -> Array:
    _platforms(answers.scene, "the deflection")
    model = linear_model(answers.scene)
    sag = jnp.linalg.solve(model.carrier.stiffness, _GRAVITY * jnp.diagonal(model.mass))
    if of is not None and of > sag.shape[0]:
        raise InputError("of", f"is {of}; the machine has platforms 1 to {sag.shape[0]}")
    value = jnp.max(jnp.abs(sag)) if of is None else jnp.abs(sag[of - 1])
    return jnp.where(jnp.isfinite(value), value, jnp.nan)


def spring_cost(prices: Sequence[tuple[Number, float]], unit: str = "") -> Quantity:
    """What the springs of supports and links cost, from a price list: prices between two entries are interpolated.

    **Arguments**: `prices` pairs (stiffness N/m or text, price), stiffness ascending; a spring of stiffness 0 costs nothing;
    `unit` of the prices.

    **Returns** `Quantity`. **Raises** `InputError` for a list that is no such list.

    >>> from optimize import spring_cost
    >>> spring_cost([("10 N/mm", 20.0), ("100 N/mm", 55.0)]).words
    'cost of the springs'
    """
    rows = tuple(prices) if isinstance(prices, (list, tuple)) else ()
    if len(rows) < 2 or not all(isinstance(row, (list, tuple)) and len(row) == 2 for row in rows):
        raise InputError("prices", "is no list of at least two pairs (stiffness, price)")
    stiffness = tuple(number_in(k, "N/m", f"prices[{i}]") for i, (k, _) in enumerate(rows))
    price = tuple(float(p) for _, p in rows)
    if not all(a < b for a, b in itertools.pairwise(stiffness)) or not stiffness[0] > 0.0:
        raise InputError("prices", "has stiffnesses that do not ascend from one greater than 0")
    return _asking("spring_cost", unit, _cost, "cost of the springs", stiffness, price)


def _cost(answers: Answers, tier: Tier, stiffness: tuple[float, ...], price: tuple[float, ...]) -> Array:
    machine = _platforms(answers.scene, "the cost of springs")
    springs = jnp.concatenate([jnp.ravel(machine.stiffness), jnp.ravel(machine.link_stiffness)])
    each = jnp.interp(springs, jnp.asarray(stiffness), jnp.asarray(price), left="extrapolate", right="extrapolate")
    return jnp.sum(jnp.where(springs > 0.0, each, 0.0))
