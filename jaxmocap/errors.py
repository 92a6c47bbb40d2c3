"""The errors that a user can act on, one class a remedy."""


class JaxmocapError(ValueError):
    """Base of every error that jaxmocap raises about the bytes it was given."""


class FormatError(JaxmocapError):
    """An input file breaks its format: mend the file. The message names file, line and what was wanted."""


class CorruptStream(JaxmocapError):
    """The bytes of a stream contradict themselves: fetch them again."""


class TruncatedStream(CorruptStream):
    """The stream ends early: wait for the rest, or fetch it again."""


class UnsupportedVersion(JaxmocapError):
    """The stream was written by a newer format or codec: upgrade jaxmocap."""


class ModelMismatch(JaxmocapError):
    """The stream needs a model that is not at hand: pass the one whose digest the message names."""
