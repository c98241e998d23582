"""Maps over a scene's parameters."""
