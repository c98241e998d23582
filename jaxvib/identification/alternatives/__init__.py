"""Other descriptions of channels, and other laws of friction, with which a machine explains records."""
