"""`guiderail deploy`, `guiderail teleoperate`, `guiderail sim-driver` and `guiderail safety-monitor`."""

from pathlib import Path
from typing import Annotated

import typer

from guiderail.models.common.errors import InputError
from guiderail.tools.cli import app as cli
from guiderail.tools.cli.app import argument, option, print_progress, print_result


@cli.command("deploy runs/connector --sim --yes")
def deploy(
    run: Annotated[Path, argument("Folder of a run, or pretrained:NAME ({pretrained}).", "RUN")],
    station: Annotated[str, option("Hardware station.", choices="stations")] = "hardware",
    robot_url: cli.RobotUrl = None,
    robot: cli.Robot = None,
    driver: cli.Driver = None,
    sim: cli.Sim = False,
    synchronous: cli.Synchronous = False,
    rate: cli.Rate = None,
    scenario: cli.Scenario = None,
    force_limit: Annotated[
        float | None, option("Force limit of a first motion [N].  [default and maximum: that of the training]")
    ] = None,
    yes: cli.Yes = False,
    out: Annotated[
        Path | None, option("Folder of the recording.  [default: RUN/hardware; NAME/hardware for pretrained:NAME]")
    ] = None,
    imports: cli.HardwareImports = None,
    trust_imports: cli.TrustImports = False,
) -> None:
    """Execute a policy on a robot.

    The assumptions about the robot are printed and have to be confirmed. Then the controller holds the arm at its
    present pose, moves it slowly to the start and executes the skill; every control step is recorded. The exit code is
    0 if the skill was executed to its end, and 1 if a limit, a fault or a key stopped it.
    """
    from guiderail.tools.hardware.executor import deploy as deploy_policy

    cli.import_files(imports)
    environment = cli.parse_environment(None, robot_url=robot_url, robot=robot, driver=driver)
    connection = cli.connect(environment, scenario, sim=sim, synchronous=synchronous, rate=rate)
    code = deploy_policy(
        run, connection, station=station, force_limit=force_limit, assume_yes=yes, out=out, log=print_progress
    )
    raise typer.Exit(code)


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
    from guiderail.tools.teleop import recorder

    if record is None:
        recorder.teleoperate(name, environment, print_progress)
    else:
        print_result(recorder.record_demonstrations(name, environment, record, print_progress), as_json)


@cli.command("sim-driver --seconds 60", "sim-driver")
def sim_driver(
    url: Annotated[
        str, option("LCM URL of the driver's bus; with --driver fci an address.  [default: LCM's default; 127.0.0.1]")
    ] = "",
    driver: cli.Driver = None,
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
    from guiderail.tools.hardware.sim_driver import run_sim_driver

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
    from guiderail.tools.hardware.sim_driver import run_safety_monitor

    run_safety_monitor(url, robot, cli.find_task(task, imports)[0], rate=rate, log=print_progress)
