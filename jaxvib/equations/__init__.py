"""Equations of a scene: full, averaged and linear equations, forces, energy and power. Scenes become equations only here."""
