"""Every printed number, paper by paper."""

from papers import antiphase, bearing, criterion, rotor, torus
from papers.printed import PrintedNumber

PAPERS = {
    "antiphase": "two-mass machine",
    "criterion": "one, two, three masses",
    "rotor": "rotor with four pendulums",
    "torus": "rotor with two balls in a torus",
    "bearing": "bearing of a pendulum",
}
"""The papers by name, and their machines."""

NUMBERS: tuple[PrintedNumber, ...] = (
    *antiphase.NUMBERS,
    *criterion.NUMBERS,
    *rotor.NUMBERS,
    *torus.NUMBERS,
    *bearing.NUMBERS,
)
"""Every printed number."""
