"""Jams of light loads: speeds, folds, phase patterns."""
