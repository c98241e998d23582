"""What can be wanted of a machine: quantities, their arithmetic, demands on them."""
