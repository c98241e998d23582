"""Tables of hard cases and of printed numbers in the documentation, each between two markers.

    python tests/validation/docs_tables.py

writes them from the cases. They hold what the tests assert, and no measured number, so that they are the same on all computers.
"""

from __future__ import annotations

import math
import pathlib
import re
import sys
from collections.abc import Sequence

from exciter_forms import FORMS, TIERS
from hard_cases import CASES
from hard_cases.case import PRECISIONS, Case
from papers.catalogue import NUMBERS, PAPERS
from papers.printed import PrintedNumber

DOCS = pathlib.Path(__file__).parents[2] / "docs"

VERDICTS = ("reproduced", "misprint", "not reproducible")


def tables() -> dict[str, dict[str, str]]:
    """{page: {name of the table: its text}}."""
    papers = {
        "papers": _summary(),
        "misprints": _misprints(),
        "different": _different(),
        "numbers": _numbers(),
    }
    return {"validation.md": {"closed forms": _closed_forms(), "hard cases": _hard_cases()}, "published.md": papers}


def with_tables(text: str, named: dict[str, str]) -> str:
    """The text of a page with its tables in place of those between their markers."""
    for name, table in named.items():
        begin, end = f"<!-- table: {name} -->", "<!-- end of table -->"
        text, count = re.subn(f"{begin}.*?{end}", lambda _, t=f"{begin}\n\n{table}\n\n{end}": t, text, flags=re.S)
        if count != 1:
            raise ValueError(f"the page has {count} places for the table {name!r}; it must have one")
    return text


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [head, ["---"] * len(head), *([cell.replace("|", "\\|") for cell in row] for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _hard_cases() -> str:
    rows = [[c.name, c.hard, c.quantity, c.against, *(_outcome(c, precision) for precision in PRECISIONS)] for c in CASES]
    return _table(["case", "difficulty", "quantity", "compared with", *PRECISIONS], rows)


def _closed_forms() -> str:
    rows = [[form.name, form.formula, *(f"{bound:g}" if bound else "unstable" for bound in form.within)] for form in FORMS]
    return _table(["machine", "closed form", *TIERS], rows)


def _outcome(case: Case, precision: str) -> str:
    which = PRECISIONS.index(precision)
    within = f"within {case.within[which]:g}"
    return " or ".join(within if name == "found" else f"`{name}`" for name in case.named[which]) or within


def _summary() -> str:
    rows = []
    for paper, machine in PAPERS.items():
        numbers = [n for n in NUMBERS if n.paper == paper]
        formulas = sum(n.is_formula for n in numbers)
        verdicts = [sum(n.verdict == verdict for n in numbers) for verdict in VERDICTS]
        rows.append([f"{paper}: {machine}", *map(str, (len(numbers) - formulas, formulas, *verdicts))])
    return _table(["paper", "printed numbers", "formulas", *VERDICTS], rows)


def _misprints() -> str:
    rows = [
        [f"{n.paper} {n.place}: {n.quantity}", n.misprint.printed, n.misprint.right, n.misprint.proof]
        for n in NUMBERS
        if n.misprint is not None
    ]
    return _table(["place: quantity", "printed", "correct", "computed from"], rows)


def _different() -> str:
    rows = [[f"{n.paper} {n.place}", n.quantity, _printed(n), _in_place(n), n.reason] for n in NUMBERS if n.reason]
    return _table(["place", "quantity", "printed", "jaxvib", "reason"], rows)


def _numbers() -> str:
    rows = [
        [f"{n.paper} {n.place}", n.quantity, _printed(n), f"{n.within:g}", n.note] for n in NUMBERS if n.verdict == "reproduced"
    ]
    return _table(["place", "quantity", "printed", "bound of the difference", "setting"], rows)


def _printed(number: PrintedNumber) -> str:
    return "formula" if callable(number.printed) else f"{number.printed:g} {number.unit}".rstrip()


def _in_place(number: PrintedNumber) -> str:
    if number.computed is None:
        return "-"
    if number.chaotic:
        return "changes with the steps"
    return "none" if math.isnan(number.differs) else f"{number.differs:g}"


def main() -> None:
    for page, named in tables().items():
        path = DOCS / page
        path.write_text(with_tables(path.read_text(encoding="utf-8"), named), encoding="utf-8")
        print(path)


if __name__ == "__main__":
    sys.exit(main())
