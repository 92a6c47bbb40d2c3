"""Learned, differentiable transforms for motion-capture data, and the codecs that apply them.

This is the index of what most programs need; `jaxmocap.transforms`, `jaxmocap.features`, `jaxmocap.codecs` and
`jaxmocap.training` hold the rest.
"""

from .errors import CorruptStream as CorruptStream
from .errors import FormatError as FormatError
from .errors import JaxmocapError as JaxmocapError
from .errors import ModelMismatch as ModelMismatch
from .errors import TruncatedStream as TruncatedStream
from .errors import UnsupportedVersion as UnsupportedVersion
from .formats import read_motion as read_motion
from .formats import write_motion as write_motion
from .kinematics import Pose as Pose
from .kinematics import forward as forward
from .kinematics import pose as pose
from .kinematics import positions_cm as positions_cm
from .metrics import compare as compare
from .motion import Motion as Motion
from .skeleton import Skeleton as Skeleton
