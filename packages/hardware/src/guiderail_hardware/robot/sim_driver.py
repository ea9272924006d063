"""Programs on the robot's side of the bus: the simulated driver and the safety monitor."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.lcm import DrakeLcm, DrakeLcmInterface
from pydrake.systems.framework import Context

from guiderail.diagrams.envs.config import EnvConfig
from guiderail.diagrams.envs.options import validate_options
from guiderail.diagrams.stations.arm import ArmControllerPlant
from guiderail.diagrams.tasks.insertion import InsertionTask, part_poses
from guiderail.models.common.errors import InputError, brief
from guiderail.models.common.registry import did_you_mean
from guiderail.models.robots import DEFAULT_ROBOT
from guiderail.models.robots.robot import robot_names
from guiderail_hardware.drivers.clock import check_rate, set_realtime_priority
from guiderail_hardware.drivers.driver import DRIVERS, describe_stop, open_driver, safety_limits
from guiderail_hardware.drivers.lcm import IiwaDriver, LcmDriver, open_bus
from guiderail_hardware.drivers.lcm_simulated import SimulatedIiwa, serve_in_lockstep, serve_in_real_time
from guiderail_hardware.models.joint_status import Fault
from guiderail_hardware.monitor import MonitorState, SafetyMonitor
from guiderail_hardware.robot.connection import FCI, SIMULATED, check_simulation
from guiderail_hardware.robot.scenario import load_scenario

DEFAULT_TASK = "BncConnector"
# Initial pose of the default task, with the plug above the jack [m], [rad].
START = np.array([0.0, 0.0, 0.02, np.pi / 2, 0.0, 0.0])
REMOVED = (1.0, 0.0)  # offset (x, y) of a removed fixture, out of the arm's reach [m]
# Difference of the initial pose from the start pose, for tasks other than the default [m], [rad].
START_OFFSET = np.array([0.005, -0.005, 0.01, 0.0, 0.0, 0.0])
PLANT_STEPS_PER_STATUS = 5  # in real time: 1 kHz, as the control loop of a real arm; in lockstep there is 1 step
PART_OFFSETS_CHANNEL = "GUIDERAIL_PART_OFFSETS"


def run_sim_driver(
    url: str,
    seconds: float,
    command_timeout: float,
    task: str = DEFAULT_TASK,
    *,
    rate: float | None = None,
    offset: Sequence[float] | None = None,
    scenario: Path | None = None,
    driver: str = "",
    joint_friction: float | None = None,
    log: Callable[[str], None] = print,
) -> bool:
    """Simulate a robot and its driver in front of a task's fixture: by default an iiwa with a safety monitor on LCM.

    Args:
        url: LCM URL of the driver's bus, LCM's default if empty; with "fci" the address to listen on, 127.0.0.1 if
            empty.
        seconds: Simulated time to run [s].
        command_timeout: Longest time that the iiwa in lockstep waits for the acknowledgement of a status [s of wall
            clock time]; ten times as long for the first status.
        task: Name of an insertion task.
        rate: Rate of the robot's clock relative to the wall clock, in (0, 1]. With None, the iiwa waits for an
            acknowledgement of each status instead (lockstep), and the Franka has the rate 1.
        offset: Offset (x, y) of the fixture from its nominal position [m]; zero by default.
        scenario: Scenario file with the surroundings of the iiwa (see `load_scenario`); its `station` and address have
            no effect. Refused with "fci".
        driver: "fci" for a Franka arm on the Franka Control Interface, otherwise the iiwa. The Franka runs in lockstep
            while a `FciLockstepClock` is connected, otherwise by the wall clock.
        joint_friction: Friction of each joint of the Franka [Nm]; by default the residual of its friction compensation.
            Refused for the iiwa.
        log: Function that shows a message.

    Returns:
        False if the iiwa in lockstep stopped because acknowledgements stopped arriving; otherwise True.

    Raises:
        InputError: If the task is not an insertion task, there is no such simulated driver, an argument is out of
            range, or the scenario is invalid or refused.
    """
    for name, value in {"--seconds": seconds, "--command-timeout": command_timeout}.items():
        if not 0.0 < value < np.inf:
            raise InputError(f"{name} must be a positive number, not {value:g}")
    check_simulation(driver, scenario, joint_friction)
    if rate is not None:
        check_rate(rate)
    if driver and driver not in SIMULATED:
        raise InputError(f"there is no simulated driver {driver!r}: choose one of {', '.join(SIMULATED)}")
    if joint_friction is not None and driver != FCI:
        raise InputError(
            f"the simulated {DEFAULT_ROBOT} has no joint friction: leave joint_friction={joint_friction:g} out"
        )
    insertion = _insertion_task(task)
    if offset is not None and len(offset) != 2:
        raise InputError(f"a fixture's offset is x and y, not {len(offset)} numbers")
    reset = None if offset is None else validate_options(insertion.Reset, {"offset": tuple(offset)}, "a robot")
    start = START if task == DEFAULT_TASK else insertion.start_pose(np.random.default_rng(0)) + START_OFFSET
    if driver == FCI:
        try:
            from guiderail_hardware.drivers import fci_simulated
        except ModuleNotFoundError as error:
            name = (error.name or "").partition(".")[0]
            raise InputError(
                f'the simulated Franka needs {name}: pip install "guiderail[fci,mujoco]" franky-sim'
            ) from error

        parts = (
            (np.zeros(2), np.zeros(2)) if reset is None else insertion.offsets.draw(np.random.default_rng(0), reset, {})
        )
        friction = fci_simulated.RESIDUAL_FRICTION if joint_friction is None else joint_friction
        robot = fci_simulated.WorkcellSimulator(insertion.workcell(), friction)
        fci_simulated.serve(robot, start, part_poses(*parts), seconds, rate or 1.0, url or "127.0.0.1", log)
        return True
    surroundings = None if scenario is None else load_scenario(scenario)
    if surroundings is not None and surroundings.robot != DEFAULT_ROBOT:
        raise InputError(
            f"{scenario} has the robot {brief(surroundings.robot)}: name a scenario of the simulated {DEFAULT_ROBOT}"
        )
    lcm = open_bus(url)
    # In real time, the monitor has its own bus connection, as on a real robot, where it is another process.
    robot_lcm, monitor_lcm = (DrakeLcm("memq://"),) * 2 if rate is None else (lcm, open_bus(url))
    robot = SimulatedIiwa(
        insertion.workcell(),
        robot_lcm,
        IiwaDriver.period / (1 if rate is None else PLANT_STEPS_PER_STATUS),
        directives=() if surroundings is None else surroundings.directives,
    )
    simulator = robot.simulator()
    robot.set_pose(simulator.get_mutable_context(), start)
    plant = robot.controller_plant.plant
    # The monitor uses the simulated time, because a simulated robot may be slower than the wall clock.
    monitor = SafetyMonitor(
        IiwaDriver(monitor_lcm), plant, safety_limits(plant, IiwaDriver), clock=simulator.get_context().get_time
    )
    if reset is not None:
        fixture, workpiece = insertion.offsets.draw(np.random.default_rng(0), reset, {})
        insertion.set_part_offsets(robot, simulator.get_mutable_context(), fixture, workpiece)
    subscribe_part_offsets(lcm if rate is None else monitor_lcm, insertion, robot, simulator.get_mutable_context())
    simulator.Initialize()
    if rate is None:
        return serve_in_lockstep(simulator, robot_lcm, lcm, seconds, command_timeout, monitor.check) >= seconds
    set_realtime_priority()
    serve_in_real_time(simulator, seconds, monitor.receive, rate, log)
    return True


def run_safety_monitor(
    url: str, robot: str, task: str, *, rate: float = 1.0, log: Callable[[str], None] = print
) -> None:
    """Damp a robot to rest when torque commands stop or its status is wrong, until this process is terminated.

    Args:
        url: Address of the robot's driver; LCM's default if empty.
        robot: Name of the robot arm.
        task: Name of the insertion task whose workpiece the arm carries.
        rate: Rate of the robot's clock relative to this machine's, in (0, 1]; 1 for a real robot.
        log: Function that shows a message.

    Raises:
        InputError: If there is no such robot, driver or insertion task, the address is unusable, the driver cannot read
            the commands of other programs, or `rate` is out of range.
    """
    check_rate(rate)
    if robot not in (known := [name for name in robot_names() if name in DRIVERS.names()]):
        raise InputError(f"a safety monitor watches no robot {brief(robot)}: {did_you_mean(robot, known)}")
    plant = ArmControllerPlant(_insertion_task(task).workcell(), robot).plant
    driver = open_driver(robot, url)
    monitor = SafetyMonitor(driver, plant, safety_limits(plant, driver), clock=lambda: rate * time.monotonic())
    suffix = "" if set_realtime_priority() else "; without real-time priority"
    log(f"watching {driver}{suffix}")
    state, failure = monitor.state, ""
    while True:
        monitor.receive(driver.period / rate)
        if driver.guard.command_error != failure:
            failure = driver.guard.command_error
            log(f"{Fault.COMMAND_FAILED.description}: {failure}")
        if monitor.state != state:
            state = monitor.state
            has_cause = state == MonitorState.DAMPING and monitor.fault
            log(state.name.lower() + (f": {describe_stop(monitor.fault, driver)}" if has_cause else ""))


def _insertion_task(name: str) -> InsertionTask:
    task = EnvConfig.resolve(name, {}).declared
    if not isinstance(task, InsertionTask):
        raise InputError(f"{name} is not a task of an arm with a tool: name an insertion")
    return task


class PartRandomizer:
    """Sampler of the offsets of a task's parts, which sends them to the simulated driver."""

    def __init__(self, task: InsertionTask, move_parts: Callable[[list[list[float]]], object], seed: int):
        """Sample the hidden offset of the run; it is the same as in simulation with this seed.

        Args:
            task: Task whose parts are moved.
            move_parts: Function that sends the offsets of fixture and workpiece, as `publish_part_offsets` does.
            seed: Seed of the run.
        """
        self._task, self._move_parts = task, move_parts
        self._run: dict[str, Any] = {}
        reset = validate_options(task.Reset, {}, "a simulated driver")
        task.offsets.draw(np.random.default_rng(seed), reset, self._run)

    def __call__(self, rng: np.random.Generator, options: Mapping[str, Any]) -> dict[str, np.ndarray]:
        """Sample the offsets of the parts with the options of a simulated reset, send them, and return them by name.

        An offset is (x, y) [m]; some tasks append angles [rad].

        Raises:
            InputError: If the task has no such option, or a value is out of range.
        """
        reset = validate_options(self._task.Reset, options, "a simulated driver")
        fixture, workpiece = self._task.offsets.draw(rng, reset, self._run)
        self._move_parts([fixture.tolist(), workpiece.tolist()])
        return {f"{self._task.fixture}_offset": fixture.copy(), "grasp_offset": workpiece.copy()}

    def remove_fixture(self) -> None:
        """Move the fixture away from a held workpiece, as an operator would; the next sampled offset moves it back."""
        self._move_parts([list(REMOVED), [0.0, 0.0]])


def publish_part_offsets(driver: LcmDriver, offsets: list[list[float]]) -> None:
    """Send the offsets of fixture and workpiece, (x, y) [m] each, to a simulated robot (`subscribe_part_offsets`)."""
    driver.lcm.Publish(PART_OFFSETS_CHANNEL, json.dumps(offsets).encode())


def subscribe_part_offsets(lcm: DrakeLcmInterface, task: InsertionTask, robot: SimulatedIiwa, context: Context) -> None:
    """Apply the offsets that a `PartRandomizer` sends to a simulated robot; `context` is the root context."""

    def apply(message: bytes) -> None:
        fixture, workpiece = json.loads(message)
        task.set_part_offsets(robot, context, np.array(fixture), np.array(workpiece))

    lcm.Subscribe(PART_OFFSETS_CHANNEL, apply)
