"""Training of `learned`: a mean pose, a basis for each metric, spectra, and the densities of levels in context."""
