"""Quantities of the machine itself: support frequencies, sums and products of parameters, mass, static deflection, cost."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
from jax import Array

from jaxvib.errors import InputError, quoted
from jaxvib.machine.numbers.named import spec_of
from jaxvib.machine.scene import Scene
from jaxvib.machine.structures.platforms import Platforms
from jaxvib.steady.measures import require_platforms, static_deflections
from jaxvib.units import Number, count
from optimize.quantities.evaluation import Evaluation
from optimize.quantities.quantity import BuiltinQuantity, Quantity, Tier, quantity_function
from optimize.quantities.user_inputs import number_in

__all__ = ["product", "spring_cost", "static_deflection", "support_frequency_squared", "total", "total_mass"]


def _make_quantity(name: str, unit: str, function: Callable[..., Array], text: str, *settings: object) -> Quantity:
    return BuiltinQuantity(name, unit, function, tiers=("leading",), text=text, settings=settings)


@quantity_function
def support_frequency_squared() -> Quantity:
    """Return the sum of the squared support frequencies, (rad/s)^2: sum_i k_i/M_i over the platforms.

    It is n_1^2 + n_2^2 in the source. M_i includes the mass of the loads.

    **Returns** `Quantity`; typical: 100 to 10,000. A machine without platforms raises `InputError` when the quantity is
    computed.

    >>> import jaxvib as jv
    >>> from optimize import support_frequency_squared
    >>> form = jv.Dimensionless("antiphase", natural=(1/3, 1/3), damping=(0.01, 0.01), link_natural=2/3, link_damping=0.01,
    ...                         rho=1.0, eps=1e-3, beta=1.0, speed=3.0)
    >>> round(float(support_frequency_squared()(form.scene())), 6)
    0.222222

    Source: the antiphase paper, section 5.1.
    """
    return _make_quantity("support_frequency_squared", "rad^2/s^2", _frequencies, "sum of squared support frequencies k/M")


def _frequencies(evaluation: Evaluation, tier: Tier) -> Array:
    machine = require_platforms(evaluation.scene, "support_frequency_squared")
    return jnp.sum(machine.stiffness / jnp.diagonal(evaluation.model.mass))


def _entries(field: str) -> tuple[str, str, str, str]:
    """Return the part of the scene, the name and the unit of an array whose entries all have one unit, and a text for its
    entries."""
    part, _, name = field.partition(".") if isinstance(field, str) else ("", "", "")
    spec = spec_of(field) if part in ("machine", "loads") and "[" not in name else None
    if spec is None or len(spec.units) > 1:
        raise InputError("field", f"is {quoted(field)}; it must name parameters of a scene, for example 'machine.stiffness'")
    return part, name, spec.unit, spec.words.format(load="load") + (f" of all {spec.each}s" if spec.each else "")


def _leaf(scene: Scene, part: str, name: str) -> Array:
    """Return the entries of an array of the scene; a parameter that all loads share is repeated for each load."""
    leaf = getattr(getattr(scene, part), name, None)
    if not isinstance(leaf, jax.Array):
        raise InputError("field", f"is '{part}.{name}', which this scene does not have")
    return jnp.broadcast_to(leaf, (scene.loads.count,)) if part == "loads" and leaf.ndim == 0 else leaf


@quantity_function
def total(field: str) -> Quantity:
    """Return the sum of an array of the scene, such as "machine.stiffness", in the unit of its entries.

    A parameter that all loads share, such as "loads.mass", is counted once for each load.

    **Arguments**: `field`: the name of the array; typical: "machine.mass", "machine.stiffness", "loads.mass".

    **Returns** `Quantity`. **Raises** `InputError` for a name that no scene has.

    >>> from optimize import total
    >>> total("machine.stiffness").unit
    'N/m'
    """
    part, name, unit, words = _entries(field)
    return _make_quantity(f"total {field}", unit, _total, f"sum of {words}", part, name)


def _total(evaluation: Evaluation, tier: Tier, part: str, name: str) -> Array:
    return jnp.sum(_leaf(evaluation.scene, part, name))


@quantity_function
def product(field: str) -> Quantity:
    """Return the product of the entries of an array of the scene, such as "machine.stiffness", see `total`.

    The value is in SI, but the quantity has the unit "".

    **Arguments**: `field`: the name of the array; typical: "machine.mass", "machine.stiffness".

    **Returns** `Quantity`. **Raises** `InputError` for a name that no scene has.

    >>> from optimize import product
    >>> product("machine.mass").words
    'product of mass of all platforms'
    """
    part, name, _, words = _entries(field)
    return _make_quantity(f"product of {field}", "", _product, f"product of {words}", part, name)


def _product(evaluation: Evaluation, tier: Tier, part: str, name: str) -> Array:
    return jnp.prod(_leaf(evaluation.scene, part, name))


@quantity_function
def total_mass() -> Quantity:
    """Return the mass of the platforms, the loads and the unbalances with an `unbalance_mass`, kg.

    **Returns** `Quantity`; typical: 50 to 5000 kg. A machine without platforms raises `InputError` when the quantity is
    computed.

    >>> from optimize import total_mass
    >>> total_mass().unit
    'kg'
    """
    return _make_quantity("total_mass", "kg", _mass, "mass of platforms and loads")


def _mass(evaluation: Evaluation, tier: Tier) -> Array:
    require_platforms(evaluation.scene, "the mass")
    return jnp.trace(evaluation.model.mass)


@quantity_function
def static_deflection(of: int | None = None) -> Quantity:
    """Return the static deflection of a platform, or of the centre of mass of a body in a plane, under the weight of the
    machine and its loads, m: K y = M g, g = 9.80665 m/s^2.

    **Arguments**: `of`: number of the platform or body, from 1; typical: 1 to 3; default: the largest deflection of all.

    **Returns** `Quantity`; typical: 2 to 50 mm; NaN if the platform neither has a support nor is connected by links to
    a platform with one, or if the supports of bodies cannot carry them. Other machines, and machines without this platform or
    body, raise `InputError` when the quantity is computed.

    >>> import jaxvib as jv
    >>> from optimize import static_deflection
    >>> machine = jv.one_mass(mass=50.0, stiffness=4e4, damping=0.0)
    >>> scene = jv.Scene(machine, jv.balls(count=1, mass=1.0, radius=0.1, drag=1.0), jv.ConstantSpeed(100.0))
    >>> round(float(static_deflection()(scene)), 5)     # 51 g / 4e4
    0.0125
    """
    if of is not None:
        count(of, "of")
    text = "static deflection" + (f" of platform or body {of}" if of is not None else "")
    return _make_quantity("static_deflection", "m", _sag, text, of)


def _sag(evaluation: Evaluation, tier: Tier, of: int | None) -> Array:
    sag = static_deflections(evaluation.scene)
    if of is not None and of > sag.shape[0]:
        parts = "platforms" if isinstance(evaluation.scene.machine, Platforms) else "bodies"
        raise InputError("of", f"is {of}; the machine has {parts} 1 to {sag.shape[0]}")
    return jnp.max(sag) if of is None else sag[of - 1]


@quantity_function
def spring_cost(prices: Sequence[tuple[Number, float]], unit: str = "") -> Quantity:
    """Return the cost of the springs of supports and links, from a price list.

    The price between two entries is interpolated linearly. Beyond an end of the list it is extrapolated from the two entries
    at that end, but it is at least the price at that end. A spring of stiffness 0 costs nothing.

    **Arguments**

    - `prices`: pairs (stiffness, price) in ascending order of the stiffness, N/m or text; prices are at least 0; typical: 2 to
      20 pairs from 1e4 to 1e6 N/m
    - `unit` of the prices

    **Returns** `Quantity`. **Raises** `InputError` for a wrong list.

    >>> from optimize import spring_cost
    >>> spring_cost([("10 N/mm", 20.0), ("100 N/mm", 55.0)]).words
    'cost of the springs'
    """
    rows = tuple(prices) if isinstance(prices, (list, tuple)) else ()
    if len(rows) < 2 or not all(isinstance(row, (list, tuple)) and len(row) == 2 for row in rows):
        raise InputError("prices", "must be a list of at least two pairs (stiffness, price)")
    stiffness = tuple(number_in(k, "N/m", f"prices[{i}]") for i, (k, _) in enumerate(rows))
    price = tuple(number_in(p, "", f"prices[{i}]") for i, (_, p) in enumerate(rows))
    if not all(a < b for a, b in itertools.pairwise(stiffness)) or not stiffness[0] > 0.0:
        raise InputError("prices", "must have ascending stiffnesses greater than 0")
    for i, listed in enumerate(price):
        if not 0.0 <= listed < math.inf:
            raise InputError(f"prices[{i}]", f"has the price {listed:g}; a price must be at least 0 and finite")
    return _make_quantity("spring_cost", unit, _cost, "cost of the springs", stiffness, price)


def _cost(evaluation: Evaluation, tier: Tier, stiffness: tuple[float, ...], price: tuple[float, ...]) -> Array:
    machine = require_platforms(evaluation.scene, "the cost of springs")
    springs = jnp.concatenate([jnp.ravel(machine.stiffness), jnp.ravel(machine.link_stiffness)])
    costs = jnp.interp(springs, jnp.asarray(stiffness), jnp.asarray(price), left="extrapolate", right="extrapolate")
    lowest = jnp.where(springs < stiffness[0], price[0], jnp.where(springs > stiffness[-1], price[-1], 0.0))
    return jnp.sum(jnp.where(springs > 0.0, jnp.maximum(costs, lowest), 0.0))
