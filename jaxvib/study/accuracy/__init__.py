"""The cost of accuracy: work-precision diagrams, tiers, harmonics."""
