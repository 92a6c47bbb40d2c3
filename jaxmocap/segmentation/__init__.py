"""Ways to cut motion into pieces, and to find what recurs in it."""
