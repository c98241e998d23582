"""Numerical methods on plain arrays: small linear algebra, roots, extrema, Fourier interpolation, sines, noise."""
