"""Design: what may change, what is wanted, who searches."""
