"""Design task: a design space, an objective and demands."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from jaxvib.boundary import with_known_names
from jaxvib.machine.files import Tables
from jaxvib.machine.numbers.named import find_number
from jaxvib.machine.scene import Scene
from optimize.quantities.quantity import Demand, Quantity, walk
from optimize.result import Synthesis
from optimize.space import DesignSpace
from optimize.synthesize import synthesize


class Catalogue(NamedTuple):
    """Catalogue from which a design chooses rows.

    **Attributes**: `name` of the choice; `rows`: a text for each row; `columns`: values by parameter, SI. The values of the
    first column identify the row.
    """

    name: str
    rows: list[str]
    columns: Mapping[str, Sequence[float]]

    def chosen(self, scene: Scene) -> str:
        """Return a line of text that names the rows whose values a scene has, or the nearest rows."""
        parameter, values = next(iter(self.columns.items()))
        in_scene = np.asarray(find_number(scene, parameter, "choices").read(scene))
        nearest = np.argmin(np.abs(np.subtract.outer(in_scene, values)), axis=1)
        return f"chosen {self.name}: {'; '.join(dict.fromkeys(self.rows[k] for k in nearest))}"


@with_known_names
@dataclass(frozen=True)
class Design:
    """Design task.

    Returned by `load_design` and by the functions of `optimize.recipes`.

    **Attributes**: `space`: a `DesignSpace`; `objective`: the quantity to minimize; `search`: further arguments of
    `synthesize`, for example {"starts": 32}; `subject_to`: the demands; `catalogues` of a design file.
    """

    space: DesignSpace
    objective: Quantity
    search: Tables = field(default_factory=dict)
    subject_to: tuple[Demand, ...] = ()
    catalogues: tuple[Catalogue, ...] = ()

    def notes(self) -> list[str]:
        """Return a warning if the task contains a throw angle although all exciters turn in one direction; otherwise an empty
        list."""
        quantities = (
            self.objective,
            *(held.quantity for held in self.space.held),
            *(demand.quantity for demand in self.subject_to),
        )
        directions = {exciter.direction for exciter in self.space.scene.exciters}
        if len(directions) > 1 or not any(part.name == "throw_angle" for quantity in quantities for part in walk(quantity)):
            return []
        return [
            "all exciters turn in one direction, so that points of the body move on ellipses; a straight throw needs two "
            "directions: write direction = -1 for one of two equal motors"
        ]

    def run(self, **more: Any) -> Synthesis:
        """Search for the best machine by `synthesize`. Arguments in `more` replace those in `search`.

        **Returns** `Synthesis`. **Raises** the errors of `synthesize`.
        """
        return synthesize(self.space, self.objective, subject_to=self.subject_to, **{**self.search, **more})
