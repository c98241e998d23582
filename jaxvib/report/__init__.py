"""HTML reports of results, and descriptions of the arguments of parts of a scene file."""
