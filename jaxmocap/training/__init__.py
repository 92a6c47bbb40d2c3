"""Learning transforms from corpora, and keeping them."""
