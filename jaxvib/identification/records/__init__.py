"""Channels of recorded runs, and checks and repairs of their samples."""
