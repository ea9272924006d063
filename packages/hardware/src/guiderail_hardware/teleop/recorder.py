"""Recording of demonstrations: an operator moves the commanded pose of a simulated robot.

The operator moves the sliders of a page by mouse, keys or gamepad. The command follows the sliders at limited speed,
and the robot follows the command under impedance control. To push, the operator commands a pose beyond contact.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from pydrake.geometry import Box, Cylinder, MeshcatCone, Rgba
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.analysis import InitializeParams, Simulator
from pydrake.systems.framework import Context, DiagramBuilder

from guiderail.diagrams.envs.config import EnvConfig
from guiderail.diagrams.envs.make import make_station
from guiderail.diagrams.envs.scene import Viewpoint, add_meshcat
from guiderail.diagrams.tasks.insertion import InsertionTask
from guiderail.diagrams.tasks.task import Condition, signals_of
from guiderail.models.common.errors import InputError
from guiderail.models.common.termination import Termination
from guiderail.models.common.transforms import DEGREE, MM, POSE_NAMES, POSE_SIZE
from guiderail.models.primitives import Demonstrations
from guiderail.models.primitives.demonstrations import compute_bounds
from guiderail.systems.support.drake_multibody import transform_to_vector
from guiderail.tools.environments import make_environment, task_of
from guiderail.tools.evaluation.episode import EnvCallback, PolicyFn, Transition
from guiderail.tools.evaluation.rollout import rollout
from guiderail.tools.files import check_new
from guiderail_hardware.robot.records import check_room, write_record
from guiderail_hardware.systems.meshcat_device import MeshcatDevice
from guiderail_hardware.teleop.teleoperator import (
    GAMEPAD_AXES,
    KEY_PAIRS,
    MeshcatPanel,
    Slider,
    page_address,
    set_camera,
)

PATH = "/guiderail/force"
# Position (sideways, down), length and thickness of the gauge, relative to the distance of camera and target.
SIDE_OFFSET, DOWN_OFFSET, LENGTH, THICKNESS = 0.3, 0.05, 0.3, 0.012
WARNING_SHARE = 0.7  # fraction of the limit above which the gauge is red
BLUE, RED, GRAY = (0.1, 0.5, 0.9, 1.0), (0.9, 0.15, 0.1, 1.0), (0.35, 0.35, 0.35, 0.25)
MIN_FORCE = 1e-6  # smallest force for which a direction is shown [N]
MIN_LENGTH = 1e-3  # smallest fraction of the full length, because an arrow of length zero has no direction


class ForceGauge:
    """Arrow and bar that show a force next to the part.

    They are solid objects, because browsers draw lines one pixel wide.
    """

    def __init__(self, meshcat: Any, view: Viewpoint, limit: float):
        """Add the gauge to a page.

        The viewpoint of the camera determines size and position. At the force `limit` [N], arrow and bar have full
        length.
        """
        self._meshcat, self._limit = meshcat, limit
        eye, target = (np.array(point) for point in view)
        direction = target - eye
        distance = float(np.linalg.norm(direction))
        right = np.cross(direction, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        self._length, thickness = LENGTH * distance, THICKNESS * distance
        low = target - [0.0, 0.0, DOWN_OFFSET * distance]
        self._tail, self._foot = low + SIDE_OFFSET * distance * right, low - SIDE_OFFSET * distance * right
        self._head = 4.0 * thickness
        meshcat.SetObject(f"{PATH}/shaft", Cylinder(thickness, 1.0), Rgba(*BLUE))
        meshcat.SetObject(f"{PATH}/head", MeshcatCone(self._head, 2.5 * thickness, 2.5 * thickness), Rgba(*BLUE))
        meshcat.SetObject(f"{PATH}/bar", Box(3.0 * thickness, 3.0 * thickness, 1.0), Rgba(*BLUE))
        meshcat.SetObject(f"{PATH}/trough", Box(3.5 * thickness, 3.5 * thickness, self._length), Rgba(*GRAY))
        meshcat.SetTransform(f"{PATH}/trough", _scaled_pose(np.eye(3), self._foot + [0.0, 0.0, 0.5 * self._length]))
        self.show(np.zeros(3))

    def show(self, force: np.ndarray) -> None:
        """Show a force (3,) in the world [N]; above the limit, arrow and bar have full length."""
        size = float(np.linalg.norm(force))
        share = float(np.clip(size / self._limit, MIN_LENGTH, 1.0))
        R = RotationMatrix.MakeFromOneVector(force if size > MIN_FORCE else [0.0, 0.0, 1.0], 2).matrix()
        arrow = R[:, 2] * share * self._length
        self._meshcat.SetTransform(f"{PATH}/shaft", _scaled_pose(R, self._tail + 0.5 * arrow, share * self._length))
        # Meshcat's cone has its origin at its tip and opens along z. It is turned over and moved by its height.
        tip = self._tail + arrow + R[:, 2] * self._head
        self._meshcat.SetTransform(f"{PATH}/head", _scaled_pose(R @ np.diag([1.0, -1.0, -1.0]), tip))
        height = share * self._length
        self._meshcat.SetTransform(
            f"{PATH}/bar", _scaled_pose(np.eye(3), self._foot + [0.0, 0.0, 0.5 * height], height)
        )
        color = RED if size > WARNING_SHARE * self._limit else BLUE
        for part in ("shaft", "head", "bar"):
            self._meshcat.SetProperty(f"{PATH}/{part}/<object>", "color", list(color))


def _scaled_pose(R: np.ndarray, p: np.ndarray, length: float = 1.0) -> np.ndarray:
    """Return the transform (4, 4) that scales an object of length 1 m in z to `length` [m] and moves it to a pose."""
    X = np.eye(4)
    X[:3, :3] = R @ np.diag([1.0, 1.0, length])
    X[:3, 3] = p
    return X


SLIDERS = {
    "x [mm]": Slider(20.0, 0.5, ("KeyA", "KeyD"), MM, 10.0),
    "y [mm]": Slider(20.0, 0.5, ("KeyS", "KeyW"), MM, 10.0),
    "z [mm]": Slider(40.0, 0.5, ("KeyF", "KeyR"), MM, 10.0),
    "turn [degrees]": Slider(180.0, 2.0, ("KeyQ", "KeyE"), DEGREE, 30.0),
    "pitch [degrees]": Slider(10.0, 0.5, ("KeyK", "KeyI"), DEGREE),
    "roll [degrees]": Slider(10.0, 0.5, ("KeyJ", "KeyL"), DEGREE),
}
KEEP, DISCARD, UNDO = "keep (Enter)", "discard (Backspace)", "undo 1 s (U)"
SLOW, END = "slow motion (M)", "end (Escape)"
BUTTONS = {KEEP: "Enter", DISCARD: "Backspace", UNDO: "KeyU", SLOW: "KeyM", END: "Escape"}
# Largest speed of the command [m/s], [rad/s].
MAX_SPEED = np.array([20 * MM, 20 * MM, 20 * MM, 60 * DEGREE, 20 * DEGREE, 20 * DEGREE])
SLOW_RATE = 0.25  # rate of slow motion relative to real time
UNDO_TIME = 1.0  # duration of the motion that one undo removes [s]
MAX_UNDOS = 60  # largest number of consecutive undos; each one needs a copy of the simulation's state
FORCE_STEPS = 5  # control steps between updates of the gauge: more frequent updates would delay the page
MIN_ROOM = 1_000_000  # required disk space for the demonstrations [bytes], enough for two minutes in a .csv file
MIN_STEPS = 10  # smallest number of control steps of a demonstration
MAX_REST = 0.1  # longest rest of the command in a demonstration [s]


@dataclass(frozen=True)
class _Snapshot:
    """State before a control step, which an undo restores."""

    context: Context  # copy of the root context
    steps: int  # number of simulated control steps
    command: np.ndarray  # commanded pose, (6,)
    offset: np.ndarray  # offset of the sliders, (6,)
    samples: int  # number of recorded commands
    resting: int  # number of control steps for which the command has not changed


@dataclass
class _Recording:
    """Demonstration that is being recorded; rests of the command are shortened to `MAX_REST`."""

    commands: list[np.ndarray] = field(default_factory=list)  # commanded poses of the recorded control steps
    resting: int = 0  # control steps for which the command has not changed
    # States that undos restore; above `MAX_UNDOS`, the oldest are dropped.
    snapshots: deque[_Snapshot] = field(default_factory=lambda: deque(maxlen=MAX_UNDOS))

    def add(self, command: np.ndarray, period: float) -> None:
        """Record the command of a control step, unless a rest exceeds `MAX_REST`."""
        is_resting = bool(self.commands) and np.array_equal(command, self.commands[-1])
        self.resting = self.resting + 1 if is_resting else 0
        if self.resting * period <= MAX_REST:
            self.commands.append(command.copy())


class DemonstrationRecorder:
    """Session in which an operator moves a station and records demonstrations.

    Attributes:
        out: File of the demonstrations.
        demonstrations: Times (N,) [s] and commanded poses (N, 6) [m, rad] of each kept demonstration.
        successes: Success of each demonstration; None if the task does not define it by the pose.
        start: Pose at the start of a demonstration, (6,) [m, rad].
        command: Commanded pose, (6,) [m, rad].
        offset: Offset from the start pose to the pose that the sliders set, (6,) [m, rad].
        steps: Control steps since the start of the demonstration.
    """

    def __init__(self, task: str, environment: Mapping[str, Any], out: Path, meshcat: Any = None):
        """Build the simulation and show it on a new page of this machine.

        Args:
            task: Name of the task, or path of a task folder.
            environment: Options of the environment by name.
            out: File of the demonstrations, .npz or .csv; it must not exist.
            meshcat: Page for the controls, instead of a new page. This page does not show the simulation.

        Raises:
            InputError: If the task is no insertion, the station is hardware, or the file exists, has another ending or
                cannot be written, or there is no room for it.
        """
        check_new(out, "file")
        if out.suffix not in (".npz", ".csv"):
            raise InputError(f"{out} must end in .npz or .csv")
        check_room(out, MIN_ROOM)
        config = EnvConfig.resolve(task, environment)
        self.task, self.out, kind = config.declared, out, config.station_kind
        if kind.workcell_kind != "insertion":
            raise InputError(f"{task} has no tool that an operator can move: demonstrate a task that inserts a part")
        if not kind.is_simulated:
            raise InputError(f"demonstrations are recorded in simulation: leave station={kind.name} out")
        builder = DiagramBuilder()
        self.station = builder.AddNamedSystem("station", make_station(config))
        builder.ExportInput(self.station.get_desired_pose_input_port(), "desired_pose")
        meshcat = add_meshcat(builder, self.station.GetOutputPort("query")) if meshcat is None else meshcat
        self.simulator = Simulator(builder.Build())
        self.demonstrations: list[tuple[np.ndarray, np.ndarray]] = []
        self.successes: list[bool | None] = []
        self._period = self.station.control_period
        self._pristine = self.simulator.get_context().Clone()
        self._is_slow = False
        self._written: tuple[int, int] | None = None  # version of the file that this session has written
        view = set_camera(meshcat, self.task)
        self._gauge = None if view is None else ForceGauge(meshcat, view, self.task.collision.above)
        self.panel = MeshcatPanel(meshcat, SLIDERS, BUTTONS)

    def reset(self) -> None:
        """Start a demonstration: reset robot and parts, and set the sliders to zero."""
        context = self.simulator.get_mutable_context()
        context.SetTimeStateAndParametersFrom(self._pristine)
        self.start = np.zeros(POSE_SIZE)
        if isinstance(self.task, InsertionTask):
            self.start = np.asarray(self.task.start_pose(np.random.default_rng(0)))
        self.station.set_pose(context, self.start)
        self.command, self.offset = self.start.copy(), np.zeros(POSE_SIZE)
        self._fix_command()
        self.simulator.Initialize()
        self.steps, self.recording = 0, _Recording()
        self.panel.reset()

    def run(self, log: Callable[[str], None], real_time: bool = True, max_steps: int = 10**9) -> None:
        """Run the simulation until the page's end button is pressed; write each demonstration when it is kept.

        Args:
            log: Function called with a sentence on each kept, refused or discarded demonstration.
            real_time: Run in real time, or in slow motion; otherwise as fast as possible.
            max_steps: Largest number of control steps.
        """
        self.reset()
        for _ in range(max_steps):
            self._set_rate((SLOW_RATE if self._is_slow else 1.0) if real_time else 0.0)
            self.step()
            for button in BUTTONS:
                for _ in range(self.panel.take_clicks(button)):
                    if button == END:
                        return
                    self._press(button, log)

    def step(self) -> None:
        """Advance by a control step: move the command towards the sliders, and record it."""
        command, offset = self.command, self.offset
        self.panel.apply_gamepad(self._period)
        self.offset = self.panel.read()
        max_change = MAX_SPEED * self._period
        self.command = command + np.clip(self.start + self.offset - command, -max_change, max_change)
        has_moved = not np.array_equal(self.command, command)
        if has_moved and self._steps_since_snapshot() >= round(UNDO_TIME / self._period):
            context = self.simulator.get_context().Clone()
            samples, resting = len(self.recording.commands), self.recording.resting
            self.recording.snapshots.append(_Snapshot(context, self.steps, command, offset, samples, resting))
        self._fix_command()
        self.recording.add(self.command, self._period)
        self.steps += 1
        self.simulator.AdvanceTo(self.steps * self._period)
        if self._gauge is not None and self.steps % FORCE_STEPS == 0:
            self._gauge.show(self._force())

    def undo(self) -> None:
        """Undo about the last second of motion: restore robot, parts, command and sliders.

        A pause before this motion stays in the recording. At most `MAX_UNDOS` states are stored, at least one second
        apart.
        """
        snapshots = self.recording.snapshots
        if not snapshots:
            return
        if len(snapshots) > 1 and self._steps_since_snapshot() < round(0.5 * UNDO_TIME / self._period):
            snapshots.pop()
        snapshot = snapshots.pop()
        self.steps, self.command, self.offset = snapshot.steps, snapshot.command, snapshot.offset
        self.simulator.get_mutable_context().SetTimeStateAndParametersFrom(snapshot.context)
        # Initialization events would reset the tare, the energy tank and the filters.
        self.simulator.Initialize(InitializeParams(suppress_initialization_events=True))
        del self.recording.commands[snapshot.samples :]
        self.recording.resting = snapshot.resting
        self.panel.set(self.offset)

    def keep(self) -> str:
        """Keep the demonstration, and write all demonstrations.

        A file that this session has not written is not replaced: the demonstrations are written to a new file next to
        it, which becomes `out`.

        Returns:
            A sentence on the demonstration.

        Raises:
            InputError: If the demonstration is too short, has no motion, or cannot be written to the file, a temporary
                folder or the home folder. The demonstration is then not kept.
        """
        commands = np.array(self.recording.commands)
        if self.steps < MIN_STEPS or not np.ptp(commands, axis=0).any():
            raise InputError("nothing was shown yet: move the sliders or press the keys first")
        is_success = self.is_success()
        demonstrations = [*self.demonstrations, (self._period * np.arange(len(commands)), commands)]
        out = self._unused_path()
        note = "" if out == self.out else f", because another program has written {self.out}"
        self.out, failure = write_record(out, _to_demonstrations(demonstrations).save)
        self._written, self.demonstrations = _file_version(self.out), demonstrations
        self.successes.append(is_success)
        end = {None: "", True: ", at the target", False: ", NOT at the target"}[is_success]
        duration = (self.steps - 1) * self._period
        lasts = f"{duration:.1f} s, {self.demonstrations[-1][0][-1]:.1f} s after rests were shortened"
        return f"kept demonstration {len(self.demonstrations)}: {lasts}{end}; {failure or f'{self.out}{note}'}"

    def is_success(self) -> bool | None:
        """Return True if the workpiece is at its target; None if the task does not define success by its pose."""
        task = self.task
        if not isinstance(task, InsertionTask):
            return None
        success = task.done().get(Termination.SUCCESS)
        is_success = success.holds if isinstance(success, Condition) else success
        if is_success is None or signals_of(is_success, "success") != (task.workpiece,):
            return None
        # Read from the station's output port: if another engine simulates, the plant's context lacks the poses.
        context = self.station.GetMyContextFromRoot(self.simulator.get_context())
        poses = self.station.GetOutputPort("body_poses").Eval(context)
        bodies = (self.station.plant.GetBodyByName(name) for name in (task.fixture, task.workpiece))
        X_WFixture, X_WWorkpiece = (poses[body.index()] for body in bodies)
        return bool(is_success(transform_to_vector(X_WFixture.InvertAndCompose(X_WWorkpiece))))

    def summarize(self) -> dict[str, Any]:
        """Replay the mean of the demonstrations, draw it with its spread, and return statistics."""
        demonstrations = _to_demonstrations(self.demonstrations)
        steps = round(float(np.mean([times[-1] for times, _ in self.demonstrations])) / self._period) + 1
        outputs = np.stack(demonstrations.resampled(steps).outputs)
        mean, spread = outputs.mean(axis=0), outputs.std(axis=0)
        self._draw_tube(mean, spread)
        self.reset()
        context = self.simulator.get_mutable_context()
        self.simulator.set_target_realtime_rate(0.0)
        self.station.set_pose(context, mean[0])
        for n, pose in enumerate(mean):
            self.command = pose
            self._fix_command()
            self.simulator.AdvanceTo((n + 1) * self._period)
        bounds = compute_bounds(demonstrations)
        return {
            "demonstrations": len(self.demonstrations),
            "at the target": sum(is_success is True for is_success in self.successes),
            "seconds": round(steps * self._period, 2),
            "widest spread": spread.max(axis=0).round(5).tolist(),
            "lowest": bounds.lower[0].round(5).tolist(),
            "highest": bounds.upper[0].round(5).tolist(),
            "the mean alone succeeds": self.is_success(),
        }

    def _unused_path(self) -> Path:
        """Return `out`, or a new path next to it if another program wrote the file `out`."""
        path, number = self.out, 1
        while (version := _file_version(path)) is not None and (path != self.out or version != self._written):
            number += 1
            path = self.out.with_stem(f"{self.out.stem}_{number}")
        return path

    def _fix_command(self) -> None:
        port = self.simulator.get_system().GetInputPort("desired_pose")
        port.FixValue(self.simulator.get_mutable_context(), self.command)

    def _set_rate(self, rate: float) -> None:
        """Set the target rate relative to real time."""
        if rate != self.simulator.get_target_realtime_rate():
            self.simulator.set_target_realtime_rate(rate)
            # Otherwise Drake would run faster or wait until the average rate since the start equals the new rate.
            self.simulator.ResetStatistics()

    def _press(self, button: str, log: Callable[[str], None]) -> None:
        if button == KEEP:
            try:
                log(self.keep())
            except InputError as error:
                log(str(error))
                return
            self.reset()
        elif button == DISCARD:
            log("discarded")
            self.reset()
        elif button == UNDO:
            self.undo()
        elif button == SLOW:
            self._is_slow = not self._is_slow

    def _steps_since_snapshot(self) -> float:
        """Return the control steps since the last snapshot; infinity without a snapshot."""
        snapshots = self.recording.snapshots
        return self.steps - snapshots[-1].steps if snapshots else np.inf

    def _force(self) -> np.ndarray:
        """Return the force on the part, (3,) in the world [N]."""
        context = self.station.GetMyContextFromRoot(self.simulator.get_context())
        force = self.station.get_wrench_output_port().Eval(context)[:3]
        return np.asarray(self.task.workcell().X_WT.rotation().multiply(force))

    def _draw_tube(self, mean: np.ndarray, spread: np.ndarray) -> None:
        X_WT: RigidTransform = self.task.workcell().X_WT
        for number, factor in enumerate((0.0, 2.0, -2.0)):
            points = X_WT.multiply((mean[:, :3] + factor * spread[:, :3]).T)
            color = Rgba(0.1, 0.3, 0.8, 1.0 if number == 0 else 0.4)
            self.panel.meshcat.SetLine(f"/guiderail/learned/{number}", points, 3.0 if number == 0 else 1.0, color)


def _file_version(path: Path) -> tuple[int, int] | None:
    """Return the modification time [ns] and the size of a file [bytes]; None if there is no file."""
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_mtime_ns, status.st_size


def _to_demonstrations(recorded: list[tuple[np.ndarray, np.ndarray]]) -> Demonstrations:
    return Demonstrations([times for times, _ in recorded], [outputs for _, outputs in recorded], POSE_NAMES)


def record_demonstrations(
    task: str, environment: Mapping[str, Any], out: Path, log: Callable[[str], None]
) -> dict[str, Any]:
    """Open the page, wait for a browser, and record demonstrations until the operator ends the session.

    Returns:
        The file, and statistics of the demonstrations.

    Raises:
        InputError: As `DemonstrationRecorder`, or if no demonstration was kept.
    """
    recorder = DemonstrationRecorder(task, environment, out)
    meshcat, limit = recorder.panel.meshcat, recorder.task.collision.above
    log(f"Demonstrate at {page_address(meshcat)}.")
    keys = ", ".join(
        f"{slider.keys[0][-1]} and {slider.keys[1][-1]} {name.split()[0]}" for name, slider in SLIDERS.items()
    )
    log(f"Keys: {keys}; Enter keeps, Backspace discards, U undoes, M is slow motion, Escape ends.")
    log(f"Sliders and buttons: Open Controls, upper right. The arrow is the force; at {limit:g} N the bar is full.")
    while meshcat.GetNumActiveConnections() == 0:
        time.sleep(0.1)
    try:
        recorder.run(log)
    except KeyboardInterrupt:
        log("ended")
    if not recorder.demonstrations:
        raise InputError("nothing was kept: press Enter at the end of each demonstration")
    return {"out": str(recorder.out), **recorder.summarize()}


class LiveView(EnvCallback):
    """Callback that renders every transition."""

    def on_step(self, transition: Transition) -> None:
        """Render the transition."""
        self.env.render()


def teleoperate(task: str, environment: Mapping[str, Any], log: Callable[[str], None]) -> None:
    """Let the operator act in place of the policy until Ctrl-C, by the action of the task's guidance.

    Raises:
        InputError: If an action has more numbers than the device has inputs.
    """
    env = make_environment(task, environment, render_mode="human")
    own, size = task_of(env, task), int(env.action_space.shape[0])  # type: ignore[index]
    if size > len(GAMEPAD_AXES):
        raise InputError(
            f"an action of {task} has {size} numbers, a device only {len(GAMEPAD_AXES)}: choose another --guidance"
        )
    device = MeshcatDevice(own.meshcat, GAMEPAD_AXES[:size], KEY_PAIRS[:size], own.control_period)
    log(f"Teleoperate at {page_address(own.meshcat)} with a gamepad, the sliders, or the keys:")
    log(", ".join(f"{lower[-1]} and {higher[-1]}" for lower, higher in KEY_PAIRS[:size]) + ". Ctrl-C ends.")
    while True:
        log(run_episode(env, lambda observation: device.read()))


def run_episode(env: gymnasium.Env, act: PolicyFn, index: int = 0) -> str:
    """Run and render an episode of a policy or an operator; return its termination."""
    return rollout(env, act, LiveView(env), index=index)["termination"]
