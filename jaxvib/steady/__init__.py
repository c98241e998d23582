"""Steady states: jams, periodic orbits, balanced motion, whirl."""
