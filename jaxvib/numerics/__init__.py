"""Small linear algebra, roots and Fourier interpolation on plain arrays."""
