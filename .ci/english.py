"""Check of the English of names and docstrings; prints each finding and exits with 1 if there is one.

    python .ci/english.py [FOLDER ...]

- A docstring begins with a noun or a verb, not with a word of `OPENERS`.
- The name of a private constant says of what it is, such as `_MAX_CACHED_PROGRAMS`, not `_MOST` or `_POINTS`.
- The name of a test has at most 60 characters.
- Docstrings and messages of the packages contain none of the phrases of `PHRASES`.
"""

from __future__ import annotations

import ast
import pathlib
import re
import sys
from collections.abc import Iterator

ROOT = pathlib.Path(__file__).resolve().parents[1]
FOLDERS = ("jaxvib", "optimize", "tests", "benchmarks", "docs", ".ci", "conftest.py", "jaxvib_command.py")

OPENERS = {
    "What",
    "Where",
    "Whether",
    "How",
    "Which",
    "Who",
    "Whose",
    "Why",
    "So",
    "Of",
    "By",
    "As",
    "Unless",
    "In",
    "Those",
    "That",
}
OPENERS |= {"From", "With"}
"""First words of docstrings that are refused."""

VAGUE = {
    "ALL",
    "CLOSE",
    "COARSE",
    "ENOUGH",
    "FAR",
    "FEW",
    "FEWEST",
    "FINE",
    "FIRST",
    "KNOWN",
    "LARGE",
    "LARGEST",
    "LAST",
    "LEAST",
}
VAGUE |= {
    "LONG",
    "LONGEST",
    "MANY",
    "MAX",
    "MIN",
    "MORE",
    "MOST",
    "NEAR",
    "NONE",
    "SAME",
    "SHORT",
    "SMALL",
    "SMALLEST",
    "TINY",
    "WIDE",
}
COUNTED = {"COUNT", "NUMBER", "PARTS", "PIECES", "POINTS", "ROUNDS", "SHARE", "SIZE", "STEPS", "TIMES", "TRIES"}
"""Words that do not say of what a constant is: those of `VAGUE` in any number, those of `COUNTED` alone."""

LONGEST_TEST_NAME = 60

PHRASES = (
    "asked for",
    "are told",
    "as far as",
    "force on the bed",
    "is told",
    "nobody",
    "not to be had",
    "said otherwise",
    "who asks",
)
"""Phrases that are refused in all text of the packages, compared without line breaks; plain ones are requested, shown, if, no
one, default, foundation force."""

PACKAGES = ("jaxvib", "optimize")


def findings(text: str, *, is_package: bool = True) -> Iterator[tuple[int, str]]:
    """(line, sentence) of each rule that a module breaks; rules on phrases hold for modules of packages."""
    tree = ast.parse(text)
    for node in ast.walk(tree):
        if is_package and isinstance(node, ast.Constant) and isinstance(node.value, str):
            sentence = " ".join(node.value.split()).lower()
            for phrase in PHRASES:
                if re.search(rf"\b{phrase}\b", sentence):
                    yield node.lineno, f'text with the phrase "{phrase}"'
        if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)):
            yield from _opener(node.body[:1])
            for before, after in zip(node.body, node.body[1:], strict=False):
                if isinstance(before, (ast.Assign, ast.AnnAssign)):
                    yield from _opener([after])
        if isinstance(node, ast.FunctionDef) and node.name.startswith("test_") and len(node.name) > LONGEST_TEST_NAME:
            yield node.lineno, f"test name of {len(node.name)} characters (at most {LONGEST_TEST_NAME}): {node.name}"
    for node in tree.body:
        targets = node.targets if isinstance(node, ast.Assign) else [node.target] if isinstance(node, ast.AnnAssign) else []
        for target in targets:
            if isinstance(target, ast.Name) and re.fullmatch(r"_[A-Z][A-Z0-9_]*", target.id):
                words = target.id.strip("_").split("_")
                if set(words) <= VAGUE or (len(words) == 1 and words[0] in COUNTED):
                    yield node.lineno, f"private constant without a noun that says of what: {target.id}"


def _opener(statements: list[ast.stmt]) -> Iterator[tuple[int, str]]:
    """The finding of a docstring, if the statement is one and begins with a refused word."""
    for one in statements:
        if isinstance(one, ast.Expr) and isinstance(one.value, ast.Constant) and isinstance(one.value.value, str):
            words = re.match(r"\W*([A-Za-z]+)", one.value.value)
            if words and words[1] in OPENERS:
                yield one.lineno, f'docstring begins with "{words[1]}": {one.value.value.strip().splitlines()[0][:80]}'


def main(folders: list[str]) -> int:
    """The number of findings in the files of folders, at most 1."""
    found = False
    for folder in folders or FOLDERS:
        place = ROOT / folder
        for path in [place] if place.is_file() else sorted(place.rglob("*.py")):
            name = path.relative_to(ROOT)
            for line, sentence in findings(path.read_text(encoding="utf-8"), is_package=name.parts[0] in PACKAGES):
                found = True
                print(f"{name}:{line}: {sentence}")
    return int(found)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
