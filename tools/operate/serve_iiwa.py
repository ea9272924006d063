"""`guiderail serve-iiwa`: a simulated iiwa at the other end of LCM, in a process of its own."""

import numpy as np
from pydrake.lcm import DrakeLcm
from pydrake.systems.analysis import Simulator

from guiderail.diagrams.make import resolve
from guiderail.diagrams.stations.hardware import SimulatedIiwa, serve
from guiderail.diagrams.tasks.insertion import InsertionTask
from guiderail.models.errors import InputError

START = np.array([0.0, 0.0, 0.02, np.pi / 2, 0.0, 0.0])  # the plug above the jack
TASK = "BncConnector"
ASIDE = np.array([0.005, -0.005, 0.01, 0.0, 0.0, 0.0])  # of where another task starts: a robot is never just there


def serve_iiwa(url: str, seconds: float, patience: float, task: str = TASK, *, real_time: bool = False) -> bool:
    """Serves the arm in front of a task's fixture; whether commands kept coming until the end.

    Unless in real time, it waits for an answer to every status: so neither side outruns the other on a slow machine.

    Args:
        url: LCM's; its own default where it is empty.
        seconds: of simulated time.
        patience: how long to wait for a command [s].
        task: an insertion.
        real_time: it goes by the wall's clock, as a robot does, and waits for nobody.

    Raises:
        InputError: if the task is none.
    """
    declared = resolve(task, {}).task
    if not isinstance(declared, InsertionTask):
        raise InputError(f"{task} is done by no arm with a tool: serve an insertion")
    start = START if task == TASK else declared.start(np.random.default_rng(0)) + ASIDE
    lcm = DrakeLcm(url)
    robot = SimulatedIiwa(declared.world(), lcm)
    if real_time:
        simulator = Simulator(robot)
        robot.set_pose(simulator.get_mutable_context(), start)
        simulator.set_target_realtime_rate(1.0)
        simulator.AdvanceTo(seconds)
        return True
    return serve(robot, lcm, start, seconds, patience) >= seconds
