"""Mutated study, scene, design and measurement files, stores and saved results, and what becomes of them.

An outcome is "refused" (one sentence), "accepted", or a failure: "raw" (any other error), "hang", "silent" (an answer that is
not that of the input).
"""

import contextlib
import json
import os
import random
import re
import shutil
import signal
import tomllib
import warnings
import zipfile

import equinox
import numpy as np
from file_texts import STUDY

import jaxvib as jv
from jaxvib.results.files import _digest
from jaxvib.sweeps.study import load_study
from jaxvib.sweeps.sweep import run_study

PATIENCE = 60
"""CPU seconds that no input may take."""

WORDS = [
    "nan", "inf", "-1", "0", "1e400", "1" * 400, "1" * 5000, "true", '""', '"x"', "[]", "[2]", '["a"]', "[[1, 2], 3]", "{}",
    "{ a = 1 }", '"..\\u001b[31m"', '"zarr.json"', '"$x^{$"', '".."', '"é"', "1979-05-27", "07:32:00", '"1e5 N"', '"N/m"',
    '"os:getcwd"', '"run.regime"', '"jam_frequency"', '"1.5 N/mm"', "1_000", "0x10", "[" * 1500 + "]" * 1500, "1000000000000",
]  # fmt: skip


class Hang(BaseException):
    """Raised after `PATIENCE` CPU seconds."""


@contextlib.contextmanager
def patience():
    def late(*_):
        raise Hang

    before = signal.signal(signal.SIGVTALRM, late)
    signal.setitimer(signal.ITIMER_VIRTUAL, PATIENCE)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_VIRTUAL, 0)
        signal.signal(signal.SIGVTALRM, before)


def outcome(ask):
    """The outcome of a question, and the error or the remark that belongs to it."""
    try:
        with patience(), warnings.catch_warnings():
            warnings.simplefilter("error")
            return "accepted", ask()
    except (jv.InputError, jv.ComputationError) as error:
        said = str(error)
        return ("refused", said) if len(said) < 3000 and said.isprintable() else ("raw", f"message {said[:200]!r}")
    except AssertionError as error:
        return "silent", str(error)
    except Hang:
        return "hang", ""
    except BaseException as error:
        return "raw", f"{type(error).__name__}: {error}"[:300]


def mutated_text(text, rng):
    """A TOML text with one or two changes: values, keys, lines, characters."""
    for _ in range(rng.choice([1, 1, 2])):
        lines = text.splitlines()
        k = rng.randrange(len(lines))
        match rng.randrange(7):
            case 0 if "=" in lines[k]:
                lines[k] = f"{lines[k].partition('=')[0]}= {rng.choice(WORDS)}"
            case 1:
                del lines[k]
            case 2:
                lines.insert(k, lines[rng.randrange(len(lines))])
            case 3:
                words = lines[k].split()
                if words:
                    words[rng.randrange(len(words))] = rng.choice(WORDS)
                    lines[k] = " ".join(words)
            case 4 if lines[k]:
                at = rng.randrange(len(lines[k]))
                lines[k] = (
                    lines[k][:at] + chr(rng.choice([0, 9, 27, 34, 46, 91, 93, 127, 48, 57, 45, 0x202E])) + lines[k][at + 1 :]
                )
            case 5 if "=" in lines[k]:
                lines[k] = (
                    f"{rng.choice(['quantity', 'tier', 'of', 'mode', 'x', 'name', 'until'])} = {lines[k].partition('=')[2]}"
                )
            case _:
                numbers = [at for at, c in enumerate(lines[k]) if c.isdigit()]
                if numbers:
                    at = rng.choice(numbers)
                    lines[k] = lines[k][:at] + str(rng.randrange(10)) + lines[k][at + 1 :]
        text = "\n".join(lines)
    return text


