"""Friction of a pendulum bearing from its swings."""
