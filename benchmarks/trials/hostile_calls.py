"""Trial of public functions with hostile arguments: each call must end in a message, a named status or a result.

    python benchmarks/trials/hostile_calls.py --out out
    python benchmarks/trials/hostile_calls.py --only simulate --list
    python benchmarks/trials/hostile_calls.py --numbers

Every public function, every constructor that users call and every method of results is called once for each parameter and each
hostile value, with valid other arguments, and once for each number and scene that JAX traces. A call ends

- refused: `InputError` or `ComputationError`, or Python's `TypeError` for a missing argument
- answered: with a result whose numbers are finite, or whose status states why they are not
- raw: with any other error, or with a warning
- hang: after more than `PATIENCE` CPU seconds
- silent: with numbers that are not finite and no status, or with a Boolean, a complex number, a date, bytes or masked values
  accepted as a number

Each raw, hanging or silent call is printed as a line of Python that repeats it; the exit code is 1 if there is one. With
`--out`, every finished function adds a line to `hostile_calls.jsonl` in that folder, and another call of the program continues
after the last line.

With `--numbers`, each number of a scene, state or argument of `FUNCTIONS` in turn is replaced by each of `EXTREMES`; a result
is then silent if its status is a success, but one of its numbers is NaN, or if its estimated relative error is above 1 and its
status is none of `INACCURATE`.
"""

from __future__ import annotations

import argparse
import collections
import contextlib
import datetime
import decimal
import functools
import inspect
import io
import json
import os
import pathlib
import random
import re
import resource
import signal
import time
import types
import warnings
from collections.abc import Callable, Iterator
from typing import Any

os.environ.setdefault("MPLBACKEND", "agg")

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from valid_calls import FOLDER, Call, calls

import jaxvib as jv
import optimize as op
from jaxvib.errors import quoted
from jaxvib.results.status import status_names

PATIENCE = 20.0
"""CPU seconds that no call may take, without those of other programs."""

MEMORY = 8 * 2**30
"""Bytes that the trial may take; a call that needs more ends in a `MemoryError`, not in that of the whole machine."""

LONG = ("prepare_cpu", "use_cache")
"""Functions of which only refusals are looked at: a valid call runs for minutes or changes the process."""

FUNCTIONS = (
    "response", "criterion", "whirl", "balanced_states", "phase_jams", "jam_orbit", "synchronous_orbit", "energy", "power",
)  # fmt: skip
EXTREMES = (1e308, 1e300, 1e154, 1e-154, 1e-300, 5e-324)

SUCCESSES = ("done", "found", "decided")
"""Statuses of results whose numbers must not be NaN."""

INACCURATE = ("not_converged", "under_resolved", "at_fold", "absent")
"""Statuses of results whose estimated relative error may be above 1."""

ABSENT = ("directivity", "balancing", "gathering", "undamped_balancing", "undamped_gathering")
"""Fields in which NaN means that there is no such number, although the result was computed."""

DOCUMENTED_NAN = ("conveying_speed",)
"""Functions that return NaN for some valid arguments, as stated in their docstrings."""

ALL = (
    "None",
    "True",
    "np.True_",
    "0",
    "-1",
    "10**12",
    "10**400",
    "10**5000",
    "[]",
    "()",
    "{}",
    "set()",
    "np.zeros(0)",
    "['a']",
)
"""Values that are valid for these, or that select everything."""


class Nothing:
    """An object that is nothing that anybody asks for."""

    def __repr__(self) -> str:
        return "Nothing()"


class Unprintable:
    """An object whose representation fails."""

    def __repr__(self) -> str:
        raise RuntimeError("no representation")


