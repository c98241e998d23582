"""Plain arrays onto axes, one style; knows no machine."""