def leaves(value):
    if isinstance(value, dict):
        return [leaf for key, entry in value.items() for leaf in ((key,), *leaves(entry))]
    if isinstance(value, list):
        return [leaf for entry in value for leaf in leaves(entry)]
    return [value]


def numbers_of_toml(text):
    """The entries of a TOML text; `chunk`, how many cases are computed together, changes no number."""
    tables = tomllib.loads(text)
    tables.pop("chunk", None)
    return leaves(tables)


def numbers_of_csv(text):
    """The numbers of a table of text, below its comments and its header."""
    cells = [cell.strip() for line in text.splitlines() if not line.startswith("#") for cell in line.split(",")]
    return [float(cell) for cell in cells if re.fullmatch(r"-?\d+(\.\d*)?", cell)]


def file_outcome(path, text, read, key, base, numbers=numbers_of_toml):
    """Outcome of a file mutated from `base`: refused, or accepted with another `key` if a number is another one.

    `base` is the original text and its key.
    """
    path.write_text(text, encoding="utf-8", errors="surrogateescape")

    def ask():
        found = key(read(path))
        mine, its = numbers(text), numbers(base[0])
        changed = len(mine) == len(its) and any(
            isinstance(a, (int, float)) and isinstance(b, (int, float)) and a != b for a, b in zip(mine, its, strict=True)
        )
        assert not changed or found != base[1], "another number, and the same identity"
        return found

    return outcome(ask)


def study_outcome(folder, text, original, base=STUDY):
    """Outcome of a study file mutated from `base`, see `file_outcome`."""
    return file_outcome(folder / "study.toml", text, load_study, lambda study: study.key, (base, original.key))


def design_key(design):
    """A text with every number of a design."""
    return equinox.tree_pformat(design, short_arrays=False)


def record_key(record):
    return record.time.tolist(), record.angle.tolist()


def mutated_bytes(content, rng):
    """Bytes that are cut, flipped, longer, empty, or of something else."""
    changed = bytearray(content)
    match rng.randrange(5):
        case 0:
            return bytes(changed[: rng.randrange(len(changed) + 1)])
        case 1 | 2 if changed:
            for _ in range(rng.choice([1, 1, 8])):
                changed[rng.randrange(len(changed))] ^= 1 << rng.randrange(8)
        case 3:
            at = rng.randrange(len(changed) + 1)
            changed[at:at] = rng.randbytes(rng.choice([1, 50]))
        case _:
            return rng.choice([b"", rng.randbytes(100), b"{}", b"\x00" * len(changed)])
    return bytes(changed)


def mutate_store(store, rng):
    """Changes one to three files of a store."""
    for _ in range(rng.choice([1, 1, 2, 3])):
        files = [path for path in sorted(store.rglob("*")) if path.is_file() and not path.is_symlink()]
        path = rng.choice(files)
        match rng.randrange(8):
            case 0:
                path.unlink()
            case 1:
                other = rng.choice(files)
                one, two = path.read_bytes(), other.read_bytes()
                path.write_bytes(two)
                other.write_bytes(one)
            case 2:
                path.write_bytes(rng.choice(files).read_bytes())
            case 3:
                path.unlink()
                rng.choice([os.mkfifo, os.mkdir, lambda p: os.symlink("/dev/zero", p), lambda p: os.symlink("none", p)])(path)
            case 4 if path.name == "zarr.json":
                text = path.read_text()
                at = rng.choice([k for k, c in enumerate(text) if c.isdigit()] or [0])
                path.write_text(text[:at] + str(rng.randrange(10)) + text[at + 1 :])
            case 5:
                shutil.rmtree(path.parent)
            case _:
                path.write_bytes(mutated_bytes(path.read_bytes(), rng))


