"""`guiderail serve-iiwa`: a simulated iiwa at the other end of LCM, in a process of its own."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from pydrake.lcm import DrakeLcm

from guiderail.diagrams.envs.config import EnvConfig
from guiderail.diagrams.envs.options import validate_options
from guiderail.diagrams.hardware.lcm.driver import open_bus
from guiderail.diagrams.hardware.clock import check_rate, set_realtime_priority
from guiderail.diagrams.hardware.lcm.simulated import serve_in_lockstep, serve_in_real_time
from guiderail.diagrams.hardware.monitor import SafetyMonitor
from guiderail.diagrams.hardware.driver import safety_limits
from guiderail.diagrams.hardware.lcm.driver import IiwaDriver
from guiderail.diagrams.hardware.lcm.simulated import SimulatedIiwa
from guiderail.diagrams.tasks.insertion import InsertionTask
from guiderail.models.common.errors import InputError
from guiderail.tools.hardware.part_randomization import put
from guiderail.tools.hardware.scenario import load_scenario

START = np.array([0.0, 0.0, 0.02, np.pi / 2, 0.0, 0.0])  # the plug above the jack
TASK = "BncConnector"
ASIDE = np.array([0.005, -0.005, 0.01, 0.0, 0.0, 0.0])  # of where another task starts: a robot is never just there
PLANT_SHARE = 5  # plant steps to a status in real time: the arm's own loop has 1 kHz


def serve_iiwa(
    url: str,
    seconds: float,
    command_timeout: float,
    task: str = TASK,
    *,
    rate: float | None = None,
    offset: Sequence[float] | None = None,
    scenario: Path | None = None,
    say: Callable[[str], None] = print,
) -> bool:
    """Serves the arm in front of a task's fixture; whether commands kept coming until the end.

    A deputy stands by. Unless a rate is given it waits for an answer to every status: so neither side outruns the other
    on a slow machine.

    Args:
        url: LCM's; its own default where it is empty.
        seconds: of simulated time.
        patience: how long to wait for a command [s].
        task: an insertion.
        rate: it goes by the wall's clock, as a robot does, or so much slower, and waits for nobody.
        offset: (x, y) of the fixture from where it is thought to be [m].
        scenario: a file that says what stands around it; see `load_scenario`.
        say: what a person is told.

    Raises:
        InputError: if the task or the bus is none, a time or the rate is no positive number, or the offset is too far.
    """
    for name, value in {"seconds": seconds, "patience": command_timeout}.items():
        if not 0.0 < value < np.inf:
            raise InputError(f"{name} must be a positive number, not {value:g}")
    if rate is not None:
        check_rate(rate)
    declared = EnvConfig.resolve(task, {}).make_task()
    if not isinstance(declared, InsertionTask):
        raise InputError(f"{task} is done by no arm with a tool: serve an insertion")
    if offset is not None and len(offset) != 2:
        raise InputError(f"a fixture's offset is x and y, not {len(offset)} numbers")
    moved = None if offset is None else validate_options(declared.Reset, {"offset": tuple(offset)}, "a robot")
    start = START if task == TASK else declared.start_pose(np.random.default_rng(0)) + ASIDE
    directives = [] if scenario is None else load_scenario(scenario).directives
    lcm, driver = open_bus(url), IiwaDriver
    # In real time, the deputy has ears of its own: beside a real driver it is another process.
    within, ears = (DrakeLcm("memq://"),) * 2 if rate is None else (lcm, open_bus(url))
    robot = SimulatedIiwa(
        declared.workcell(), within, driver.period / (1 if rate is None else PLANT_SHARE), directives=directives
    )
    simulator = robot.simulator()
    robot.set_pose(simulator.get_mutable_context(), start)
    SafetyMonitor(type(driver)(ears), robot.controller_plant.plant, safety_limits(robot.controller_plant.plant, driver))
    if moved is not None:
        fixture, workpiece = declared.offsets.draw(np.random.default_rng(0), moved)
        declared.set_part_offsets(robot, simulator.get_mutable_context(), fixture, workpiece)
    put(lcm if rate is None else ears, driver, declared, robot, simulator.get_mutable_context())
    simulator.Initialize()
    if rate is None:
        return serve(simulator, within, lcm, driver, seconds, command_timeout) >= seconds
    set_realtime_priority()

    def attend() -> None:
        ears.HandleSubscriptions(0)

    serve_in_real_time(simulator, driver, seconds, attend, rate, say)
    return True