HOSTILE: dict[str, Any] = {
    "None": None,
    "True": True,
    "np.True_": np.True_,
    "0": 0,
    "-1": -1,
    "0.5": 0.5,
    "10**12": 10**12,
    "10**400": 10**400,
    "10**5000": 10**5000,
    "1e308": 1e308,
    "nan": float("nan"),
    "inf": float("inf"),
    "-inf": -float("inf"),
    "1j": 1j,
    "''": "",
    "'nonsense'": "nonsense",
    "'nan'": "nan",
    "'1 ' + 'm' * 10**5": "1 " + "m" * 10**5,
    "'1' * 400": "1" * 400,
    "'a\\0b'": "a\0b",
    "'\\ud800'": "\ud800",
    "'../..'": "../..",
    "b'12'": b"12",
    "[]": [],
    "()": (),
    "{}": {},
    "set()": set(),
    "[1.0]": [1.0],
    "[1, 2, 3, 4, 5, 6, 7]": [1, 2, 3, 4, 5, 6, 7],
    "[[1], [2, 3]]": [[1], [2, 3]],
    "[None]": [None],
    "['a']": ["a"],
    "{1: 2}": {1: 2},
    "{'a': None}": {"a": None},
    "(1, 2)": (1, 2),
    "(1, 'a')": (1, "a"),
    "object": Nothing(),
    "unprintable": Unprintable(),
    "int": int,
    "lambda": lambda *_: None,
    "generator": (each for each in (1.0, 2.0)),
    "np.zeros(0)": np.zeros(0),
    "np.zeros((2, 2))": np.zeros((2, 2)),
    "np.asarray(nan)": np.asarray(float("nan")),
    "np.ones(3) + 1j": np.ones(3) + 1j,
    "jnp.asarray(True)": jnp.asarray(True),
    "jnp.asarray(1j)": jnp.asarray(1j),
    "np.asarray(['a'])": np.asarray(["a"]),
    "np.asarray([None])": np.asarray([None]),
    "np.ma.masked": np.ma.masked,
    "masked array": np.ma.array([1.0, 2.0], mask=[False, True]),
    "date": datetime.date(2020, 1, 1),
    "datetime64": np.datetime64("2020-01-01"),
    "timedelta64": np.timedelta64(3, "s"),
    "Decimal nan": decimal.Decimal("NaN"),
    "Path": pathlib.Path("/nonexistent/folder/file"),
    "range(10**9)": range(10**9),
    "NotImplemented": NotImplemented,
    "module": types,
}
"""Values by the text that stands for them."""

NO_NUMBERS = (
    "True",
    "np.True_",
    "1j",
    "b'12'",
    "np.ones(3) + 1j",
    "jnp.asarray(True)",
    "jnp.asarray(1j)",
    "np.ma.masked",
    "masked array",
    "date",
    "datetime64",
    "timedelta64",
)
"""Values that are no real numbers and must never be taken for one."""

COMPLEX = ("1j", "np.ones(3) + 1j", "jnp.asarray(1j)")
"""Values of them that are valid where a parameter is declared as complex."""


class Hanging(Exception):
    """A call takes longer than anybody waits."""


@contextlib.contextmanager
def patience(seconds: float) -> Iterator[None]:
    """Raise `Hanging` after so many CPU seconds."""

    def stop(*_: Any) -> None:
        raise Hanging

    former = signal.signal(signal.SIGVTALRM, stop)
    signal.setitimer(signal.ITIMER_VIRTUAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_VIRTUAL, 0.0)
        signal.signal(signal.SIGVTALRM, former)


def unsaid(answer: Any) -> bool:
    """True if numbers of an answer are not finite and neither a status nor a mask of its own says so."""
    if hasattr(answer, "status") or isinstance(answer, (jv.Result, op.Quantity, op.Demand)):
        return False
    if isinstance(answer, Iterator):  # no tree of JAX
        return False
    leaves = [leaf for leaf in jax.tree.leaves(answer) if isinstance(leaf, (float, np.ndarray, jax.Array, np.generic))]
    return any(np.asarray(leaf).dtype.kind == "f" and np.any(np.isnan(leaf)) for leaf in leaves)


def takes_for_a_number(function: Callable[..., Any], name: str, valid: Any, text: str) -> bool:
    """True if a parameter is a number and the value is none, so that it must be refused."""
    if text not in NO_NUMBERS or isinstance(valid, (bool, str)) or getattr(valid, "dtype", None) == np.bool_:
        return False
    number, kind = isinstance(valid, (int, float)) or hasattr(valid, "dtype"), ""
    with contextlib.suppress(ValueError, TypeError, KeyError):
        kind = str(inspect.signature(function).parameters[name].annotation)
        number |= bool(re.search(r"\b(Numbers?|float|int|Array|ndarray|ArrayLike)\b", kind)) and "Callable" not in kind
    return number and not ("complex" in kind and text in COMPLEX)


def outcome(call: Call, name: str, text: str) -> tuple[str, str]:
    """The kind of a call's end, and what is printed about it."""
    value = HOSTILE[text]
    if text == "generator":
        value = (each for each in (1.0, 2.0))
    number = not unsaid(value) and call.name not in DOCUMENTED_NAN
    kind, said = judged(lambda: call.function(**{**call.arguments, name: value}), number=number)
    if kind == "answered" and takes_for_a_number(call.function, name, call.arguments[name], text):
        return "silent", f"takes {text} for a number"
    return kind, said


