"""Numbers that the source papers print, each with the way to compute it and the expected verdict."""
