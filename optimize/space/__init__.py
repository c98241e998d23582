"""Design space: free numbers of a scene by name, bounds, ties, catalogues, held quantities."""

from optimize.space.space import DesignSpace, Held, hold

__all__ = ["DesignSpace", "Held", "hold"]
