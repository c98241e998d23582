"""Shapes of parts of a machine, and films of them, from plain numbers."""
