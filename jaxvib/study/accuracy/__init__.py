"""Cost of accuracy: work-precision diagrams, comparison of tiers, convergence with harmonics."""
