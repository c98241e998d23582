"""Cases of `compare.py` by what they ask for."""
