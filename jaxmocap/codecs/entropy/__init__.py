"""Entropy coding: integers in, bytes out, with nothing but integers in between."""
