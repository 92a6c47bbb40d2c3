"""The codec `exact`: motion text to the byte, as small as we can."""

from .codec import Exact as Exact
