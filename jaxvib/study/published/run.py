"""The five papers, asked one after the other."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from jaxvib.boundary import validated
from jaxvib.errors import InputError, quoted, require_one_of
from jaxvib.study.published.antiphase import antiphase_paper
from jaxvib.study.published.bearing import bearing_paper
from jaxvib.study.published.criterion import criterion_paper
from jaxvib.study.published.entry import PaperAnswer
from jaxvib.study.published.result import Reproduced, reproduced_of
from jaxvib.study.published.rotor import rotor_paper
from jaxvib.study.published.torus import torus_paper

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["PAPERS", "reproduce"]

PAPERS = {
    "antiphase": "two-mass antiphase resonance machine: synthesis and jam modes",
    "criterion": "Filimonikhin et al. 2022: empirical criterion, characteristic speeds of one, two and three masses",
    "rotor": "Artyunin 2013: rigid rotor with four pendulums",
    "torus": "Strautmanis et al. 2018: vertical rotor with two balls in a torus",
    "bearing": "Artyunin, Sumenkov 2019: friction in a pendulum's bearing",
}
"""The papers by name, and what they are about."""

_ASKED: dict[str, Callable[[bool], PaperAnswer]] = {
    "antiphase": lambda full: antiphase_paper(),
    "criterion": lambda full: criterion_paper(),
    "rotor": lambda full: rotor_paper(),
    "torus": lambda full: torus_paper(full=full),
    "bearing": lambda full: bearing_paper(),
}


@validated
def reproduce(
    papers: Sequence[str] = (),
    *,
    full: bool = False,
    report: Callable[[str], None] | None = None,
    figure: Callable[[str, Callable[[], Figure]], None] | None = None,
) -> Reproduced:
    """Computes what the source papers print, and says of each number whether it is reproduced, a misprint, or neither.

    The printed number, with its place in the paper, is data; the computed one comes out of this package's functions. The
    verdict follows from both and from the last digit that is printed. Of a misprint the corrected formula is evaluated too, and
    has to give what the package computes in another way. All five take some minutes, "rotor" and "torus" most of them.

    **Arguments**

    - `papers`: names of `PAPERS`; all unless said otherwise
    - `full`: all six rows of the torus paper's tables in place of one, some minutes more
    - `report`: is called with the name of each paper as it is begun
    - `figure`: is called with the name of each figure that is drawn again and with what draws it

    **Returns** `Reproduced`, whose status says whether every verdict is the one that is known.
    **Raises** `InputError` for a paper that there is not.

    >>> import jax; jax.config.update("jax_enable_x64", True)
    >>> import jaxvib as jv
    >>> found = jv.reproduce(["criterion"])
    >>> found.status_name, [row.place for row in found.rows if row.verdict == "misprint"]
    ('as_known', ['(10)', 'after (38), f(0)', '(39), platform 3', '(57), c', '(59), d'])

    Source: the papers that the rows name.
    """
    if isinstance(papers, str):
        raise InputError("papers", f"is {quoted(papers)}; give a list of names, such as [{quoted(papers)}]")
    for name in papers:
        require_one_of(name, PAPERS, "papers", "has")
    rows = []
    for name in papers or PAPERS:
        if report is not None:
            report(name)
        answer = _ASKED[name](full)
        rows += answer.rows
        if figure is not None:
            for each, draw in answer.figures.items():
                figure(f"{name}_{each}", draw)
    return reproduced_of(rows)
