"""Field of a result that contains the scene: its TOML text for files, and the names of coordinates, directions and masses."""

from __future__ import annotations

import jax
import numpy as np

from jaxvib.machine.files import scene_from_toml, scene_to_toml
from jaxvib.machine.scene import Scene
from jaxvib.results.fields import as_text


def mass_names(scene: Scene) -> tuple[str, ...]:
    """Return the names of the loads, and of the rotors of exciters without loads: "2.1" is the first load of exciter 2, and "2"
    its rotor if it has no loads. The loads of a single exciter have the names "1", "2", ...; its rotor has none."""
    counts = [0 if exciter.loads is None else exciter.loads.count for exciter in scene.exciters]
    if len(counts) == 1:
        return tuple(str(j + 1) for j in range(counts[0]))
    return tuple(name for k, n in enumerate(counts, 1) for name in ([f"{k}.{j + 1}" for j in range(n)] or [f"{k}"]))


def axis_labels(scene: Scene) -> dict[str, tuple[str, ...]]:
    """Return the labels of the axes of results of a scene, or of a batch of scenes, by the names of the axes, see
    `jaxvib.results.fields.labels_of`."""
    if np.ndim(scene.exciters[0].drive.speed):
        # The scenes of a batch have the same names. One of them is traced, so that no array is computed.
        found: list[dict[str, tuple[str, ...]]] = []
        jax.eval_shape(lambda scenes: jax.vmap(lambda scene: found.append(axis_labels(scene)))(scenes), scene)
        return found[0]
    structure, masses = scene.machine.structure(), mass_names(scene)
    # A single direction needs no name.
    directions = structure.foundation_directions if len(structure.foundation_directions) > 1 else ()
    return {
        "coordinate": structure.coordinates,
        "translation": tuple(n for n, unit in zip(structure.coordinates, structure.units, strict=True) if unit == "m"),
        "unit": structure.units,
        "load": masses,
        "mass": masses,
        "direction": directions,
    }


SCENE = as_text(scene_to_toml, scene_from_toml, axis_labels)
"""Metadata of a result's field that contains a scene."""
