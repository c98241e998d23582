"""Auto-balancing: characteristic speeds, the criterion, stability."""
