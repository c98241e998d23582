"""Structures of machines: platforms, rotors, bodies in a plane."""
