"""Parts of a scene: machine, loads, drive and effects. They are immutable and contain parameters, not states."""
