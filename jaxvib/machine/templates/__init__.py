"""Commented scene files, which `jaxvib new` prints.

This module imports neither NumPy nor JAX, because the command line needs the names of the files for its help.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path


class Templates(Mapping[str, str]):
    """Commented example files by name; each is read when it is used.

    **Arguments**: the `folder` of the files; `parts`: for each name the files, without ".toml", whose texts are joined;
    `speeds`: rotor speeds of examples that do not have the default, 1500 rpm.
    """

    def __init__(self, folder: Path, parts: Mapping[str, tuple[str, ...]], **speeds: str) -> None:
        self._folder, self._parts, self._speeds = folder, parts, speeds

    def __getitem__(self, name: str) -> str:
        text = "\n".join((self._folder / f"{part}.toml").read_text(encoding="utf-8") for part in self._parts[name])
        return text.replace("{speed}", self._speeds.get(name, "1500 rpm"))

    def __iter__(self) -> Iterator[str]:
        return iter(self._parts)

    def __len__(self) -> int:
        return len(self._parts)


_FOLDER = Path(__file__).parent
_PLATFORMS = {name: (name, "platforms_end") for name in ("one_mass", "two_mass", "three_mass", "network")}
_ROTORS = {name: (name, "rotors_end") for name in ("planar_rotor", "rotor")}

TEMPLATES = Templates(
    _FOLDER, {**_PLATFORMS, **_ROTORS, "ball_balancer": ("ball_balancer",), "torus": ("torus",)}, one_mass="600 rpm"
)
"""Scene files with comments for every kind of platforms and rotors, a ball balancer, and a rotor with balls in a torus."""

SCREENS = Templates(_FOLDER, {name: (name,) for name in ("linear_screen", "circular_screen", "feeder")})
"""Scene files of a linear screen, a circular screen and a feeder, with the numbers of a data sheet."""
