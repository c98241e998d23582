"""Exchange with other tools: functional mock-up units, state-space models, universal files, recordings."""
