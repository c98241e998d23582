"""Design task: a design space, an objective and demands."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from jaxvib.machine.files import Tables
from optimize.quantities.quantity import Demand, Quantity
from optimize.result import Synthesis
from optimize.space import DesignSpace
from optimize.synthesize import synthesize


@dataclass(frozen=True)
class Design:
    """Design task.

    Returned by `load_design` and by the functions of `optimize.recipes`.

    **Attributes**: `space`: a `DesignSpace`; `objective`: the quantity to minimize; `search`: further arguments of
    `synthesize`, for example {"starts": 32}; `subject_to`: the demands.
    """

    space: DesignSpace
    objective: Quantity
    search: Tables = field(default_factory=dict)
    subject_to: tuple[Demand, ...] = ()

    def run(self, **more: Any) -> Synthesis:
        """Search for the best machine by `synthesize`. Arguments in `more` replace those in `search`.

        **Returns** `Synthesis`. **Raises** the errors of `synthesize`.
        """
        return synthesize(self.space, self.objective, subject_to=self.subject_to, **{**self.search, **more})
