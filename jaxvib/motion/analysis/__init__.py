"""What is read off a motion in time."""
