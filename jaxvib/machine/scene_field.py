"""Field of a result that contains the scene: its TOML text for files, and the names of coordinates, directions and loads."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from jaxvib.machine.files import scene_from_toml, scene_to_toml
from jaxvib.machine.scene import Scene
from jaxvib.results.fields import as_text


def _labels(scene: Scene) -> dict[str, Sequence[Any]]:
    if batch := np.ndim(scene.exciters[0].drive.speed):  # the scenes of a batch have the same names
        scene = jax.tree.map(lambda leaf: leaf[(0,) * batch], scene)
    structure, counts = scene.machine.structure(), [0 if e.loads is None else e.loads.count for e in scene.exciters]
    loads = range(1, counts[0] + 1)
    if len(counts) > 1:
        loads = [name for k, n in enumerate(counts, 1) for name in ([f"{k}.{j + 1}" for j in range(n)] or [f"{k}"])]
    # A single direction needs no name.
    directions = structure.foundation_directions if len(structure.foundation_directions) > 1 else ()
    return {"coordinate": structure.coordinates, "unit": structure.units, "load": loads, "direction": directions}


SCENE = as_text(scene_to_toml, scene_from_toml, _labels)
"""Metadata of a result's field that contains a scene."""