def store_outcome(store, asked, truth):
    """Outcome of a damaged store: reading it, computing on, and both with no number that is not the right one.

    The `truth` is the dataset of the undamaged store.
    """

    def read(sweep):
        try:
            data = sweep.data.load()
        except jv.InputError:
            assert sweep.damaged or sweep.status_name == "incomplete", "refused although nothing was counted"
            return
        done = data.status.values != 0
        for name in truth.data_vars:
            mine, right = (x[name].values[done].astype(truth[name].dtype) for x in (data, truth))
            assert mine.tolist() == right.tolist() or np.array_equal(mine, right, equal_nan=True), f"{name} differs"

    def ask():
        with contextlib.suppress(jv.InputError):
            read(jv.open_sweep(store))
        found = run_study(asked, store)
        assert found.status_name == "done" and not jv.open_sweep(store).damaged, "not repaired"
        read(found)
        return f"{found.damaged} cases damaged"

    return outcome(ask)


def mutated_layout(value, rng):
    """A JSON value with one part changed."""
    value = json.loads(json.dumps(value))
    places = []

    def walk(inner):
        for key in inner if isinstance(inner, dict) else range(len(inner)):
            places.append((inner, key))
            if isinstance(inner[key], (dict, list)):
                walk(inner[key])

    walk(value)
    owner, key = rng.choice(places)
    odd = [
        None, 3, -1.5, "x", [], {}, [[]], {"tuple": 3}, {"text": "x"}, {"complex": ["a", 1]}, {"dict": [1]},
        {"array": "array0"}, {"status": 3, "names": 4}, {"array": ["a"], "kind": "jax"}, True, "\x1b[31m",
        {"class": "pathlib:Path", "entries": []}, {"class": "jaxvib.motion.run:Run", "fields": {}},
        {"class": "jaxvib.runtime.stored:Path", "entries": ["made_by_load"]}, "array0", "array99",
        {"class": "jaxvib.cli.app:Output", "entries": [False, {"class": "jaxvib.cli.app:Path", "entries": ["made_by_load"]}]},
        {"class": "optimize:Quantity", "fields": {"name": 3}}, {"dict": [[{"list": []}, 1]]},
    ]  # fmt: skip
    match rng.randrange(3):
        case 0:
            owner[key] = rng.choice(odd)
        case 1:
            del owner[key]
        case _:
            other, place = rng.choice(places)
            try:
                owner[key] = json.loads(json.dumps(other[place]))
            except (KeyError, IndexError):
                owner[key] = None
    return value


def mutate_result(path, rng):
    """Changes a saved result; True if it was prepared with the right digest, as somebody does who means harm."""
    if rng.random() < 0.5:
        path.write_bytes(mutated_bytes(path.read_bytes(), rng))
        return False
    with np.load(path) as archive:
        arrays = {name: archive[name] for name in archive.files}
    layout = json.loads(str(arrays.pop("result")))
    arrays.pop("digest")
    for _ in range(rng.choice([1, 2])):
        layout = mutated_layout(layout, rng)
    if rng.random() < 0.3 and arrays:
        name = rng.choice(sorted(arrays))
        arrays[name] = rng.choice(
            [np.zeros((2, 0)), np.asarray("x"), np.asarray([None]), np.zeros(3, "c16"), arrays[name][None]]
        )
    text = json.dumps(layout)
    head = {"result": np.asarray(text), "digest": np.asarray(_digest(text, arrays))}
    (np.savez_compressed if rng.random() < 0.1 else np.savez)(path, **head, **arrays)
    return True


def result_outcome(path, prepared, alike):
    """Outcome of a changed saved result: refused, or the result that was saved; of a prepared one some result."""

    def ask():
        found = jv.load(path)
        if not prepared:
            alike(found)
        return type(found).__name__

    before = set(os.listdir(path.parent))
    found = outcome(ask)
    made = set(os.listdir(path.parent)) - before
    return ("silent", f"made {made}") if made else found


def zip_bomb(path, size):
    """An archive of a few bytes whose entry has so many."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("result.npy", "w", force_zip64=True) as file:
        for _ in range(size >> 20):
            file.write(bytes(1 << 20))


def seeded(seed):
    return random.Random(seed)
