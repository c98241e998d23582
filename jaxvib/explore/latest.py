"""Results of the latest scene, which several parts of the page need."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import TypeVar

from jaxvib.machine.scene import Scene

_Result = TypeVar("_Result")


def keep_latest(function: Callable[[Scene], _Result]) -> Callable[[Scene], _Result]:
    """Return a function that stores its latest result: another call with the same scene object returns the stored result.

    >>> calls = []
    >>> read = keep_latest(lambda scene: calls.append(scene) or len(calls))
    >>> read("scene"), read("scene"), read("another")
    (1, 1, 2)
    """
    latest: list[tuple[Scene, _Result]] = []

    @functools.wraps(function)
    def of_scene(scene: Scene) -> _Result:
        for stored_scene, result in latest:
            if stored_scene is scene:
                return result
        result = function(scene)
        latest[:] = [(scene, result)]
        return result

    return of_scene
