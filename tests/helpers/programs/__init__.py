"""Programs of scenes, recorded."""
