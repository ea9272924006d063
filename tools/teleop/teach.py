"""`guiderail teach`: a person moves the compliant target of a running simulation, and keeps what is good.

The page's sliders are where the command shall be, and each has two keys; a gamepad pushes them. The command follows at
a hand's speed, the robot by its impedance: pushing means to command beyond what stops it.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.geometry import Box, Cylinder, MeshcatCone, Rgba
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, DiagramBuilder

from guiderail.diagrams.envs.cameras import add_meshcat
from guiderail.diagrams.envs.config import EnvConfig
from guiderail.diagrams.envs.make import make_station
from guiderail.diagrams.envs.scene import Viewpoint
from guiderail.diagrams.stations.station import POSE_SIZE
from guiderail.diagrams.tasks.insertion import InsertionTask
from guiderail.models.common.errors import InputError
from guiderail.models.common.units import DEGREE, MM
from guiderail.models.objects.bnc_connector.demonstrations import NAMES
from guiderail.models.primitives import Demonstrations
from guiderail.models.primitives.bounds import compute_bounds
from guiderail.tools.datasets.paths import check_new

PATH = "/guiderail/force"
ASIDE, UPWARDS, LENGTH, THICKNESS = 0.3, 0.05, 0.3, 0.012  # of the way from the camera to what it looks at
WARNING = 0.7  # of the limit, from which on it is red
CALM, RED, TROUGH = (0.1, 0.5, 0.9, 1.0), (0.9, 0.15, 0.1, 1.0), (0.35, 0.35, 0.35, 0.25)
LEAST = 1e-3  # of full length: what has no length at all has no direction either


class ForceGauge:
    """Solid objects, as browsers draw lines a pixel wide; beside the part, or they would be inside of it."""

    def __init__(self, meshcat: Any, view: Viewpoint, limit: float):
        """
        Args:
            meshcat: the page.
            view: of its camera; the gauge is as large as suits the distance of what it looks at.
            limit: force of a full bar, and of an arrow of full length [N].
        """
        self._meshcat, self._limit = meshcat, limit
        eye, target = (np.array(point) for point in view)
        way = target - eye
        size = float(np.linalg.norm(way))
        right = np.cross(way, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        self._length, thickness = LENGTH * size, THICKNESS * size
        low = target - [0.0, 0.0, UPWARDS * size]
        self._tail, self._foot = low + ASIDE * size * right, low - ASIDE * size * right
        self._head = 4.0 * thickness
        meshcat.SetObject(f"{PATH}/shaft", Cylinder(thickness, 1.0), Rgba(*CALM))
        meshcat.SetObject(f"{PATH}/head", MeshcatCone(self._head, 2.5 * thickness, 2.5 * thickness), Rgba(*CALM))
        meshcat.SetObject(f"{PATH}/bar", Box(3.0 * thickness, 3.0 * thickness, 1.0), Rgba(*CALM))
        meshcat.SetObject(f"{PATH}/trough", Box(3.5 * thickness, 3.5 * thickness, self._length), Rgba(*TROUGH))
        meshcat.SetTransform(f"{PATH}/trough", _pose(np.eye(3), self._foot + [0.0, 0.0, 0.5 * self._length]))
        self.show(np.zeros(3))

    def show(self, force: np.ndarray) -> None:
        """Draws a force (3,) in the world [N]; what is beyond the limit is as long as the limit."""
        size = float(np.linalg.norm(force))
        share = float(np.clip(size / self._limit, LEAST, 1.0))
        R = RotationMatrix.MakeFromOneVector(force if size > 0.0 else [0.0, 0.0, 1.0], 2).matrix()
        along = R[:, 2] * share * self._length
        self._meshcat.SetTransform(f"{PATH}/shaft", _pose(R, self._tail + 0.5 * along, share * self._length))
        # A cone's point is its origin, and it opens along z: turned about, and as far ahead as it is high.
        tip = self._tail + along + R[:, 2] * self._head
        self._meshcat.SetTransform(f"{PATH}/head", _pose(R @ np.diag([1.0, -1.0, -1.0]), tip))
        height = share * self._length
        self._meshcat.SetTransform(f"{PATH}/bar", _pose(np.eye(3), self._foot + [0.0, 0.0, 0.5 * height], height))
        for part in ("shaft", "head", "bar"):
            colour = RED if size > WARNING * self._limit else CALM
            self._meshcat.SetProperty(f"{PATH}/{part}/<object>", "color", list(colour))


def _pose(R: np.ndarray, p: np.ndarray, length: float = 1.0) -> np.ndarray:
    """A pose (4, 4) of what is a metre long in z and becomes `length` [m]."""
    X = np.eye(4)
    X[:3, :3] = R @ np.diag([1.0, 1.0, length])
    X[:3, 3] = p
    return X


# Of each output: how far from its start the slider goes, its step, and the keys that lower and raise it.
SLIDERS = {
    "x [mm]": (20.0, 0.5, "KeyA", "KeyD", MM),
    "y [mm]": (20.0, 0.5, "KeyS", "KeyW", MM),
    "z [mm]": (40.0, 0.5, "KeyF", "KeyR", MM),
    "turn [degrees]": (180.0, 2.0, "KeyQ", "KeyE", DEGREE),
    "pitch [degrees]": (10.0, 0.5, "KeyK", "KeyI", DEGREE),
    "roll [degrees]": (10.0, 0.5, "KeyJ", "KeyL", DEGREE),
}
KEEP, DISCARD, UNDO, SLOW, END = (
    "keep (Enter)",
    "discard (Backspace)",
    "undo 1 s (U)",
    "slow motion (M)",
    "end (Escape)",
)
BUTTONS = {KEEP: "Enter", DISCARD: "Backspace", UNDO: "KeyU", SLOW: "KeyM", END: "Escape"}
AXES = ((0, 1.0), (1, -1.0), (3, -1.0), (2, 1.0))  # of a gamepad, for x, y, z and the turn
GAMEPAD_SPEED = np.array([10.0, 10.0, 10.0, 30.0])  # slider units a second at full deflection
DEAD_ZONE = 0.15
SPEED = np.array([20 * MM, 20 * MM, 20 * MM, 60 * DEGREE, 20 * DEGREE, 20 * DEGREE])  # of the command, a second
SLOWLY = 0.25  # times real time
SNAPSHOT = 1.0  # [s] that one undo takes back
UNDONE = 60  # that can be taken back, one after another: each is as large as all of the simulation's state
FORCE_EVERY = 5  # control steps: a page that is sent more than it draws falls behind
LEAST_SAMPLES = 10
REST = 0.1  # [s] for which the command may stay where it is in a demonstration
NEAREST = 1.0 * MM  # that a page's camera sees


@dataclass(frozen=True)
class _Snapshot:
    """Where an undo leads back to: what was so before a control step, and how much was demonstrated by then."""

    context: Context
    steps: int
    command: np.ndarray
    wanted: np.ndarray
    samples: int
    resting: int


@dataclass
class _Taken:
    """What is being demonstrated, without its rests: a person looks, and thinks.

    Attributes:
        commands: of the control steps that were no rest.
        resting: control steps for which the command stays where it is by now.
        snapshots: what an undo can take back; the oldest are forgotten.
    """

    commands: list[np.ndarray] = field(default_factory=list)
    resting: int = 0
    snapshots: deque[_Snapshot] = field(default_factory=lambda: deque(maxlen=UNDONE))

    def add(self, command: np.ndarray, period: float) -> None:
        """A control step's command; a rest is cut to `REST`."""
        stays = bool(self.commands) and np.array_equal(command, self.commands[-1])
        self.resting = self.resting + 1 if stays else 0
        if self.resting * period <= REST:
            self.commands.append(command.copy())


