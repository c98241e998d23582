"""Single changes of a source file, for `mutants.py`."""

from __future__ import annotations

import ast
import copy
import dataclasses
import hashlib
import itertools
import pathlib
from collections.abc import Iterator

OPERATORS: dict[type, type] = {ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.MatMult: ast.Mult}
COMPARISONS: dict[type, type] = {
    ast.Lt: ast.GtE,
    ast.GtE: ast.Lt,
    ast.Gt: ast.LtE,
    ast.LtE: ast.Gt,
    ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot,
    ast.IsNot: ast.Is,
    ast.In: ast.NotIn,
    ast.NotIn: ast.In,
}
PAIRS = (("sin", "cos"), ("minimum", "maximum"), ("min", "max"), ("argmin", "argmax"), ("any", "all"), ("real", "imag"))
CALLS = {one: other for pair in PAIRS for one, other in (pair, pair[::-1])}

SYMMETRIC = {"minimum", "maximum", "min", "max", "hypot", "logical_and", "logical_or", "isclose", "union", "intersection"}
"""Functions whose arguments may be swapped."""

FACTORS = (1e-3, 1e3)
"""Smallest and largest factor that is doubled: smaller ones are tolerances, larger ones limits of effort."""


@dataclasses.dataclass(frozen=True)
class Mutant:
    """One change: `old`, the text from `start` to `end` (bytes of the file), becomes `new`."""

    file: str
    line: int
    kind: str
    start: int
    end: int
    old: str
    new: str

    @property
    def name(self) -> str:
        return f"{self.file}:{self.line}:{self.start} {self.kind}: {self.old} -> {self.new}"

    @property
    def folder(self) -> str:
        """The package's folder that the file is in, or the package itself."""
        return folder_of(self.file)

    def rank(self, seed: int) -> str:
        """A random text that follows from the seed and the change, but not from its place in the file."""
        return hashlib.sha256(f"{seed} {self.file} {self.kind} {self.old} {self.new}".encode()).hexdigest()


def mutants(file: str, text: str) -> Iterator[Mutant]:
    """All changes that a file allows, outside docstrings, annotations, messages and code for type checkers."""
    starts = [0]
    for line in text.encode().splitlines(keepends=True):
        starts.append(starts[-1] + len(line))
    for node, kind, changed in _changes(ast.parse(text)):
        start = starts[node.lineno - 1] + node.col_offset
        end = starts[node.end_lineno - 1] + node.end_col_offset
        old, new = text.encode()[start:end].decode(), ast.unparse(changed)
        yield Mutant(file, node.lineno, kind, start, end, old, new if isinstance(changed, ast.Constant) else f"({new})")


def _changes(node: ast.AST, place: str = "") -> Iterator[tuple[ast.expr, str, ast.expr]]:
    """Changes of a node and of its parts; `place` tells whether a number in it is an index, a factor, or neither."""
    if isinstance(node, (ast.Raise, ast.Assert, ast.JoinedStr, ast.Import, ast.ImportFrom)):
        return
    if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
        return
    if isinstance(node, ast.BinOp) and not _is_text(node):
        other = OPERATORS.get(type(node.op))
        if isinstance(node.op, ast.Pow):
            yield node, "factor", ast.BinOp(node.left, ast.Mult(), node.right)
        elif other is not None:
            yield node, "sign" if isinstance(node.op, (ast.Add, ast.Sub)) else "factor", _with(node, op=other())
        if isinstance(node.op, (ast.Add, ast.Sub)):
            yield node, "term", node.left
            yield node, "term", node.right if isinstance(node.op, ast.Add) else ast.UnaryOp(ast.USub(), node.right)
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub) and not isinstance(node.operand, ast.Constant):
        yield node, "sign", node.operand
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not):
        yield node, "comparison", node.operand
    elif isinstance(node, ast.Compare) and len(node.ops) == 1:
        yield node, "comparison", _with(node, ops=[COMPARISONS[type(node.ops[0])]()])
    elif isinstance(node, ast.BoolOp):
        yield node, "comparison", _with(node, op=ast.Or() if isinstance(node.op, ast.And) else ast.And())
    elif isinstance(node, ast.Call):
        name = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
        if name in CALLS:
            func = _with(node.func, **{"attr" if isinstance(node.func, ast.Attribute) else "id": CALLS[name]})
            yield node, "function", _with(node, func=func)
        yield from _calls(node, name)
    elif isinstance(node, ast.If):
        yield node.test, "branch", ast.Constant(False)
        if node.orelse:
            yield node.test, "branch", ast.Constant(True)
    elif isinstance(node, ast.IfExp):
        yield node, "branch", node.body
        yield node, "branch", node.orelse
    elif isinstance(node, ast.Constant) and type(node.value) in (int, float):
        if place == "index":  # one past the end of a JAX array is its last one
            yield node, place, ast.Constant(node.value - 1 if node.value > 0 else 1)
        elif place == "factor" and FACTORS[0] <= abs(node.value) <= FACTORS[1]:
            yield node, place, ast.Constant(2 * node.value)
    if isinstance(node, (ast.FunctionDef, ast.ClassDef, ast.Module)):
        inner = [*node.body, *(node.args.defaults if isinstance(node, ast.FunctionDef) else ())]
        children = [one for one in inner if not (isinstance(one, ast.Expr) and isinstance(one.value, ast.Constant))]
    elif isinstance(node, ast.AnnAssign):
        children = [node.value] if node.value is not None else []
    else:
        children = list(ast.iter_child_nodes(node))
    for child in children:
        yield from _changes(child, _place(node, child))


def _calls(node: ast.Call, name: str) -> Iterator[tuple[ast.expr, str, ast.expr]]:
    """The call with two neighbouring arguments swapped, and without each of its keyword arguments."""
    plain = not any(isinstance(argument, ast.Starred) for argument in node.args) and name not in SYMMETRIC
    for i, pair in enumerate(itertools.pairwise(node.args) if plain else ()):
        if ast.dump(pair[0]) != ast.dump(pair[1]):
            yield node, "argument", _with(node, args=[*node.args[:i], *pair[::-1], *node.args[i + 2 :]])
    for keyword in node.keywords:
        if keyword.arg not in (None, "strict"):  # zip's check of lengths, which ruff asks for
            yield node, "keyword", _with(node, keywords=[one for one in node.keywords if one is not keyword])


def _place(node: ast.AST, child: ast.AST) -> str:
    """ "index", "factor" or "": a number that stands alone is a limit, a count or a default and stays as it is."""
    if isinstance(node, ast.Subscript) and child is node.slice:
        return "index"
    if isinstance(node, ast.BinOp) and isinstance(node.op, (ast.Mult, ast.Div, ast.Pow)):
        return "factor"
    return "factor" if isinstance(node, (ast.List, ast.Tuple)) and isinstance(node.ctx, ast.Load) else ""


def _is_text(node: ast.BinOp) -> bool:
    if isinstance(node.left, (ast.List, ast.Tuple)) or isinstance(node.right, (ast.List, ast.Tuple)):
        return True
    parts = [part for side in (node.left, node.right) for part in ast.walk(side)]
    return any(
        isinstance(part, ast.JoinedStr) or (isinstance(part, ast.Constant) and isinstance(part.value, str)) for part in parts
    )


def _with(node: ast.AST, **fields) -> ast.expr:
    changed = copy.copy(node)
    for name, value in fields.items():
        setattr(changed, name, value)
    return changed


def folder_of(file: str) -> str:
    """The folder that a file's mutants are counted in."""
    return "/".join(pathlib.Path(file).parent.parts[:2])
