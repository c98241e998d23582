"""Motions in time as figures: histories, spectra, paths; plain arrays, no machine."""
