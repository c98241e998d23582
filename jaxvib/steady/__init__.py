"""How it settles."""
