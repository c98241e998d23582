"""Repeated records of one machine by SciPy, and fits to them."""
