"""Runs after a fit: plans of runs to record."""
