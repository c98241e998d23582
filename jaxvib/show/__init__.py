"""Sketches of scenes, and animations of their motions."""