class Teaching:
    """One session: a station under a person's hands, and the demonstrations that were kept.

    Attributes:
        kept: demonstrations so far, times and commanded poses.
        succeeded: whether each ended at the target, where the task knows.
    """

    def __init__(self, task: str, environment: Mapping[str, Any], out: Path, meshcat: Any = None):
        """
        Args:
            task: its name, or a task folder.
            environment: its options.
            out: the demonstrations' file, .npz or .csv; it must not exist.
            meshcat: the page; a new one on this machine unless given.

        Raises:
            InputError: for a task whose station has no pose of six, a file that exists, or one that can't be written.
        """
        check_new(out, "file")
        if out.suffix not in (".npz", ".csv"):
            raise InputError(f"{out} must end in .npz or .csv")
        declared = EnvConfig.resolve(task, environment).make_task()
        if declared.workcell_kind != "workcell":
            raise InputError(f"{task} has no tool that a hand could lead: teach one that puts a part into another")
        self.task, self.out = declared, out
        builder = DiagramBuilder()
        self.station = builder.AddNamedSystem("station", make_station(declared))
        builder.ExportInput(self.station.get_desired_pose_input_port(), "desired_pose")
        self.meshcat = add_meshcat(builder, self.station.GetOutputPort("query")) if meshcat is None else meshcat
        self.simulator = Simulator(builder.Build())
        self.kept: list[tuple[np.ndarray, np.ndarray]] = []
        self.succeeded: list[bool | None] = []
        self._period = self.station.control_period
        self._pristine = self.simulator.get_context().Clone()
        self._clicks: dict[str, int] = {}
        self._slow = False
        view = look_at(self.meshcat, self.task)
        self.gauge = None if view is None else ForceGauge(self.meshcat, view, self.task.collision.above)
        for name, (reach, step, lower, higher, _) in SLIDERS.items():
            self.meshcat.AddSlider(name, -reach, reach, step, 0.0, lower, higher)
        for name, key in BUTTONS.items():
            self.meshcat.AddButton(name, key)

    def begin(self) -> None:
        """Puts robot and parts to where an episode begins, the sliders to zero."""
        context = self.simulator.get_mutable_context()
        context.SetTimeStateAndParametersFrom(self._pristine)
        self.start = np.asarray(self._start_pose())
        self.station.set_pose(context, self.start)
        self.command, self.wanted = self.start.copy(), np.zeros(POSE_SIZE)
        self._port().FixValue(context, self.command)
        self.simulator.Initialize()
        self.steps, self.taken = 0, _Taken()
        for name in SLIDERS:
            self.meshcat.SetSliderValue(name, 0.0)

    def run(self, say: Callable[[str], None], real_time: bool = True, most_steps: int = 10**9) -> None:
        """Follows the page until its end button; what is kept is written at once.

        Args:
            say: is told what happens.
            real_time: whether the simulation waits for the clock.
            most_steps: control steps after which it ends anyway.
        """
        self.begin()
        for _ in range(most_steps):
            self._go_at((SLOWLY if self._slow else 1.0) if real_time else 0.0)
            self.step()
            for name in BUTTONS:
                while self._clicked(name):
                    if name == END:
                        return
                    self._press(name, say)

    def step(self) -> None:
        """One control step: the command moves towards the sliders, and is recorded unless it rests."""
        before, wanted = self.command, self.wanted
        self._push_sliders()
        scales = np.array([scale for *_, scale in SLIDERS.values()])
        self.wanted = scales * [self.meshcat.GetSliderValue(name) for name in SLIDERS]
        goal = self.start + self.wanted
        self.command = self.command + np.clip(goal - self.command, -SPEED * self._period, SPEED * self._period)
        context = self.simulator.get_mutable_context()
        if not np.array_equal(self.command, before) and self._since_snapshot() >= round(SNAPSHOT / self._period):
            samples, resting = len(self.taken.commands), self.taken.resting
            self.taken.snapshots.append(_Snapshot(context.Clone(), self.steps, before, wanted, samples, resting))
        self._port().FixValue(context, self.command)
        self.taken.add(self.command, self._period)
        self.steps += 1
        self.simulator.AdvanceTo(self.steps * self._period)
        if self.gauge is not None and self.steps % FORCE_EVERY == 0:
            self.gauge.show(self._force())

    def undo(self) -> None:
        """Takes the last second in which the command moved back: robot, parts, command and sliders, while there is one.

        Rests before it stay, and so does what is longer ago than `UNDONE` of them.
        """
        snapshots = self.taken.snapshots
        if not snapshots:
            return
        if len(snapshots) > 1 and self._since_snapshot() < round(0.5 * SNAPSHOT / self._period):
            snapshots.pop()
        last = snapshots.pop()
        self.steps, self.command, self.wanted = last.steps, last.command, last.wanted
        self.simulator.get_mutable_context().SetTimeStateAndParametersFrom(last.context)
        self.simulator.Initialize()
        del self.taken.commands[last.samples :]
        self.taken.resting = last.resting
        for (name, (*_, scale)), value in zip(SLIDERS.items(), self.wanted, strict=True):
            self.meshcat.SetSliderValue(name, float(value / scale))

    def keep(self) -> str:
        """Keeps what was shown, writes all that was kept, and says how it ended.

        Raises:
            InputError: if nothing was shown yet, or nothing can be written any more; then it is not kept yet.
        """
        if self.steps < LEAST_SAMPLES:
            raise InputError("nothing was shown yet: move the sliders or press the keys first")
        success = self.is_success()
        commands = np.array(self.taken.commands)
        kept = [*self.kept, (self._period * np.arange(len(commands)), commands)]
        _together(kept).save(self.out)
        self.kept = kept
        self.succeeded.append(success)
        ended = {None: "", True: ", at the target", False: ", NOT at the target"}[success]
        shown = (self.steps - 1) * self._period
        lasts = f"{shown:.1f} s, {self.kept[-1][0][-1]:.1f} s of them without rests"
        return f"kept demonstration {len(self.kept)}: {lasts}{ended}; {self.out}"

    def demonstrations(self) -> Demonstrations:
        """All that were kept."""
        return _together(self.kept)

    def is_success(self) -> bool | None:
        """Whether the workpiece is where the task wants it; None where the task doesn't say it by its pose."""
        task = self.task
        if not isinstance(task, InsertionTask):
            return None
        success = next((one for one in task.termination_terms() if one.termination == "success"), None)
        if success is None or list(success.inputs) != [task.workpiece]:
            return None
        plant = self.station.plant
        context = plant.GetMyContextFromRoot(self.simulator.get_context())
        X = plant.GetFrameByName(task.workpiece).CalcPose(context, plant.GetFrameByName(task.fixture))
        turn = X.rotation().ToAngleAxis()
        return bool(success.condition(np.concatenate([X.translation(), turn.angle() * turn.axis()])))

    def learned(self) -> dict[str, Any]:
        """What was shown: its mean, drawn with its spread, its bounds, and whether the mean alone succeeds."""
        demonstrations = self.demonstrations()
        steps = round(float(np.mean([t[-1] for t, _ in self.kept])) / self._period) + 1
        common = demonstrations.resampled(steps)
        outputs = np.stack(common.outputs)
        mean, spread = outputs.mean(axis=0), outputs.std(axis=0)
        self._draw_tube(mean, spread)
        self.begin()
        context = self.simulator.get_mutable_context()
        self.simulator.set_target_realtime_rate(0.0)
        self.station.set_pose(context, mean[0])
        for n, pose in enumerate(mean):
            self._port().FixValue(context, pose)
            self.simulator.AdvanceTo((n + 1) * self._period)
        bounds = compute_bounds(demonstrations)
        return {
            "demonstrations": len(self.kept),
            "at the target": sum(one is True for one in self.succeeded),
            "seconds": round(steps * self._period, 2),
            "widest spread": spread.max(axis=0).round(5).tolist(),
            "lowest": bounds.lower[0].round(5).tolist(),
            "highest": bounds.upper[0].round(5).tolist(),
            "the mean alone succeeds": self.is_success(),
        }

    def _go_at(self, rate: float) -> None:
        """Paces the simulation at a rate to the wall's clock, from now on."""
        if rate != self.simulator.get_target_realtime_rate():
            self.simulator.set_target_realtime_rate(rate)
            # Drake compares all the time since then: it would set_realtime_priority, or wait, until the new rate held for all of it.
            self.simulator.ResetStatistics()

    def _press(self, name: str, say: Callable[[str], None]) -> None:
        if name == KEEP:
            try:
                say(self.keep())
            except InputError as error:
                say(str(error))
                return
            self.begin()
        elif name == DISCARD:
            say("discarded")
            self.begin()
        elif name == UNDO:
            self.undo()
        elif name == SLOW:
            self._slow = not self._slow

    def _clicked(self, name: str) -> bool:
        """Whether there is a click that was not answered yet."""
        clicks = self.meshcat.GetButtonClicks(name)
        done = self._clicks.get(name, 0)
        self._clicks[name] = min(done + 1, clicks)
        return clicks > done

    def _since_snapshot(self) -> float:
        """Control steps since what an undo leads back to; endless where nothing can be undone."""
        return self.steps - self.taken.snapshots[-1].steps if self.taken.snapshots else np.inf

    def _push_sliders(self) -> None:
        gamepad = self.meshcat.GetGamepad()
        if gamepad.index is None:
            return
        for (axis, sign), speed, (name, (reach, *_)) in zip(AXES, GAMEPAD_SPEED, SLIDERS.items(), strict=False):
            stick = gamepad.axes[axis] if axis < len(gamepad.axes) else 0.0
            if abs(stick) > DEAD_ZONE:
                value = self.meshcat.GetSliderValue(name) + sign * stick * speed * self._period
                self.meshcat.SetSliderValue(name, float(np.clip(value, -reach, reach)))

    def _force(self) -> np.ndarray:
        """What the part feels, (3,) in the world [N]."""
        context = self.station.GetMyContextFromRoot(self.simulator.get_context())
        force = self.station.get_wrench_output_port().Eval(context)[:3]
        return np.asarray(self.task.workcell().X_WT.rotation().multiply(force))

    def _draw_tube(self, mean: np.ndarray, spread: np.ndarray) -> None:
        X_WT: RigidTransform = self.task.workcell().X_WT
        for number, factor in enumerate((0.0, 2.0, -2.0)):
            points = X_WT.multiply((mean[:, :3] + factor * spread[:, :3]).T)
            colour = Rgba(0.1, 0.3, 0.8, 1.0 if number == 0 else 0.4)
            self.meshcat.SetLine(f"/guiderail/learned/{number}", points, 3.0 if number == 0 else 1.0, colour)

    def _start_pose(self) -> np.ndarray:
        return (
            self.task.start_pose(np.random.default_rng(0))
            if isinstance(self.task, InsertionTask)
            else np.zeros(POSE_SIZE)
        )

    def _port(self) -> Any:
        return self.simulator.get_system().GetInputPort("desired_pose")


