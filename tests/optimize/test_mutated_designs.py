"""Mutated design files end in one sentence or in another design."""

from file_texts import DESIGN
from mutations import design_key, file_outcome, mutated_text, seeded
from scenes import scene

import jaxvib as jv
from optimize.files import load_design


def test_mutated_design_files_are_refused_or_another_design(tmp_path):
    jv.save_scene(scene("two_mass", speed=60.0), tmp_path / "machine.toml")
    path = tmp_path / "design.toml"
    path.write_text(DESIGN)
    base = DESIGN, design_key(load_design(path))
    found = [file_outcome(path, mutated_text(DESIGN, seeded(seed)), load_design, design_key, base) for seed in range(120)]
    assert [(seed, each) for seed, each in enumerate(found) if each[0] not in ("refused", "accepted")] == []
    assert sum(kind == "refused" for kind, _ in found) > 40


def test_another_number_with_the_same_key_is_seen(tmp_path):
    path = tmp_path / "design.toml"
    found = file_outcome(path, "starts = 3", lambda _: None, lambda _: "same", ("starts = 2", "same"))
    assert found[0] == "silent"
