"""Commands about motion in time, and about what becomes of it as a number of the machine grows."""
