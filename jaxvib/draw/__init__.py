"""Charts of plain arrays in a common style; this package does not depend on machines or results."""
