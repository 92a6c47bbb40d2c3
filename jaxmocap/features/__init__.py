"""Invertible maps between a Motion and matrices of (frames, channels), one a file."""
