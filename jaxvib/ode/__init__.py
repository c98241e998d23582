"""The integration engine: solvers, step-size control and adjoints for any pytree of arrays."""
