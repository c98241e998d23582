"""The parameters of a scene: machine, loads, drive, effects; frozen, without time."""
