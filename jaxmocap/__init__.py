"""Learned, differentiable transforms for motion-capture data, and the codecs that apply them."""

from .errors import CorruptStream as CorruptStream
from .errors import FormatError as FormatError
from .errors import JaxmocapError as JaxmocapError
from .errors import ModelMismatch as ModelMismatch
from .errors import TruncatedStream as TruncatedStream
from .errors import UnsupportedVersion as UnsupportedVersion
from .motion import Motion as Motion
from .skeleton import Skeleton as Skeleton
