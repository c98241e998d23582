"""Search methods: many starts at once, a descent on optax, sequential quadratic programming, catalogues by branch and bound."""
