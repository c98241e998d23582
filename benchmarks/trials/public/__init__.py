"""Cases of `public_cases.py` by what they ask for."""
