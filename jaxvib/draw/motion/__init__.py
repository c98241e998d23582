"""Charts of motions in time from plain arrays: histories, spectra, paths."""
