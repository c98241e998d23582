"""Local page with sliders for the numbers of a machine, and diagrams that follow them."""
