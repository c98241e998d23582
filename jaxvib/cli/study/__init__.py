"""Commands for studies of a scene, of many cases, or of a record."""
