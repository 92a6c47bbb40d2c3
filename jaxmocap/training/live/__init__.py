"""Training of `live`: the tracker in real numbers, its network end to end, and the densities of packets."""
