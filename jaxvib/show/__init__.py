"""Pictures and films of machines: sketches of scenes, animations of their motions."""
