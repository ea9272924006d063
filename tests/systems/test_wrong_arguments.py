"""Constructors of systems refuse arguments that would cause a wrong motion, with one sentence."""

import numpy as np
import pytest
from pydrake.math import RigidTransform, RotationMatrix

from guiderail import systems
from guiderail.models.common.errors import InputError
from guiderail.models.laws import StateProgress
from guiderail.models.templates import load_template
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


def test_state_machine_refuses_a_start_that_is_not_finite():
    machine = systems.SctStateMachine(TEMPLATE, {"hole": RigidTransform()}, PERIOD)
    context = machine.CreateDefaultContext()
    machine.get_initial_pose_input_port().FixValue(context, np.full(6, np.nan))
    with pytest.raises(InputError, match="must be finite"):
        machine.ExecuteInitializationEvents(context)