def _together(kept: list[tuple[np.ndarray, np.ndarray]]) -> Demonstrations:
    return Demonstrations([t for t, _ in kept], [y for _, y in kept], NAMES)


def look_at(meshcat: Any, task: Any) -> Viewpoint | None:
    """Opens a page with the view of a task's scene, near enough to see parts of a centimetre; returns it."""
    view = task.scene().viewpoint
    if view is not None:
        meshcat.SetProperty("/Cameras/default/rotated/<object>", "near", NEAREST)
        meshcat.SetCameraPose(*(np.array(point) for point in view))
    return view


def teach(
    task: str,
    environment: Mapping[str, Any],
    out: Path,
    say: Callable[[str], None],
    *,
    wait: bool = True,
) -> dict[str, Any]:
    """Opens the page, waits until a browser is connected, and records until the person ends it.

    Args:
        task, environment, out: see `Teaching`.
        say: is told what to do and what happens.
        wait: whether it waits for a browser.

    Raises:
        InputError: as `Teaching`, or if nothing was kept.
    """
    session = Teaching(task, environment, out)
    url = session.meshcat.web_url()
    say(f"Teach at {url} (from elsewhere: ssh -L {session.meshcat.port()}:localhost:{session.meshcat.port()}).")
    keys = ", ".join(f"{low[-1]} and {high[-1]} {name.split()[0]}" for name, (_, _, low, high, _) in SLIDERS.items())
    say(f"Keys: {keys}; Enter keeps, Backspace discards, U undoes, M is slow motion, Escape ends.")
    limit = session.task.collision.above
    say(f"Sliders and buttons: Open Controls, upper right. The arrow is the force; at {limit:g} N the bar is full.")
    while wait and session.meshcat.GetNumActiveConnections() == 0:
        time.sleep(0.1)
    try:
        session.run(say)
    except KeyboardInterrupt:
        say("ended")
    if not session.kept:
        raise InputError("nothing was kept: press Enter at the end of each demonstration")
    return {"out": str(out), **session.learned()}
