"""Quantities of a machine, their arithmetic, and demands on them."""
