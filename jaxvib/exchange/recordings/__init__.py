"""Recordings of measuring devices."""
