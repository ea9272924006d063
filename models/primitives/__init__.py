"""Movement primitives learned from demonstrations, and the constraints and actions that modulate them."""

from guiderail.models.primitives.constraints import LinearConstraints
from guiderail.models.primitives.demonstrations import Demonstrations, align_demonstrations
from guiderail.models.primitives.kernels import Kernel, Matern52, SquaredExponential, make_kernel, register_kernel
from guiderail.models.primitives.kmp import Kmp
from guiderail.models.primitives.lc_ns_kmp import LcNsKmp
from guiderail.models.primitives.poses import pose_demonstrations, pose_outputs, pose_rotation
from guiderail.models.primitives.prediction import BatchPrediction, Modification, Prediction
from guiderail.models.primitives.qp import UnsolvableError
from guiderail.models.primitives.reference import ReferenceTrajectory
from guiderail.models.primitives.stepper import Command, PrimitiveStepper

__all__ = [
    "BatchPrediction",
    "Command",
    "Demonstrations",
    "Kernel",
    "Kmp",
    "LcNsKmp",
    "LinearConstraints",
    "Matern52",
    "Modification",
    "Prediction",
    "PrimitiveStepper",
    "ReferenceTrajectory",
    "SquaredExponential",
    "UnsolvableError",
    "align_demonstrations",
    "make_kernel",
    "pose_demonstrations",
    "pose_outputs",
    "pose_rotation",
    "register_kernel",
]
