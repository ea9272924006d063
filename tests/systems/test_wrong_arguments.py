"""Constructors of systems refuse arguments that would cause a wrong motion, with one sentence."""

import numpy as np
import pytest
from pydrake.math import RigidTransform, RotationMatrix

from guiderail import systems
from guiderail.models.common.errors import InputError
from guiderail.models.control.command_filters import BarrierFilter, KeepOut, TangentSpaceFilter
from guiderail.models.control.wrench import WrenchBound
from guiderail.models.laws import StateProgress
from guiderail.models.primitives import LinearConstraints
from guiderail.models.templates import load_template
from guiderail.systems.cartesian_impedance_controller import Payload
from guiderail.systems.command_checks import CommandWatchdog
from guiderail.systems.gripper_command import GripperCommand
from guiderail.systems.wrench_signals import MeanContactPoint
from oracles.plants import six_axes

PERIOD = 0.02
STIFFNESS = np.diag([600.0] * 3 + [25.0] * 3)
LIMITS = np.array([20.0] * 3 + [2.0] * 3)
GAINS = systems.ImpedanceGains(STIFFNESS, LIMITS, posture=np.zeros(6))


def make_wrench_sensor(*, tool=None, center=None):
    return systems.WrenchSensor(PLANT, JOINT, tool or [TOOL, HAND], center or FRAME, RotationMatrix(), PERIOD, 0.1)


PLANT, TOOL = six_axes()
_, OTHER_TOOL = six_axes()
WORLD, FRAME = PLANT.world_frame(), TOOL.body_frame()


BODY, OTHER, OTHER_FRAME = PLANT.GetBodyByName("link0"), OTHER_TOOL, OTHER_TOOL.body_frame()
JOINT, HAND = PLANT.GetJointByName("axis5"), PLANT.GetBodyByName("hand")
ZEROS = np.zeros(6)
MOVED_WORLD = {"hole": RigidTransform(), "world": RigidTransform([1.0, 0.0, 0.0])}
TEMPLATE = load_template("grid_clamp")


def schedule(lengths=(1, 2), **thresholds):
    return systems.HistoryLengthSchedule(list(lengths), PERIOD, **thresholds)


def make_impedance(target=WORLD, tool_center=FRAME):
    return systems.CartesianImpedanceController(PLANT, target, tool_center, GAINS, period=PERIOD)


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: make_impedance(target=FRAME), "can move: give a frame that is fixed in the world"),
        (lambda: make_impedance(tool_center=OTHER_FRAME), "tool_center is the frame link5 of another plant"),
        (lambda: systems.CartesianPositionController(PLANT, WORLD, OTHER_FRAME, posture=ZEROS), "of another plant"),
        (
            lambda: systems.JointTorqueWrench(PLANT, WORLD, OTHER_FRAME, period=PERIOD, time_constant=0.0),
            "of another plant",
        ),
        (lambda: systems.ContactDetector(PLANT, [OTHER], [BODY], PERIOD), "the body link5 of another plant"),
        (lambda: systems.MeasuredPose(PLANT, OTHER, RigidTransform()), "the body link5 of another plant"),
        (lambda: systems.RelativePoses(PLANT, [TOOL], OTHER), "reference has the body link5 of another plant"),
        (lambda: systems.ExternalTorqueSensor(PLANT, OTHER, ZEROS, ZEROS, period=PERIOD), "of another plant"),
        (lambda: make_wrench_sensor(tool=[OTHER, HAND]), "tool has the body link5 of another plant"),
        (lambda: make_wrench_sensor(tool=[TOOL]), "welded to it: add hand"),
        (lambda: make_wrench_sensor(center=WORLD), "the center world must be fixed to a body"),
        (lambda: systems.ImpedanceGains(STIFFNESS, np.inf * LIMITS, posture=ZEROS), "wrench limits"),
        (lambda: systems.SctInputMapping(TEMPLATE, MOVED_WORLD, PERIOD), "world of a template can't be moved"),
        (lambda: systems.SctStateMachine(TEMPLATE, MOVED_WORLD, PERIOD), "world of a template can't be moved"),
        (lambda: systems.ActiveConstraintProjector(TEMPLATE, MOVED_WORLD, PERIOD), "world of a template can't"),
        (lambda: systems.ProgressClock(StateProgress((1.0, 1.0), 3), 2, np.nan), "period must be positive"),
    ],
)
def test_system_refuses_arguments_of_a_wrong_motion(build, message):
    with pytest.raises(InputError, match=message):
        build()


