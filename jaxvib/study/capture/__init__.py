"""Capture: which starts bring the balls of a torus to the rotor's speed."""
