"""Shapes of parts of a machine, and animations of them, from plain numbers."""
