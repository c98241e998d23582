"""Capture: initial speeds from which the balls of a torus reach the speed of the rotor."""
