"""Exchange with other tools: functional mock-up units, state-space models, files of modal analysis."""
