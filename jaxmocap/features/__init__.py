"""Invertible maps between a Motion and matrices of (frames, channels), one a file."""

from .alignment import HeadingAligned as HeadingAligned
from .alignment import Rigid as Rigid
from .alignment import RootAligned as RootAligned
from .alignment import align_heading as align_heading
from .alignment import align_points as align_points
from .alignment import align_points_about_y as align_points_about_y
from .alignment import align_root as align_root
from .alignment import heading as heading
from .base import AbstractFeature as AbstractFeature
from .markers import Markers as Markers
from .positions import Positions as Positions
from .recovery import Recovered as Recovered
from .recovery import recover as recover
from .recovery import recoverable as recoverable
from .rotation_vectors import RotationVectors as RotationVectors
from .rotation_vectors import mean_rotation as mean_rotation
