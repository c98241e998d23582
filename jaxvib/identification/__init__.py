"""Identification of machines from recorded runs."""
