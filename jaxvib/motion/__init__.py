"""Time integration and analysis of runs."""
