"""Field of a result that holds the scene, as TOML in files, with the names of coordinates and loads."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from jaxvib.machine.files import scene_from_toml, scene_to_toml
from jaxvib.machine.scene import Scene
from jaxvib.results.fields import as_text

__all__ = ["SCENE"]


def _labels(scene: Scene) -> dict[str, Sequence[Any]]:
    structure = scene.machine.structure()
    return {"coordinate": structure.coordinates, "unit": structure.units, "load": range(1, scene.loads.count + 1)}


SCENE = as_text(scene_to_toml, scene_from_toml, _labels)
"""Metadata of a result's field that holds a scene."""
