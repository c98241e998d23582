"""Effects of a scene: physics in addition to machine, loads and drive."""
