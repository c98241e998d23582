"""What is built: frozen parameters, no time."""
