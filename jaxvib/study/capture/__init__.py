"""Capture: initial speeds from which the balls of a torus reach the rotor speed."""
