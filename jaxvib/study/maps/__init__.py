"""Maps over the parameters of a scene."""
