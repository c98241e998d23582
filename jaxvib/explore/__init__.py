"""Local page with sliders for the parameters of a machine, and diagrams that follow the sliders."""
