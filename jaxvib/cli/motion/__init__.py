"""Commands for motion in time, and for the stability of motions over a parameter of the machine."""
