"""Many runs: what a question costs, what an effect is worth, where an approximation holds."""
