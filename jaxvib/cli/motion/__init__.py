"""Commands about motion in time, and about the stability of motions as a number of the machine varies."""
