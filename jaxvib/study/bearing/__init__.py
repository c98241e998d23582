"""Friction of a pendulum bearing from recorded swings."""
