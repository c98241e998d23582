"""Commands for studies of a scene, for sweeps over many cases, and for records of measurements."""
