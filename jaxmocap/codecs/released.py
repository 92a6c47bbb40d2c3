"""Models that were released with this package, by number: a stream that needs one names it in a byte, not by its digest.

A number stands for one model for ever. A model is added at the end, when it is shipped; none is changed or taken away.
"""

# The first bytes of each one's SHA-256, as many as headers hold. Number 0 is the first.
RELEASED = (
    bytes.fromhex("cb7cb2c8"),  # learned, for the CMU rig
    bytes.fromhex("25d8eb7e"),  # live, for the CMU rig
)
