"""First commands of sKGRL at random starts over all orientations, compared with the demonstrated speed.

`python tests/oracles/random_starts.py 10000` prints the largest jump as a share of the demonstrated motion in a period,
and the number of refused motions.
"""

import sys
import warnings
from itertools import pairwise

import numpy as np
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource
from scipy.spatial.transform import Rotation

from guiderail.models.common.errors import InputError
from guiderail.models.common.transforms import angle_between
from guiderail.models.primitives import LcNsKmp, ReferenceTrajectory
from guiderail.models.primitives.poses import pose_outputs
from guiderail.systems import HistoryBuffer, LcNsKmpSystem

PERIOD, STEPS, HISTORY, COMMANDS = 0.02, 30, 5, 8
POSITION_STD, ANGLE_STD = 0.002, 0.01  # spread of the demonstrations [m], [rad]


def jumps(seed):
    """Return the jumps of the first commands of one start, as shares of the demonstrated motion in a period.

    The demonstrated motion turns by 0.6 to 1.2 rad about a random axis, in a random frame, from rest to rest; its speed
    is the largest one. The first command is compared with the measured start, which is on the motion but for up to a
    tenth of the demonstrations' spread. The measured angles are within ±π, as those of every station that measures
    rotations.

    Raises:
        InputError: If Euler angles are singular in the motion.
    """
    rng = np.random.default_rng(seed)
    s = np.linspace(0.0, 1.0, STEPS)
    s = s**3 * (10.0 - 15.0 * s + 6.0 * s**2)  # from rest to rest with the least jerk
    axis = rng.standard_normal(3)
    axis *= rng.uniform(0.6, 1.2) / np.linalg.norm(axis)
    rotations = Rotation.random(rng=rng) * Rotation.from_rotvec(s[:, None] * axis)
    positions = s[:, None] * rng.uniform(-0.2, 0.2, 3)
    quaternions = rotations.as_quat(scalar_first=True)
    means = pose_outputs(positions, quaternions, np.zeros(3), [1.0, 0.0, 0.0, 0.0])
    variances = np.repeat([POSITION_STD, ANGLE_STD], 3) ** 2
    reference = ReferenceTrajectory(PERIOD * np.arange(STEPS), means, np.tile(np.diag(variances), (STEPS, 1, 1)))
    offset = 0.1 * rng.uniform(-1.0, 1.0, 6) * np.repeat([POSITION_STD, ANGLE_STD], 3)
    start = np.r_[positions[0] + offset[:3], (rotations[0] * Rotation.from_rotvec(offset[3:])).as_euler("ZYX")]

    builder = DiagramBuilder()
    kmp = builder.AddSystem(LcNsKmpSystem(LcNsKmp(reference, history=HISTORY, horizon=5), None, PERIOD))
    history = builder.AddSystem(HistoryBuffer(6, HISTORY, PERIOD, reference.means[0]))
    action, pose = (builder.AddSystem(ConstantVectorSource(value)) for value in (np.zeros(6), start))
    builder.Connect(action.get_output_port(), kmp.get_null_space_action_input_port())
    builder.Connect(pose.get_output_port(), history.get_initial_output_input_port())
    builder.Connect(kmp.get_command_output_port(), history.get_output_input_port())
    builder.Connect(history.get_history_output_port(), kmp.get_history_input_port())
    simulator = Simulator(builder.Build())
    context = kmp.GetMyContextFromRoot(simulator.get_context())
    commands = [start]
    for step in range(COMMANDS):
        simulator.AdvanceTo((step + 0.5) * PERIOD)
        commands.append(kmp.get_command_output_port().Eval(context).copy())
    angle = np.linalg.norm(axis) * np.diff(s).max()
    distance = np.linalg.norm(np.diff(positions, axis=0), axis=1).max()
    return [
        max(angle_between(second, first) / angle, np.linalg.norm((second - first)[:3]) / distance)
        for first, second in pairwise(commands)
    ]


def largest_jump(seeds):
    """Return the largest jump of starts with these seeds, its seed, and the number of refused motions."""
    largest, worst, refused = 0.0, None, 0
    for seed in seeds:
        try:
            jump = max(jumps(seed))
        except InputError:
            refused += 1
            continue
        if jump > largest:
            largest, worst = jump, seed
    return largest, worst, refused


if __name__ == "__main__":
    warnings.simplefilter("ignore")  # near a singular orientation the primitive deviates from Euler angles
    print(*largest_jump(range(int(sys.argv[1]))))
