"""`guiderail teach`: a person moves the compliant target of a running simulation, and keeps what is good.

The page's sliders are where the command shall be, and each has two keys; a gamepad pushes them. The command follows at
a hand's speed, the robot by its impedance: pushing means to command beyond what stops it.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.geometry import Rgba
from pydrake.math import RigidTransform
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, DiagramBuilder

from guiderail.diagrams.cameras import add_meshcat
from guiderail.diagrams.make import make_station, resolve
from guiderail.diagrams.scene import Viewpoint
from guiderail.diagrams.stations.station import POSE_SIZE
from guiderail.diagrams.tasks.insertion import InsertionTask
from guiderail.models.demonstrations.bnc_connector import NAMES
from guiderail.models.errors import InputError
from guiderail.models.primitives import Demonstrations
from guiderail.models.primitives.demonstrated_bounds import demonstrated_bounds
from guiderail.models.units import DEGREE, MM
from guiderail.tools.operate.force_gauge import ForceGauge

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
FORCE_EVERY = 5  # control steps: a page that is sent more than it draws falls behind
LEAST_SAMPLES = 10
REST = 0.1  # [s] for which the command may stay where it is in a demonstration
NEAREST = 1.0 * MM  # that a page's camera sees


@dataclass
class _Taken:
    """What is being demonstrated."""

    times: list[float] = field(default_factory=list)
    commands: list[np.ndarray] = field(default_factory=list)
    snapshots: list[tuple[Context, int, np.ndarray, np.ndarray]] = field(default_factory=list)


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
            InputError: for a task whose station has no pose of six, or a file that exists.
        """
        if out.exists() or out.suffix not in (".npz", ".csv"):
            raise InputError(f"{out} must be a new file that ends in .npz or .csv")
        resolved = resolve(task, environment)
        if resolved.task.world_kind != "workcell":
            raise InputError(f"{task} has no tool that a hand could lead: teach one that puts a part into another")
        self.task, self.out = resolved.task, out
        builder = DiagramBuilder()
        self.station = builder.AddNamedSystem("station", make_station(resolved))
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
        """One control step: the command moves towards the sliders, and is recorded."""
        self._push_sliders()
        scales = np.array([scale for *_, scale in SLIDERS.values()])
        self.wanted = scales * [self.meshcat.GetSliderValue(name) for name in SLIDERS]
        goal = self.start + self.wanted
        self.command = self.command + np.clip(goal - self.command, -SPEED * self._period, SPEED * self._period)
        context = self.simulator.get_mutable_context()
        if self.steps % round(SNAPSHOT / self._period) == 0:
            self.taken.snapshots.append((context.Clone(), self.steps, self.command.copy(), self.wanted.copy()))
        self._port().FixValue(context, self.command)
        self.taken.times.append(self.steps * self._period)
        self.taken.commands.append(self.command.copy())
        self.steps += 1
        self.simulator.AdvanceTo(self.steps * self._period)
        if self.gauge is not None and self.steps % FORCE_EVERY == 0:
            self.gauge.show(self._force())

    def undo(self) -> None:
        """Takes the last second back: robot, parts, command and sliders. Where nothing was shown there is none."""
        snapshots = self.taken.snapshots
        if not snapshots:
            return
        if len(snapshots) > 1 and self.steps - snapshots[-1][1] < round(0.5 * SNAPSHOT / self._period):
            snapshots.pop()
        context, self.steps, self.command, self.wanted = snapshots[-1]
        self.simulator.get_mutable_context().SetTimeStateAndParametersFrom(context)
        self.simulator.Initialize()
        del self.taken.times[self.steps :], self.taken.commands[self.steps :]
        for (name, (*_, scale)), value in zip(SLIDERS.items(), self.wanted, strict=True):
            self.meshcat.SetSliderValue(name, float(value / scale))
        snapshots.pop()

    def keep(self) -> str:
        """Keeps what was shown, writes all that was kept, and says how it ended.

        Raises:
            InputError: if nothing was shown yet.
        """
        if len(self.taken.times) < LEAST_SAMPLES:
            raise InputError("nothing was shown yet: move the sliders or press the keys first")
        success = self.is_success()
        self.kept.append(without_rests(self._period, np.array(self.taken.commands)))
        self.succeeded.append(success)
        self.out.parent.mkdir(parents=True, exist_ok=True)
        self.demonstrations().save(self.out)
        ended = {None: "", True: ", at the target", False: ", NOT at the target"}[success]
        lasts = f"{self.taken.times[-1]:.1f} s, {self.kept[-1][0][-1]:.1f} s of them without rests"
        return f"kept demonstration {len(self.kept)}: {lasts}{ended}; {self.out}"

    def demonstrations(self) -> Demonstrations:
        """All that were kept."""
        return Demonstrations([t for t, _ in self.kept], [y for _, y in self.kept], NAMES)

    def is_success(self) -> bool | None:
        """Whether the workpiece is where the task wants it; None where the task doesn't say it by its pose."""
        task = self.task
        if not isinstance(task, InsertionTask):
            return None
        success = next((one for one in task.conditions() if one.termination == "success"), None)
        if success is None or list(success.inputs) != [task.workpiece]:
            return None
        plant = self.station.plant
        context = plant.GetMyContextFromRoot(self.simulator.get_context())
        X = plant.GetFrameByName(task.workpiece).CalcPose(context, plant.GetFrameByName(task.fixture))
        turn = X.rotation().ToAngleAxis()
        return bool(success.holds(np.concatenate([X.translation(), turn.angle() * turn.axis()])))

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
        bounds = demonstrated_bounds(demonstrations)
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
            # Drake compares all the time since then: it would hurry, or wait, until the new rate held for all of it.
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
        return np.asarray(self.task.world().X_WT.rotation().multiply(force))

    def _draw_tube(self, mean: np.ndarray, spread: np.ndarray) -> None:
        X_WT: RigidTransform = self.task.world().X_WT
        for number, factor in enumerate((0.0, 2.0, -2.0)):
            points = X_WT.multiply((mean[:, :3] + factor * spread[:, :3]).T)
            colour = Rgba(0.1, 0.3, 0.8, 1.0 if number == 0 else 0.4)
            self.meshcat.SetLine(f"/guiderail/learned/{number}", points, 3.0 if number == 0 else 1.0, colour)

    def _start_pose(self) -> np.ndarray:
        return (
            self.task.start(np.random.default_rng(0)) if isinstance(self.task, InsertionTask) else np.zeros(POSE_SIZE)
        )

    def _port(self) -> Any:
        return self.simulator.get_system().GetInputPort("desired_pose")


def without_rests(period: float, commands: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Times (n,) and commands (n, 6) of a demonstration whose rests are cut to `REST`: a person looks, and thinks.

    Args:
        period: of the control steps [s].
        commands: one for each of them, (N, 6).
    """
    resting, kept = 0, [0]
    for step in range(1, len(commands)):
        resting = resting + 1 if np.array_equal(commands[step], commands[step - 1]) else 0
        if resting * period <= REST:
            kept.append(step)
    return period * np.arange(len(kept)), commands[kept]


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
