"""Studies with many runs: cost of accuracy, importance of effects, limits of approximations."""
