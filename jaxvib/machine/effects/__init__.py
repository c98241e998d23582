"""Effects of a scene beyond machine, loads and drive."""
