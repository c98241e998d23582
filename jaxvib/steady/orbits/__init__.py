"""Exact periodic motions and their stability."""
