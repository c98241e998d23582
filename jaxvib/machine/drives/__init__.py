"""Drives: prescribed speeds, motors, converters and speed control."""
