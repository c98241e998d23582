"""Search for other descriptions of channels, and other laws of friction, with which the model explains the records."""
