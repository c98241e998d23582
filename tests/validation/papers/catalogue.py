"""Every printed number, paper by paper."""

from papers import antiphase, bearing, criterion, motors, rotor, torus
from papers.printed import PrintedNumber

PAPERS = {
    "antiphase": "two-mass machine",
    "criterion": "one, two, three masses",
    "rotor": "rotor with four pendulums",
    "torus": "rotor with two balls in a torus",
    "bearing": "bearing of a pendulum",
    "two motors": "frame with two motors",
    "dual-frequency": "one-mass machine with balls",
}
"""The papers by name, and their machines."""

NUMBERS: tuple[PrintedNumber, ...] = (
    *antiphase.NUMBERS,
    *criterion.NUMBERS,
    *rotor.NUMBERS,
    *torus.NUMBERS,
    *bearing.NUMBERS,
    *motors.NUMBERS,
)
"""Every printed number."""
