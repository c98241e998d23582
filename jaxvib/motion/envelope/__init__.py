"""Averaged motion of light loads."""