def is_inexact(value: Any) -> bool:
    """True for a number that JAX can trace, and for a scene or a part of one."""
    parts = (jv.Scene, jv.Machine, jv.Loads, jv.Drive)
    return isinstance(value, (float, *parts)) or getattr(getattr(value, "dtype", None), "kind", "") == "f"


def traced(call: Call, name: str) -> None:
    """Trace a call by the numbers of one argument, as `jax.jit` would, without running it."""
    numbers, rest = eqx.partition(call.arguments[name], lambda leaf: isinstance(leaf, float) or eqx.is_inexact_array_like(leaf))

    def ask(numbers: Any) -> None:
        call.function(**{**call.arguments, name: eqx.combine(numbers, rest)})

    jax.eval_shape(ask, numbers)


def is_default(call: Call, name: str, valid: Any) -> bool:
    """True if None is a valid value of a parameter."""
    with contextlib.suppress(ValueError, TypeError, KeyError):
        return inspect.signature(call.function).parameters[name].default is None
    return valid is None


def judged(ask: Callable[[], Any], *, number: bool = True) -> tuple[str, str]:
    """The kind of a call's end, and what is printed about it; `number`: its arguments are numbers, so its result is one."""
    began = time.process_time()
    try:
        with patience(PATIENCE), warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
            warnings.simplefilter("error")
            with contextlib.chdir(FOLDER):
                answer = ask()
            if isinstance(answer, eqx.Module):
                repr(jax.block_until_ready(answer))
    except (jv.InputError, jv.ComputationError) as error:
        taken = time.process_time() - began
        said = str(error)
        if len(said) > 2400 or not said.isprintable():
            return "raw", f"a sentence of {len(said)} characters: {said[:80]!r}"
        return ("hang", f"{taken:.0f} s, then {said[:80]}") if taken > PATIENCE else ("refused", said)
    except Hanging:
        return "hang", f"more than {PATIENCE:g} s"
    except RecursionError:
        return "raw", "RecursionError"
    except Exception as error:
        where = _place(error)
        return "raw", f"{type(error).__name__} at {where}: {' '.join(_text(error).split())[:140]}"
    finally:
        import matplotlib.pyplot as plt

        plt.close("all")
    if number and unsaid(answer):
        return "silent", f"is not finite: {quoted(answer)}"
    return "answered", quoted(answer)


def _text(error: BaseException) -> str:
    try:
        return str(error)
    except Exception:
        return "no text"


def _place(error: BaseException) -> str:
    """The deepest line of the packages that an error went through."""
    place, step = "?", error.__traceback__
    while step is not None:
        file = step.tb_frame.f_code.co_filename
        if ("/jaxvib/" in file or "/optimize/" in file) and "site-packages" not in file and "boundary.py" not in file:
            place = (
                f"{file.rpartition('/jaxvib/')[2] if '/jaxvib/' in file else file.rpartition('/optimize/')[2]}:{step.tb_lineno}"
            )
        step = step.tb_next
    return place


def trials(made: Callable[[], Call], share: float = 1.0, seed: int = 0) -> Iterator[tuple[str, ...]]:
    """(call, parameter, value, kind, text) of each hostile call of one function, the valid call first."""
    random_, call = random.Random(seed), made()
    if call.name not in LONG:
        yield call.name, "", "", *judged(lambda: call.function(**call.arguments))
        for name, valid in call.arguments.items():
            if is_inexact(valid):
                yield call.name, name, "traced", *judged(functools.partial(traced, call, name))
    for name, valid in call.arguments.items():
        for text, value in HOSTILE.items():
            if (value is None and is_default(call, name, valid)) or (call.name in LONG and text in ALL):
                continue
            if random_.random() < share:
                yield call.name, name, text, *outcome(call, name, text)


def asked_of(made: Callable[[], Call], share: float, seed: int, show_all: bool) -> dict[str, Any]:
    """Counts of one function's calls by their ends, those that are not as they must be, and its seconds."""
    counts: collections.Counter[str] = collections.Counter()
    bad, began = [], time.process_time()
    for name, parameter, text, kind, said in trials(made, share, seed):
        valid = not parameter
        if not valid:
            counts[kind] += 1
        if (kind != "answered") if valid else (kind in ("raw", "hang", "silent")):
            bad.append([name, parameter, text, kind, said])
        if show_all or bad[-1:] == [[name, parameter, text, kind, said]]:
            print(f"{kind}: {name}({parameter}={text}) {said}" if parameter else f"{kind}: valid {name} {said}", flush=True)
    return {"counts": counts, "bad": bad, "seconds": round(time.process_time() - began, 1)}


