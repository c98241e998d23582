"""Search methods: descent from many starts (optax), sequential quadratic programming, branch and bound for catalogues."""