KEEP_OUT = KeepOut([[0.5, 2.0]], [[9.0, 3.0]], LinearConstraints.none(2), margin=0.1)
BOUND = WrenchBound(np.array([9.0, 9.0, 15.0, 1.0, 2.0, 3.0]), 17.0, 3.5, 2.5e4)
OPENING = {"lower": np.array([0.0, -1.0]), "upper": np.array([0.04, 1.0]), "opening": np.array([0.03, 0.5])}
EIGHT = {"bound": np.zeros(8), "max_rate": np.full(8, 1e-3), "period": PERIOD}
GOVERNOR = {
    "stiffness": np.full(6, 30.0),
    "damping": np.full(6, 0.5),
    "inertia": (0.01, 1e-4),
    "step": PERIOD,
    "bound": BOUND,
}
TANK = {"stiffness": np.ones(6), "damping": np.ones(6), "bound": BOUND, "capacity": 1.0, "period": PERIOD}
FREE_GAINS = {"stiffness": STIFFNESS, "wrench_limits": LIMITS, "posture": np.zeros(7)}
# Valid arguments of a constructor, and values out of range of single arguments with a word of the error.
CONTACT = {"min_force": 0.5, "period": PERIOD, "time_constant": 1.0}
RULE = (0.1, 0.1)  # tolerances of lengths and angles
THRESHOLDS = {"contact_threshold": 1.0, "release_threshold": 0.5}
OUT_OF_RANGE = [
    (systems.CenterOfPressure, {"min_force": 1.0}, "min_force", (0.0, -1.0, np.nan, np.inf), ""),
    (systems.CommandDisturbance, {"size": 1, "period": PERIOD}, "loss_probability", (1.0, -0.1), ""),
    (BarrierFilter, {"keep_out": KEEP_OUT, "decay": 1.0}, "decay", (0.0, -0.1, 1.1, np.nan), "fraction"),
    (TangentSpaceFilter, {"keep_out": KEEP_OUT, "width": 0.1}, "width", (0.0, -1.0, np.inf), "positive"),
    (CommandWatchdog, {"period": 0.01, "timeout": 0.1}, "period", (0.0, np.nan, np.inf), ""),
    (CommandWatchdog, {"period": 0.01, "timeout": 0.1}, "timeout", (0.0, np.nan, np.inf), ""),
    (GripperCommand, OPENING | {"period": 0.01}, "opening", (np.array([0.05, 0.0]), np.array([np.nan, 0.0])), ""),
    (GripperCommand, OPENING | {"period": 0.01}, "period", (0.0,), ""),
    (schedule, THRESHOLDS, "release_threshold", (2.0, 1.0005, np.nan, -0.1), ""),
    (schedule, {}, "contact_threshold", (np.nan, np.inf), ""),
    (schedule, {}, "lengths", ([], [0, 3], [1, 2.5], [1, np.nan]), ""),
    (MeanContactPoint, CONTACT, "min_force", (0.0, np.nan), ""),
    (MeanContactPoint, CONTACT, "time_constant", (0.01, np.inf, np.nan), ""),
    (systems.PhaseWrenchLimit, EIGHT, "bound", (np.full(8, np.nan), np.full(8, -1e-9)), "eight finite bounds"),
    (systems.PhaseWrenchLimit, EIGHT, "bound", ([0.0] * 7 + [np.inf], [-1e-9] + [0.0] * 7), "eight finite bounds"),
    (systems.PhaseWrenchLimit, EIGHT, "max_rate", (np.r_[np.ones(7), 0.0], np.r_[np.nan, np.ones(7)]), "eight finite"),
    (systems.PhaseWrenchLimit, EIGHT, "max_rate", (np.full(8, np.inf),), "eight finite bounds"),
    (systems.PhaseWrenchLimit, EIGHT, "period", (0.0,), "period must be positive"),
    (systems.ReferenceGovernor, GOVERNOR, "stiffness", (np.zeros(6),), "six positive stiffnesses"),
    (systems.ReferenceGovernor, GOVERNOR, "damping", (np.full(5, 1.0),), "six positive stiffnesses"),
    (systems.ReferenceGovernor, GOVERNOR, "stiffness", (np.full(6, np.inf),), "all finite"),
    (systems.ReferenceGovernor, GOVERNOR, "damping", (np.full(6, np.inf),), "all finite"),
    (systems.ReferenceGovernor, GOVERNOR, "inertia", ((0.0, 1.0), (1.0, np.inf), (np.nan, 1.0)), "must be positive"),
    (systems.ReferenceGovernor, GOVERNOR, "step", (0.0,), "period must be positive"),
    (
        StateProgress,
        {"tolerance": (0.1, 0.1), "max_lag": 3},
        "tolerance",
        ((0.0, 0.1), (0.1, np.nan), (0.1,)),
        "tolerance",
    ),
    (systems.EnergyTank, TANK, "stiffness", (np.zeros(6),), "six positive stiffnesses"),
    (systems.EnergyTank, TANK, "capacity", (0.0, np.inf), "capacity must be positive and finite"),
    (systems.EnergyTank, TANK, "bound", (WrenchBound(np.r_[np.inf, np.ones(5)], 20.0, 5.2),), "finite limits"),
    (systems.EnergyTank, TANK, "period", (0.0,), "period must be positive"),
    (systems.ImpedanceGains, FREE_GAINS, "stiffness", (np.eye(3), np.eye(6) + np.eye(6, k=1)), ""),
    *(
        (systems.ImpedanceGains, FREE_GAINS, "stiffness", (np.diag([*5 * [1.0], last]), np.diag([last] * 6)), "")
        for last in (-1.0, 0.0, 1.0005e8, 1e300, np.inf, np.nan)
    ),
    *(
        (systems.ImpedanceGains, FREE_GAINS, "stiffness", (np.where(np.eye(6) > 0.0, 1.0, entry),), "")
        for entry in (-1e300, -np.inf, np.inf, -1.0)
    ),
    (systems.ImpedanceGains, FREE_GAINS, "wrench_limits", (np.zeros(6), np.full(6, np.nan), np.ones(5)), ""),
    (systems.ImpedanceGains, FREE_GAINS, "wrench_limits", (np.array([1.0, 1, 1, 1, 1, 0]),), ""),
    (systems.ImpedanceGains, FREE_GAINS, "damping_ratio", (0.0, np.inf, np.nan), ""),
    (systems.ImpedanceGains, FREE_GAINS, "posture_stiffness", (-1.0, np.inf, np.nan), ""),
    (systems.ImpedanceGains, FREE_GAINS, "posture_damping", (-1.0, np.inf, np.nan), ""),
    (systems.ImpedanceGains, FREE_GAINS, "posture", (np.full(7, np.nan), np.array([0.0] * 6 + [np.inf])), ""),
    (Payload, {"mass": 1.0}, "mass", (-1.0, np.inf), "payload"),
    (Payload, {"mass": 1.0}, "center", ((0.0, 0.0), (np.nan, 0.0, 0.0)), "payload"),
]


@pytest.mark.parametrize(("build", "valid", "name", "values", "word"), OUT_OF_RANGE)
def test_argument_is_refused_when_it_is_out_of_range(build, valid, name, values, word):
    build(**valid)
    for value in values:
        with pytest.raises(InputError, match=word or None):
            build(**valid | {name: value})


def test_state_machine_refuses_a_start_that_is_not_finite():
    machine = systems.SctStateMachine(TEMPLATE, {"hole": RigidTransform()}, PERIOD)
    context = machine.CreateDefaultContext()
    machine.get_initial_pose_input_port().FixValue(context, np.full(6, np.nan))
    with pytest.raises(InputError, match="must be finite"):
        machine.ExecuteInitializationEvents(context)
