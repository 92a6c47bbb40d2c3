"""`live`: motion coded frame by frame with nothing to wait for, as a file or as packets that a network may lose."""
