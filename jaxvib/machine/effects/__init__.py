"""Effects that a scene may call for."""
