"""How it moves in time."""
