"""Routes: the files that a reader enters who follows one call of a public function."""

import pathlib
import sys

import pytest

import jaxvib as jv

PACKAGE = pathlib.Path(jv.__file__).parent

FLOORS = ("boundary.py", "errors.py", "code_changes.py", "runtime", "units")
"""Lowest floors, which are not part of a route."""


def route_of(call):
    """(files, returns) of a call: the files of the package in the order in which functions are entered for the first time, and
    those of them that are entered again after another file."""
    files, returns, seen = [], [], set()
    last = None

    def profile(frame, event, _):
        nonlocal last
        code = frame.f_code
        path = pathlib.Path(code.co_filename)
        if event != "call" or code in seen or not path.is_relative_to(PACKAGE):
            return
        name = path.relative_to(PACKAGE)
        if name.parts[0] in FLOORS or code.co_name in ("<listcomp>", "<dictcomp>", "<setcomp>"):
            return
        seen.add(code)
        if name != last:
            (returns if name in files else files).append(name)
            last = name

    sys.setprofile(profile)
    try:
        call()
    finally:
        sys.setprofile(None)
    return list(map(str, files)), list(map(str, returns))


PLATFORM = jv.Scene(
    jv.one_mass(mass=50.0, stiffness=4e4, damping=100.0),
    jv.balls(count=2, mass=0.5, radius=0.1, drag=0.5),
    jv.ConstantSpeed("60 rad/s"),
)
ANTIPHASE = jv.Dimensionless(
    "antiphase",
    natural=(1 / 3, 1 / 3),
    damping=(0.01, 0.01),
    link_natural=2 / 3,
    link_damping=0.01,
    rho=1.0,
    eps=0.05,
    beta=1.0,
    speed=3.0,
).scene()


@pytest.mark.parametrize(
    ("call", "most_files", "most_returns"),
    [(lambda: jv.simulate(PLATFORM, 2.0), 12, 8), (lambda: jv.jam_orbit(ANTIPHASE, mode=3), 9, 8)],
    ids=["simulate", "jam_orbit"],
)
def test_routes_are_short(call, most_files, most_returns):
    call()  # a first call also compiles programs, some of them in threads that may end after it
    files, returns = min((route_of(call) for _ in range(3)), key=lambda route: len(route[0]) + len(route[1]))
    assert files[0].endswith(("simulate.py", "jam_orbit.py"))
    assert len(files) <= most_files, files
    assert len(returns) <= most_returns, (files, returns)
