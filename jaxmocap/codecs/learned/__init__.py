"""The learned codec: a transform, densities and an encoder, each trained or optimal for rate and distortion."""
