"""Drake LeafSystems, one a file, each a thin shell over a law that can be called without a diagram.

Every system, and what its constructor takes, can be imported from here: `from guiderail.systems import HistoryBuffer`.
A module is imported when the first of its names is used.
"""

import re
from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from guiderail.systems.active_constraint_projector import ActiveConstraintProjector
    from guiderail.systems.cartesian_impedance_controller import CartesianImpedanceController, ImpedanceGains
    from guiderail.systems.cartesian_position_controller import CartesianPositionController, SpeedLimits
    from guiderail.systems.command_watchdog import CommandWatchdog
    from guiderail.systems.constraint_violation import ConstraintViolation
    from guiderail.systems.contact_watch import ContactWatch
    from guiderail.systems.episode_monitor import TERMINATIONS, Condition, EpisodeMonitor
    from guiderail.systems.history_buffer import HistoryBuffer
    from guiderail.systems.history_length_schedule import HistoryLengthSchedule
    from guiderail.systems.impedance_monitor import ImpedanceMonitor
    from guiderail.systems.joint_torque_wrench import JointTorqueWrench
    from guiderail.systems.lc_ns_kmp_system import LcNsKmpSystem
    from guiderail.systems.mean_force import MeanForce
    from guiderail.systems.measured_pose import MeasuredPose
    from guiderail.systems.meshcat_device import MeshcatDevice
    from guiderail.systems.policy_system import PolicyError, PolicySystem
    from guiderail.systems.recorder import Recorder, Recording
    from guiderail.systems.relative_poses import RelativePoses
    from guiderail.systems.residual import Residual
    from guiderail.systems.reward_system import RewardSystem, RewardTerm
    from guiderail.systems.safety_filter import SafetyFilter
    from guiderail.systems.safety_ledger import SafetyLedger
    from guiderail.systems.sct_input_mapping import SctInputMapping
    from guiderail.systems.sct_state_machine import SctStateMachine
    from guiderail.systems.wrench_sensor import WrenchSensor

__all__ = [
    "TERMINATIONS",
    "ActiveConstraintProjector",
    "CartesianImpedanceController",
    "CartesianPositionController",
    "CommandWatchdog",
    "Condition",
    "ConstraintViolation",
    "ContactWatch",
    "EpisodeMonitor",
    "HistoryBuffer",
    "HistoryLengthSchedule",
    "ImpedanceGains",
    "ImpedanceMonitor",
    "JointTorqueWrench",
    "LcNsKmpSystem",
    "MeanForce",
    "MeasuredPose",
    "MeshcatDevice",
    "PolicyError",
    "PolicySystem",
    "Recorder",
    "Recording",
    "RelativePoses",
    "Residual",
    "RewardSystem",
    "RewardTerm",
    "SafetyFilter",
    "SafetyLedger",
    "SctInputMapping",
    "SctStateMachine",
    "SpeedLimits",
    "WrenchSensor",
]

# A system's module has its name. What else is exported is in the module of the system that it belongs to.
_SYSTEM_OF = {
    "TERMINATIONS": "EpisodeMonitor",
    "Condition": "EpisodeMonitor",
    "ImpedanceGains": "CartesianImpedanceController",
    "PolicyError": "PolicySystem",
    "Recording": "Recorder",
    "RewardTerm": "RewardSystem",
    "SpeedLimits": "CartesianPositionController",
}


def __getattr__(name: str) -> object:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module = re.sub(r"(?<!^)(?=[A-Z])", "_", _SYSTEM_OF.get(name, name)).lower()
    value = globals()[name] = getattr(import_module(f"{__name__}.{module}"), name)
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
