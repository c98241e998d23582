"""Fits of machines on nonlinear supports, such as stops."""
