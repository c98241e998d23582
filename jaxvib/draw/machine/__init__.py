"""Parts of a machine as shapes, and films of them; plain numbers, no machine."""
