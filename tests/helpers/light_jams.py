"""Jams of light loads from a scene."""

from jaxvib.equations.linear import jammed_model
from jaxvib.steady.jams.folds import rotor_speed_at


def jam_rotor_speed(scene, omega):
    return rotor_speed_at(jammed_model(scene), omega)


def steady_displacement(scene, omega):
    return jammed_model(scene).displacement(omega)
