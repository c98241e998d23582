"""Every number that the source papers print, beside the one that this package computes."""
