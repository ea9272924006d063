import numpy as np
import pytest
from pydrake.math import RigidTransform
from pydrake.systems.analysis import Simulator

from guiderail.models.common.errors import InputError
from guiderail.models.common.transforms import transform_to_pose
from guiderail.models.templates import load_template
from guiderail.systems.sct_state_machine import SctStateMachine

PERIOD = 2.0**-7
FRAMES = {"mug_tip": RigidTransform([0.0, 0.1, 0.0])}


def pose_at(distance):
    """Return a pose at this distance [m] in front of the mug."""
    return np.array([0.0, 0.1 - distance, 0.0, 0.0, 0.0, 0.0])


@pytest.fixture(scope="module")
def template():
    return load_template("pouring")


class Rig:
    """State machine that starts at a distance from the mug [m]."""

    def __init__(self, template, start):
        self.system = SctStateMachine(template, FRAMES, PERIOD)
        self.simulator = Simulator(self.system)
        self.context = self.simulator.get_mutable_context()
        self.system.get_initial_pose_input_port().FixValue(self.context, pose_at(start))
        self.pose = self.system.get_pose_input_port().FixValue(self.context, pose_at(start))
        self.simulator.Initialize()
        self.steps = 0

    def step(self, distance):
        """Set the distance from the mug [m], run the events of the next instant, and return the state."""
        self.pose.GetMutableData().set_value(pose_at(distance))
        self.steps += 1
        self.simulator.AdvanceTo((self.steps + 0.5) * PERIOD)
        return self.state()

    def state(self):
        return int(self.system.get_state_output_port().Eval(self.context)[0])


def test_state_machine_has_its_ports(template):
    system = SctStateMachine(template, FRAMES, PERIOD)
    names = [system.get_output_port(i).get_name() for i in range(system.num_output_ports())]
    assert names == ["state", "transition_distance", "progress"]


def test_state_has_no_direct_feedthrough(template):
    system = SctStateMachine(template, FRAMES, PERIOD)
    state = system.get_state_output_port().get_index()
    assert not any(system.HasDirectFeedthrough(i, state) for i in range(2))
    progress = system.get_progress_output_port().get_index()
    assert not system.HasDirectFeedthrough(system.get_initial_pose_input_port().get_index(), progress)


@pytest.mark.parametrize(("start", "state"), [(0.4, 0), (0.2, 1), (0.05, 2)])
def test_state_machine_begins_in_the_state_of_the_initial_pose(template, start, state):
    assert Rig(template, start).state() == state


def test_state_machine_returns_with_hysteresis(template):
    rig = Rig(template.without_active_constraints(), 0.4)
    assert [rig.step(d) for d in (0.26, 0.24, 0.26, 0.28, 0.24, 0.10, 0.07, 0.10, 0.40)] == [0, 1, 1, 0, 1, 1, 2, 2, 2]


def test_state_machine_makes_at_most_one_transition_per_instant(template):
    rig = Rig(template.without_active_constraints(), 0.4)
    assert [rig.step(0.05) for _ in range(3)] == [1, 2, 2]


def test_transition_waits_until_the_constraints_are_reachable(template):
    """The rotation of an upright thermos to the tilt of pouring takes longer than a period."""
    rig = Rig(template, 0.2)
    X_WE = RigidTransform(pose_at(0.05)[:3])
    tilted = template.project(2, X_WE, FRAMES)
    assert not template.can_enter(2, X_WE, FRAMES, PERIOD)
    assert [rig.step(0.05) for _ in range(3)] == [1, 1, 1]
    rig.pose.GetMutableData().set_value(transform_to_pose(tilted))
    rig.steps += 1
    rig.simulator.AdvanceTo((rig.steps + 0.5) * PERIOD)
    assert rig.state() == 2


def test_distance_and_progress_equal_those_of_the_template(template):
    rig = Rig(template, 0.4)
    rig.step(0.24)
    X_WE = RigidTransform(pose_at(0.24)[:3])
    assert rig.system.get_transition_distance_output_port().Eval(rig.context)[0] == pytest.approx(0.24)
    progress = rig.system.get_progress_output_port().Eval(rig.context)[0]
    assert progress == pytest.approx(template.progress(1, X_WE, FRAMES))
    # The progress increases by 5 per meter from a distance of 0.40 m and is continuous at the transition.
    assert progress == pytest.approx(5.0 * (0.40 - 0.24))


def test_state_machine_refuses_invalid_arguments(template):
    with pytest.raises(InputError, match="period"):
        SctStateMachine(template, FRAMES, 0.0)
    with pytest.raises(InputError, match="mug_tip"):
        SctStateMachine(template, {}, PERIOD)
