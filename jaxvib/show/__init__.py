"""Machines as pictures and films: sketches of scenes, animations of their motions."""