def variants(call: Call) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield the arguments of a call with one number replaced, with the name of this number and its value."""
    leaves, structure = jax.tree_util.tree_flatten_with_path(call.arguments)
    for k, (path, leaf) in enumerate(leaves):
        if np.asarray(leaf).dtype.kind != "f":
            continue
        for index in np.ndindex(np.shape(leaf)):
            for value in EXTREMES:
                changed = np.array(leaf)
                changed[index] = value
                values = [(changed if np.ndim(leaf) else value) if j == k else other for j, (_, other) in enumerate(leaves)]
                name = f"{jax.tree_util.keystr(path)}{list(index) if index else ''} = {value:g}"
                yield name, jax.tree.unflatten(structure, values)


def nan_fields(result: jv.Result) -> list[str]:
    """Return the names of the fields that contain NaN where the status is a success."""
    success = np.isin(status_names(result.status), SUCCESSES)
    fields = {name: np.asarray(getattr(result, name)) for name in result.__dataclass_fields__ if name not in ABSENT}
    numbers = {name: values for name, values in fields.items() if values.dtype.kind == "f"}
    of_points = {name for name, values in numbers.items() if values.shape[: success.ndim] == success.shape}
    return [name for name, values in numbers.items() if np.any(np.isnan(values[success] if name in of_points else values))]


def has_wrong_digits(result: jv.Result) -> bool:
    """Return True if the estimated relative error of a result is above 1 although its status does not state it."""
    error = np.asarray(getattr(result, "error", 0.0))
    return bool(np.any((error > 1.0) & ~np.isin(status_names(result.status), INACCURATE)))


def with_extreme_numbers(only: str) -> int:
    """Call `FUNCTIONS` with extreme numbers, print what is not as it must be, and return the number of these calls."""
    wrong = 0
    for made in calls():
        named = made.named  # pyright: ignore[reportFunctionMemberAccess]
        if named not in FUNCTIONS or only not in ("", named):
            continue
        call, counts = made(), collections.Counter[str]()
        for name, arguments in variants(call):
            answers: list[Any] = []

            def ask(arguments: dict[str, Any] = arguments, answers: list[Any] = answers, call: Call = call) -> Any:
                answers.append(call.function(**arguments))
                return answers[0]

            kind, said = judged(ask)
            if kind == "answered" and isinstance(answers[0], jv.Result) and (fields := nan_fields(answers[0])):
                kind, said = "silent", f"is {answers[0].message}, but NaN: {', '.join(fields)}"
            elif kind == "answered" and isinstance(answers[0], jv.Result) and has_wrong_digits(answers[0]):
                kind, said = "silent", f"is {answers[0].message}, but its error is {answers[0].error}"
            counts[kind] += 1
            if kind in ("raw", "hang", "silent"):
                wrong += 1
                print(f"{kind}: {named} with {name}: {said}", flush=True)
        print(f"{named}: {sum(counts.values())} calls, {dict(counts)}", flush=True)
    return wrong


def main() -> int:
    """Run the trial and print what is not as it must be."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--only", default="", help="one call by its name")
    parser.add_argument("--share", type=float, default=1.0, help="share of the hostile values, drawn by --seed")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--list", action="store_true", help="print every call")
    parser.add_argument("--numbers", action="store_true", help="extreme numbers in place of hostile values")
    parser.add_argument("--out", type=pathlib.Path, help="folder of the counts, a line of JSON for each function")
    asked = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    resource.setrlimit(resource.RLIMIT_DATA, (MEMORY, MEMORY))
    if asked.numbers:
        return int(with_extreme_numbers(asked.only) > 0)
    ends: dict[int, dict[str, Any]] = {}
    file = None
    if asked.out is not None:
        asked.out.mkdir(parents=True, exist_ok=True)
        file = asked.out / "hostile_calls.jsonl"
        lines = file.read_text().splitlines() if file.exists() else ()
        ends = {end["number"]: end for end in map(json.loads, lines)}
    for number, made in enumerate(calls()):
        named = made.named  # pyright: ignore[reportFunctionMemberAccess]
        if number in ends or asked.only not in ("", named):
            continue
        ends[number] = {"number": number, "name": named, **asked_of(made, asked.share, asked.seed, asked.list)}
        if file is not None:
            with file.open("a") as lines:
                lines.write(json.dumps(ends[number]) + "\n")
    counts: collections.Counter[str] = sum((collections.Counter(end["counts"]) for end in ends.values()), collections.Counter())
    bad = [line for end in ends.values() for line in end["bad"]]
    print(f"{len(ends)} functions, {sum(counts.values())} calls: {dict(counts)}; {len(bad)} not as they must be", flush=True)
    return 1 if bad else 0


if __name__ == "__main__":
    raise SystemExit(main())
