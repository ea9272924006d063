"""Physics of the plane station: position control and contact with walls."""

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ZeroOrderHold

from guiderail.diagrams.stations.plane import PlaneConfig, PlaneStation
from guiderail.models.objects.narrow_passage import PassageGeometry

WORLD, CONFIG = PassageGeometry(), PlaneConfig()


class CommandedStation:
    """Plane station that receives one desired position per control step."""

    def __init__(self, start):
        builder = DiagramBuilder()
        self.station = builder.AddNamedSystem("station", PlaneStation(WORLD, CONFIG))
        # Samples the position at the control instants, as any discrete system would.
        self.sample = builder.AddNamedSystem("sample", ZeroOrderHold(CONFIG.control_period, 2))
        builder.Connect(self.station.GetOutputPort("pose"), self.sample.get_input_port())
        builder.ExportInput(self.station.GetInputPort("desired_pose"), "desired_pose")
        self.simulator = Simulator(builder.Build())
        self.context = self.simulator.get_mutable_context()
        self.command = self.simulator.get_system().get_input_port().FixValue(self.context, start)
        self.station.set_pose(self.context, np.array(start))
        self.simulator.Initialize()
        self.steps = 0

    def move(self, desired, steps=1):
        """Command a position (2,) [m] for some control steps; return the positions (n, 2) after each plant step."""
        self.command.GetMutableData().set_value(desired)
        path = []
        for _ in range(steps):
            for i in range(1, CONFIG.substeps + 1):
                self.simulator.AdvanceTo((self.steps * CONFIG.substeps + i) * CONFIG.plant_period)
                path.append(self.read("pose"))
            self.steps += 1
        return np.array(path)

    def read(self, port):
        context = self.station.GetMyContextFromRoot(self.context)
        return self.station.GetOutputPort(port).Eval(context).copy()


def is_inside_wall(points, depth):
    """Return, for each point, whether it is deeper than `depth` [m] inside a wall."""
    lower, upper = WORLD.walls
    points = np.asarray(points)[:, None]
    return ((points > lower + depth) & (points < upper - depth)).all(axis=2).any(axis=1)


def test_robot_reaches_a_command_in_a_step_without_overshoot():
    robot = CommandedStation([0.3, 0.1])
    rng = np.random.default_rng(0)
    pose = np.array([0.3, 0.1])
    for _ in range(40):
        desired = np.clip(pose + rng.uniform(-0.1, 0.1, 2), [0.1, 0.0], [0.5, 0.4])
        path = robot.move(desired)
        assert np.abs(path[-1] - desired).max() < 1e-4
        low, high = np.minimum(pose, desired) - 1e-4, np.maximum(pose, desired) + 1e-4
        assert (path > low).all()
        assert (path < high).all()
        pose = path[-1]
    assert robot.read("contact_force") == 0


def test_robot_rests_at_the_pose_of_set_pose():
    robot = CommandedStation([0.3, 0.2])
    path = robot.move([0.3, 0.2], 5)
    np.testing.assert_array_equal(path, np.tile([0.3, 0.2], (len(path), 1)))


def test_wall_stops_the_robot_center_at_the_wall_surface():
    robot = CommandedStation([0.2, 0.4])
    path = robot.move([0.2, 0.9], 10)
    assert path[-1] == pytest.approx([0.2, WORLD.wall_y[0]], abs=2e-4)
    # The wall presses back with the largest force of the robot.
    np.testing.assert_allclose(robot.read("wrench"), [0, -CONFIG.max_force], atol=0.5)
    assert robot.read("saturation")[1] > 0
    robot = CommandedStation([0.35, 0.55])
    path = robot.move([0.2, 0.55], 5)
    assert path[-1] == pytest.approx([WORLD.gap_x[0], 0.55], abs=2e-4)


def test_robot_does_not_slide_when_pressed_against_a_wall():
    robot = CommandedStation([0.2, 0.45])
    contact = robot.move([0.2, 0.6], 3)[-1]
    pressed = robot.move([0.28, 0.6], 20)[-1]
    assert np.linalg.norm(pressed - contact) < 3e-3
    released = robot.move([0.25, 0.45], 3)[-1]
    assert released == pytest.approx([0.25, 0.45], abs=1e-4)


def test_robot_passes_the_gap():
    robot = CommandedStation([0.35, 0.4])
    assert robot.move([0.35, 0.8], 5)[-1] == pytest.approx([0.35, 0.8], abs=1e-4)
    assert robot.read("contact_force") == 0


def test_contact_force_covers_the_whole_control_step():
    robot = CommandedStation([0.2, 0.45])
    # The robot moves to the wall and back within one control step.
    robot.command.GetMutableData().set_value([0.2, 0.6])
    robot.simulator.AdvanceTo(5 * CONFIG.plant_period)
    assert robot.read("pose")[1] > 0.499
    robot.command.GetMutableData().set_value([0.2, 0.4])
    robot.simulator.AdvanceTo(10 * CONFIG.plant_period)
    assert robot.read("pose")[1] < 0.41
    assert robot.read("contact_force") > 0


@pytest.mark.parametrize("seed", range(3))
def test_robot_never_tunnels_for_random_commands(seed):
    rng = np.random.default_rng(seed)
    start = np.array([rng.uniform(-1, 2), 0.3])
    robot, path = CommandedStation(start), [start]
    for _ in range(120):
        desired = rng.uniform([-3, -3], [3, 3]) if rng.random() < 0.5 else [rng.uniform(-1, 2), rng.choice([-3.0, 3.0])]
        path.extend(robot.move(desired, int(rng.integers(1, 4))))
    path = np.array(path)
    # The robot penetrates a wall by at most one plant step, and crosses the wall's center line only in the gap.
    assert not is_inside_wall(path, depth=CONFIG.max_speed * CONFIG.plant_period + 1e-3).any()
    middle = sum(WORLD.wall_y) / 2
    crossing = np.flatnonzero((path[1:, 1] > middle) != (path[:-1, 1] > middle))
    crossing_x = path[crossing, 0]
    slack = CONFIG.max_speed * CONFIG.plant_period
    assert ((crossing_x > WORLD.gap_x[0] - slack) & (crossing_x < WORLD.gap_x[1] + slack)).all()


def test_sampled_pose_equals_the_pose_at_the_control_instant():
    """If the plant's output ports were sampled, the pose would be one plant step late (see `PlaneStation`)."""
    robot = CommandedStation([0.3, 0.1])
    for k in range(5):
        expected = robot.move([0.3 + 0.05 * (-1) ** k, 0.35], 1)[-1]
        robot.simulator.AdvanceTo((robot.steps * CONFIG.substeps + 0.5) * CONFIG.plant_period)
        np.testing.assert_array_equal(
            robot.sample.get_output_port().Eval(robot.sample.GetMyContextFromRoot(robot.context)), expected
        )
