"""Parts of a scene: machine, loads, drive and effects. They are immutable parameters and contain no time."""
