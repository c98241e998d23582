"""A local page on which a machine's numbers are moved by sliders, and its diagrams follow."""
