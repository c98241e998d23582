"""Trial of mutated files, stores and saved results: each must give the right result or one message about the input.

    python benchmarks/trials/mutated_files.py studies --count 400
    python benchmarks/trials/mutated_files.py scenes --count 2000
    python benchmarks/trials/mutated_files.py designs --count 2000
    python benchmarks/trials/mutated_files.py records --count 2000
    python benchmarks/trials/mutated_files.py stores --count 400
    python benchmarks/trials/mutated_files.py results --count 2000

Each case follows from its seed (the first one is `--first`) and is tested by `tests/helpers/mutations.py`. A study, scene,
design or measurement file is read. In a store one to three files are changed; then it is read, continued and read again. A
saved result has changed bytes, or is written with unusual parts and the right digest. The failures with their seeds, and the
numbers of outcomes, are printed. The exit code is 1 if there is a failure: another error than the allowed ones, more than 60 s
of CPU time, or a wrong number.
"""

from __future__ import annotations

import argparse
import collections
import os
import pathlib
import shutil
import sys
import tempfile
import time

import jax
import numpy as np

import jaxvib as jv
from jaxvib.machine.files import TEMPLATES
from optimize.files import TEMPLATES as DESIGNS
from optimize.files import load_design

sys.path[:0] = [str(pathlib.Path(__file__).parents[2] / "tests" / "helpers")]

import file_texts  # noqa: E402
import mutations  # noqa: E402

jv.prepare_cpu()
jax.config.update("jax_enable_x64", True)


def machine() -> jv.Scene:
    return jv.Scene(
        jv.two_mass(mass=(120.0, 95.0), stiffness=(5e4, 5e4), damping=(40.0, 40.0), link_stiffness=2e5, link_damping=60.0),
        jv.balls(count=3, mass=0.8, radius=0.12, drag=1.5),
        jv.ConstantSpeed(60.0),
    )


def studies(folder: pathlib.Path):
    jv.save_scene(machine(), folder / "machine.toml")
    originals = {}
    for base in (file_texts.STUDY, file_texts.STUDY_OF_JAMS, file_texts.STUDY_OF_RUNS):
        (folder / "study.toml").write_text(base)
        originals[base] = mutations.load_study(folder / "study.toml")

    def one(rng):
        base = rng.choice(list(originals))
        return mutations.study_outcome(folder, mutations.mutated_text(base, rng), originals[base], base)

    return one


def scenes(folder: pathlib.Path):
    def key(scene):
        return jv.scene_to_toml(scene)

    return _files(folder / "scene.toml", jv.load_scene, key, [jv.scene_to_toml(machine()), *TEMPLATES.values()])


def designs(folder: pathlib.Path):
    jv.save_scene(machine(), folder / "machine.toml")
    return _files(folder / "design.toml", load_design, mutations.design_key, [file_texts.DESIGN, DESIGNS["design"]])


def records(folder: pathlib.Path):
    texts = [file_texts.RECORD, file_texts.RECORD.replace("angle (deg)", "angle [mrad]").replace("# camera\n", "")]
    return _files(folder / "record.csv", jv.read_record, mutations.record_key, texts, mutations.numbers_of_csv)


def _files(path, read, key, texts, numbers=mutations.numbers_of_toml):
    originals = {}
    for text in texts:
        path.write_text(text)
        originals[text] = key(read(path))

    def one(rng):
        base = rng.choice(list(originals))
        text = mutations.mutated_text(base, rng)
        return mutations.file_outcome(path, text, read, key, (base, originals[base]), numbers)

    return one


def stores(folder: pathlib.Path):
    jv.save_scene(machine(), folder / "machine.toml")
    (folder / "study.toml").write_text(file_texts.STUDY)
    asked = mutations.load_study(folder / "study.toml")
    whole = pathlib.Path(mutations.run_study(asked, folder / "whole.zarr").store)
    truth = jv.open_sweep(whole).data.load()

    def one(rng):
        store = folder / "study.zarr"
        shutil.rmtree(store, ignore_errors=True)
        shutil.copytree(whole, store)
        mutations.mutate_store(store, rng)
        return mutations.store_outcome(store, asked, truth)

    return one


def results(folder: pathlib.Path):
    scene = machine()
    saved = [jv.jam_modes(scene), jv.branches(scene)]
    saved += [jv.simulate(scene, 0.2, estimate=False, save="window"), jv.jam_orbit(scene, mode=3)]
    os.chdir(folder)

    def one(rng):
        result = rng.choice(saved)
        path = result.save(folder / "result.npz")
        prepared = mutations.mutate_result(path, rng)

        def alike(found):
            for mine, its in zip(jax.tree.leaves(found), jax.tree.leaves(result), strict=True):
                assert np.array_equal(np.asarray(mine), np.asarray(its), equal_nan=True), "another number"

        return mutations.result_outcome(path, prepared, alike)

    return one


PARTS = {each.__name__: each for each in (studies, scenes, designs, records, stores, results)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("part", choices=list(PARTS))
    parser.add_argument("--count", type=int, default=400)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=540.0, help="no further case is begun after so many")
    given = parser.parse_args()
    folder, begun, counts = pathlib.Path(tempfile.mkdtemp()), time.monotonic(), collections.Counter()
    try:
        one = PARTS[given.part](folder)
        for seed in range(given.first, given.first + given.count):
            if time.monotonic() - begun > given.seconds:
                break
            kind, said = one(mutations.seeded(seed))
            counts[kind] += 1
            if kind not in ("refused", "accepted"):
                print(f"seed {seed}: {kind}: {said}", flush=True)
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    print(f"{given.part}: {sum(counts.values())} cases in {time.monotonic() - begun:.0f} s: {dict(counts)}")
    sys.exit(bool(set(counts) - {"refused", "accepted"}))


if __name__ == "__main__":
    main()
