"""Commands of robots: deploy, train-on-robot, teleoperate, sim-driver and safety-monitor."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from guiderail.models.common.errors import InputError
from guiderail.tools.cli import app as cli
from guiderail.tools.cli.app import argument, import_option, option, print_message, print_progress, print_result

if TYPE_CHECKING:
    from guiderail_hardware.robot.connection import RobotConnection

Driver = Annotated[str | None, option("Driver fci (Franka) or rtde (UR).  [default: the robot's LCM driver]")]


@dataclass(frozen=True)
class RobotOptions:
    """Options about the robot of deploy and train-on-robot."""

    station: Annotated[str, option("Hardware station.", choices="stations")] = "hardware"
    robot_url: Annotated[
        str | None, option("LCM URL of the driver's bus, or the robot's host.  [default: LCM's default]")
    ] = None
    robot: Annotated[
        str | None, option("Robot arm.  [default: the scenario's, the driver's, or iiwa14]", choices="robots")
    ] = None
    driver: Driver = None
    sim: Annotated[bool, option("Use a simulated driver in a subprocess instead of a robot.", "--sim")] = False
    synchronous: Annotated[
        bool,
        option(
            "With --sim: driver and controller wait for each other; wall-clock time does not count.", "--synchronous"
        ),
    ] = False
    rate: Annotated[
        float | None,
        option(
            "With --sim, without --synchronous: speed of the simulated robot's clock relative to real time, from 0.001 "
            "to 1.  [default: 0.2]"
        ),
    ] = None
    scenario: Annotated[Path | None, option("Scenario file with the robot, its bus and its surroundings.")] = None
    yes: Annotated[bool, option("Answer all pre-flight questions with yes.", "--yes")] = False

    def environment(self) -> dict[str, Any]:
        """Return the options of the environment that are given."""
        return cli.parse_environment(None, robot_url=self.robot_url, robot=self.robot, driver=self.driver)

    def connect(self, environment: Mapping[str, Any]) -> RobotConnection:
        """Return the connection to the robot of `environment`; see `RobotConnection.from_scenario` for errors."""
        from guiderail_hardware.robot.connection import RobotConnection

        given = {name: environment[name] for name in ("robot_url", "robot", "driver") if name in environment}
        given |= {"sim": self.sim, "synchronous": self.synchronous}
        given |= {} if self.rate is None else {"rate": self.rate}
        return RobotConnection.from_scenario(self.scenario, **given)


@cli.command("deploy runs/connector --sim --yes")
def deploy(
    run: Annotated[Path, argument("Folder of a run or of a policy, or pretrained:NAME ({pretrained}).", "RUN")],
    robot: RobotOptions,
    task: cli.PolicyTask = None,
    force_limit: Annotated[
        float | None, option("Force limit of a first motion [N].  [default and maximum: that of the training]")
    ] = None,
    episodes: Annotated[
        int | None,
        option("Number of episodes of an evaluation, one row each.  [default: one execution]"),
    ] = None,
    policy: Annotated[
        str | None, option("With --episodes: policy to evaluate instead of the run's: scripted, {baselines}.")
    ] = None,
    out: Annotated[
        Path | None, option("Folder of the recording.  [default: RUN/hardware; NAME/hardware for pretrained:NAME]")
    ] = None,
    imports: Annotated[list[str] | None, import_option("a robot or a driver")] = None,
    trust_imports: cli.TrustImports = False,
    as_json: cli.Json = False,
) -> None:
    """Execute a policy on a robot, once or, with --episodes, as an evaluation.

    The assumptions about the robot are printed and have to be confirmed. Then the controller holds the arm at its
    present pose, moves it slowly to the start and executes the skill; every control step is recorded. The exit code is
    0 if the skill was executed to its end, and 1 if a limit, a fault or a key stopped it. An evaluation pauses between
    its episodes; a stopped episode counts as a failure.
    """
    cli.import_files(imports)
    connection = robot.connect(robot.environment())
    where: dict[str, Any] = {"task": task, "station": robot.station, "assume_yes": robot.yes, "out": out}
    if episodes is not None:
        if force_limit is not None:
            raise InputError("an evaluation has the force limit of the training: leave --force-limit out")
        from guiderail_hardware.robot.robot_evaluation import evaluate_on_robot

        result = evaluate_on_robot(run, connection, episodes, policy=policy, log=print_message, **where)
        print_result(result, as_json)
        return
    if policy is not None or as_json:
        raise InputError("--policy and --json belong to an evaluation: give --episodes too")
    from guiderail_hardware.robot.executor import deploy as deploy_policy

    code = deploy_policy(run, connection, force_limit=force_limit, log=print_progress, **where)
    raise typer.Exit(code)


@cli.command("train-on-robot BncConnector --sim --yes --episodes 20 --out runs/robot", "train-on-robot")
def train_on_robot(
    run: cli.RunOptions,
    robot: RobotOptions,
    task: Annotated[str | None, argument("Task to learn: {tasks}.", "TASK", "tasks")] = None,
    guidance: cli.Guidance = None,
    env: cli.Env = None,
) -> None:
    """Train a policy on a robot and write a run folder.

    Every episode ends with a checkpoint, and an interrupted run is resumed with --resume; a run with a simulated
    driver needs --sim again.
    """
    from guiderail.tools.imports import import_modules

    name, folders = (None, ()) if task is None else cli.find_task(task, run.imports)
    modules = import_modules((*folders, *(run.imports or ())))
    out = run.folder
    environment = cli.parse_environment(env, guidance=guidance, station=robot.station, **robot.environment())
    if run.resume:
        environment = _with_stored_robot(out, environment)
    choices = run.choices()
    if choices["settings"].get("num_envs", "0") != "0":
        raise InputError("there is one robot: leave num_envs out")
    from guiderail_hardware.robot.robot_training import train_on_robot as train

    result = train(
        name,
        out,
        robot.connect(environment),
        environment=environment,
        given={**choices, "imports": modules},
        resume=run.resume,
        assume_yes=robot.yes,
        log=print_message,
    )
    print_result(result, run.as_json)


def _with_stored_robot(out: Path, environment: dict[str, Any]) -> dict[str, Any]:
    """Return the given options, completed by the station, the robot and the driver of a run on hardware."""
    from guiderail.tools.learning.run_folder import RunFolder

    stored = RunFolder(out).config().environment
    names = ("station", "robot", "driver")
    return {name: stored[name] for name in names if stored.get(name) is not None} | environment


@cli.command("teleoperate ./peg --record demonstrations.npz")
def teleoperate(
    task: Annotated[str, argument("Folder of a task, or one of {tasks}.", "TASK", "tasks")],
    record: Annotated[
        Path | None, option("Demonstrate in the browser and write the demonstrations to this new file, .npz or .csv.")
    ] = None,
    guidance: cli.Guidance = None,
    env: cli.Env = None,
    imports: cli.TaskImports = None,
    as_json: cli.Json = False,
) -> None:
    """Act in place of the policy, or demonstrate a task.

    Without --record, a gamepad, sliders or keys give the action of the task's guidance. With --record, they move the
    desired pose, the robot follows under impedance control, and the page in the browser shows the force. Each
    demonstration is kept or discarded; a kept demonstration is written at once.
    """
    name = cli.find_task(task, imports)[0]
    environment = cli.parse_environment(env, guidance=guidance)
    if record is None:
        if as_json:
            raise InputError("--json prints a summary of the demonstrations: give --record too")
    elif guidance is not None:
        raise InputError("a demonstration is recorded without guidance: leave --guidance out")
    from guiderail_hardware.teleop import recorder

    if record is None:
        recorder.teleoperate(name, environment, print_progress)
    else:
        print_result(recorder.record_demonstrations(name, environment, record, print_progress), as_json)


@cli.command("sim-driver --seconds 60", "sim-driver")
def sim_driver(
    url: Annotated[
        str, option("LCM URL of the driver's bus; with --driver fci an address.  [default: LCM's default; 127.0.0.1]")
    ] = "",
    driver: Driver = None,
    seconds: Annotated[float, option("Duration in simulated time [s].")] = 3600.0,
    command_timeout: Annotated[float, option("Without --rate: longest wait for a command [s].")] = 5.0,
    task: Annotated[
        str, option("Task with the fixture in front of the robot: {tasks}.", choices="tasks")
    ] = "BncConnector",
    rate: Annotated[
        float | None, option("Follow the wall clock at this rate, at most 1, without waiting for commands.")
    ] = None,
    offset: Annotated[str | None, option("x,y offset of the fixture [m], such as 0.001,-0.0005.")] = None,
    scenario: Annotated[Path | None, option("Scenario file with the robot's surroundings.")] = None,
    imports: cli.Imports = None,
) -> None:
    """Simulate a robot and its driver: an iiwa on LCM with a safety monitor, or with --driver fci a Franka.

    The robot stands in front of a task's fixture. Without --rate, the exit code is 1 if commands stopped arriving.
    """
    from guiderail_hardware.robot.sim_driver import run_sim_driver

    name = cli.find_task(task, imports)[0]
    xy = None if offset is None else tuple(cli.parse_floats(offset, 2, "--offset"))
    completed = run_sim_driver(
        url,
        seconds,
        command_timeout,
        name,
        rate=rate,
        offset=xy,
        scenario=scenario,
        driver=driver or "",
        log=print_progress,
    )
    raise typer.Exit(0 if completed else 1)


@cli.command("safety-monitor --task BncConnector", "safety-monitor")
def safety_monitor(
    url: Annotated[str, option("LCM URL of the driver's bus.  [default: LCM's default]")] = "",
    robot: Annotated[str, option("Robot arm.", choices="robots")] = "iiwa14",
    task: Annotated[
        str, option("Task with the workpiece that the arm carries: {tasks}.", choices="tasks")
    ] = "BncConnector",
    rate: Annotated[float, option("Rate of a simulated robot's clock relative to this machine's.")] = 1.0,
    imports: cli.Imports = None,
) -> None:
    """Bring a robot to rest when torque commands stop arriving, or its status is wrong.

    Some drivers repeat the last torque after the program that sent it has ended. For such a driver, guiderail deploy
    moves the robot only if this monitor runs. The monitor runs on the driver's machine until it is terminated.
    """
    from guiderail_hardware.robot.sim_driver import run_safety_monitor

    run_safety_monitor(url, robot, cli.find_task(task, imports)[0], rate=rate, log=print_progress)
