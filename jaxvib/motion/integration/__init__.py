"""Equations, methods and steps of time integration."""
