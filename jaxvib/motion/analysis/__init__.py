"""Amplitudes, speeds and regimes of a motion in time."""
