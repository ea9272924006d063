"""Recording of demonstrations on a double of a Meshcat page."""

from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest
from page_double import PageDouble

from guiderail.models.common import files as writing
from guiderail.models.common.errors import InputError
from guiderail.models.primitives import Demonstrations
from guiderail_hardware.teleop import recorder as recording
from guiderail_hardware.teleop.recorder import (
    BLUE,
    BUTTONS,
    DISCARD,
    END,
    KEEP,
    LENGTH,
    PATH,
    RED,
    SLIDERS,
    SLOW,
    UNDO,
    DemonstrationRecorder,
    ForceGauge,
)


class Page(PageDouble):
    """Double of a page that also has a gamepad and records objects.

    Attributes:
        gamepad: State of the gamepad; its index is None if none is connected.
        poses: Transforms (4, 4) by path.
        properties: Values by path and name.
        camera: Positions of eye and target, (2, 3) [m].
    """

    def __init__(self):
        super().__init__()
        self.gamepad = SimpleNamespace(index=None, axes=[])
        self.poses, self.properties = {}, {}

    def GetGamepad(self):
        return self.gamepad

    def SetProperty(self, path, name, value):
        self.properties[path, name] = value

    def SetObject(self, path, shape, color):
        pass

    def SetTransform(self, path, pose):
        self.poses[path] = np.array(pose)

    def SetCameraPose(self, eye, target):
        self.camera = np.array([eye, target])

    def SetLine(self, path, vertices, width, color):
        pass


@pytest.fixture
def session(tmp_path):
    """Return a recorder of the clamp's task."""
    return DemonstrationRecorder("GridClamp", {}, tmp_path / "recorded.npz", meshcat=Page())


def move_slider(session, name, value, steps):
    """Set a slider and simulate some control steps."""
    session.panel.meshcat.SetSliderValue(name, value)
    for _ in range(steps):
        session.step()


def test_keep_writes_the_demonstration_immediately(session):
    session.reset()
    move_slider(session, "x [mm]", 2.0, 20)
    assert "kept demonstration 1" in session.keep()
    displacements = Demonstrations.load(session.out).outputs[0] - session.start
    assert displacements[-1] == pytest.approx([2e-3, 0, 0, 0, 0, 0])
    # The speed of the command is limited, although the slider jumps.
    assert np.abs(np.diff(displacements[:, 0])).max() <= recording.MAX_SPEED[0] * 0.02 + 1e-12
    session.reset()
    move_slider(session, "y [mm]", 1.0, 20)
    session.keep()
    assert Demonstrations.load(session.out).num_demonstrations == 2


@pytest.mark.parametrize("station", ["gantry", "mujoco"])
def test_success_is_determined_from_the_simulated_pose(station, tmp_path):
    if station == "mujoco":
        pytest.importorskip("mujoco")
    session = DemonstrationRecorder("GridClamp", {"station": station}, tmp_path / "recorded.npz", meshcat=Page())
    session.reset()
    move_slider(session, "x [mm]", 2.0, 20)
    assert ", NOT at the target" in session.keep()
    assert session.successes == [False]
    session.station.set_pose(session.simulator.get_mutable_context(), np.zeros(6))
    assert session.is_success() is True


def test_gauge_shows_the_force_on_the_robot(session):
    session.reset()
    move_slider(session, "x [mm]", 3.0, 15)  # next to the holes
    move_slider(session, "z [mm]", -12.0, 60)
    force = session._force()
    assert force[2] > 1.0  # in contact
    shaft, bar = (session.panel.meshcat.poses[f"{PATH}/{part}"] for part in ("shaft", "bar"))
    # The arrow has the direction of the force, and a length proportional to the force relative to the limit.
    full = np.linalg.norm(np.subtract(*session.panel.meshcat.camera)) * LENGTH
    share = np.linalg.norm(force) / session.task.collision.above
    np.testing.assert_allclose(shaft[:3, 2], force / np.linalg.norm(force) * share * full, rtol=1e-9)
    assert bar[2, 2] == pytest.approx(share * full)


@pytest.mark.parametrize(("force", "share", "color"), [(6.9, 0.69, BLUE), (7.1, 0.71, RED), (80.0, 1.0, RED)])
def test_gauge_is_red_from_70_percent_and_full_at_the_limit(force, share, color):
    page = Page()
    gauge = ForceGauge(page, ((0.0, -2.0, 1.0), (0.0, 0.0, 1.0)), limit=10.0)
    gauge.show(np.array([force, 0.0, 0.0]))
    assert page.poses[f"{PATH}/bar"][2, 2] == pytest.approx(share * 2.0 * LENGTH)
    np.testing.assert_allclose(page.poses[f"{PATH}/shaft"][:3, 2], [share * 2.0 * LENGTH, 0, 0], atol=1e-12)
    assert page.properties[f"{PATH}/bar/<object>", "color"] == list(color)
    # The camera looks along y: the arrow is to the right of the part, and the bar is to its left.
    assert page.poses[f"{PATH}/shaft"][0, 3] > 0.1 > -0.1 > page.poses[f"{PATH}/bar"][0, 3]
    for force in (0.0, 1e-300, 1e-12, 1e-3):
        gauge.show(np.array([force, 0.0, 0.0]))
        assert all(np.isfinite(pose).all() and abs(np.linalg.det(pose)) > 0 for pose in page.poses.values())


def test_undo_returns_to_the_start_of_the_last_motion(session):
    session.reset()
    move_slider(session, "x [mm]", 1.0, 60)
    before = [command.copy() for command in session.recording.commands]
    move_slider(session, "x [mm]", -3.0, 50)
    stored = session.recording.snapshots[-1].context
    session.undo()
    assert session.steps == 60
    np.testing.assert_array_equal(session.recording.commands, before)
    assert session.panel.meshcat.sliders["x [mm]"] == pytest.approx(1.0)
    states = [context.get_discrete_state() for context in (stored, session.simulator.get_context())]
    assert states[0].num_groups() == states[1].num_groups() > 1
    for group in range(states[0].num_groups()):
        np.testing.assert_array_equal(states[1].value(group), states[0].value(group))
    move_slider(session, "x [mm]", 1.0, 10)
    assert session.simulator.get_context().get_time() == pytest.approx(70 * 0.02)


def test_undo_removes_a_long_motion_second_by_second(session):
    session.reset()
    move_slider(session, "z [mm]", 40.0, 90)  # two seconds of motion at the limited speed
    for steps in (50, 0, 0):
        session.undo()
        assert session.steps == len(session.recording.commands) == steps
    move_slider(session, "z [mm]", 40.0, 60)
    session.undo()  # the remainder of 0.2 s is removed together with the second before
    assert session.steps == 0


def test_rest_adds_no_samples_and_no_snapshots(session):
    session.reset()
    move_slider(session, "x [mm]", 2.0, 60)
    counts = len(session.recording.commands), len(session.recording.snapshots)
    before = session.command
    move_slider(session, "x [mm]", 2.0, 200)
    assert (len(session.recording.commands), len(session.recording.snapshots)) == counts
    assert counts[0] <= 10
    assert counts[1] == 1
    session.undo()
    assert (session.steps, session.recording.commands) == (0, [])
    assert not np.array_equal(session.command, before)


def test_undo_is_limited_to_max_undos(session, monkeypatch):
    monkeypatch.setattr(recording, "MAX_UNDOS", 2)
    session.reset()
    for turn in (60.0, 0.0, 60.0, 0.0):
        move_slider(session, "turn [degrees]", turn, 50)
    assert len(session.recording.snapshots) == 2
    for steps in (150, 100, 100):
        session.undo()
        assert session.steps == steps


def test_undo_does_nothing_without_motion(session):
    session.reset()
    session.undo()
    move_slider(session, "x [mm]", 1.0, 5)
    session.undo()
    session.undo()
    assert (session.steps, session.recording.commands) == (0, [])
    move_slider(session, "x [mm]", 1.0, 5)
    assert session.simulator.get_context().get_time() == pytest.approx(5 * 0.02)


def test_slow_motion_begins_at_the_present_time(session, monkeypatch):
    monkeypatch.setattr(recording, "SLOW_RATE", 4.0)  # faster than real time, for a short test
    rates, step = [], session.step

    def step_and_record():
        step()
        rates.append((session.simulator.get_target_realtime_rate(), session.simulator.get_num_steps_taken()))
        session.panel.meshcat.clicks[SLOW] += len(rates) in (3, 6)

    session.step = step_and_record
    session.run(lambda text: None, max_steps=9)
    target_rates, num_steps = zip(*rates, strict=True)
    assert target_rates == (1.0,) * 3 + (4.0,) * 3 + (1.0,) * 3
    # Drake counts steps from the instant at which it began to compare its time with the wall clock.
    assert num_steps[0] == num_steps[3] == num_steps[6] < num_steps[1] == num_steps[4] == num_steps[7]


def test_file_survives_an_interruption_while_writing(session, monkeypatch):
    def interrupt(*paths):
        raise KeyboardInterrupt

    session.reset()
    move_slider(session, "x [mm]", 2.0, 12)
    session.keep()
    monkeypatch.setattr(writing.os, "replace", interrupt)
    with pytest.raises(KeyboardInterrupt):
        session.keep()
    assert Demonstrations.load(session.out).num_demonstrations == 1


def test_sessions_with_the_same_file_keep_all_demonstrations(session):
    second = DemonstrationRecorder("GridClamp", {}, session.out, meshcat=Page())
    file = session.out
    for recorder, expected in ((session, file), (session, file), (second, file.with_name("recorded_2.npz"))):
        recorder.reset()
        move_slider(recorder, "x [mm]", 2.0, 12)
        assert str(expected) in recorder.keep()
        assert recorder.out == expected
    second.out.write_bytes(file.read_bytes())  # replaced by another program
    assert f"recorded_2_2.npz, because another program has written {second.out}" in second.keep()
    assert [Demonstrations.load(path).num_demonstrations for path in (file, second.out)] == [2, 2]


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_slider_value_is_ignored_when_not_finite(session, value):
    session.reset()
    move_slider(session, "x [mm]", 1.0, 20)
    move_slider(session, "x [mm]", value, 1)
    assert session.offset[0] == pytest.approx(1e-3)
    session.panel.meshcat.SetSliderValue("x [mm]", value)
    session.panel.meshcat.gamepad = SimpleNamespace(index=0, axes=[1.0])
    session.step()
    assert 1e-3 < session.offset[0] < 2e-3
    assert np.isfinite(session.command).all()


def test_keep_writes_to_a_temporary_folder_when_out_is_full(session, monkeypatch, tmp_path):
    write = writing.write_atomically

    def write_elsewhere(path, content):
        if not path.parent.name.startswith("guiderail-"):
            raise InputError("no room")
        write(path, content)

    session.reset()
    move_slider(session, "x [mm]", 2.0, 12)
    monkeypatch.setattr("guiderail.models.primitives.io.write_atomically", write_elsewhere)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    message = session.keep()
    assert message.endswith(f"cannot be written, so the record is in {session.out}")
    assert session.out.parent.parent == tmp_path
    assert Demonstrations.load(session.out).num_demonstrations == 1


def test_buttons_keep_discard_and_end(session):
    messages = []
    page, step = session.panel.meshcat, session.step
    inputs = {15: ("y [mm]", 1.0), 30: KEEP, 60: DISCARD, 61: KEEP, 80: END}  # slider values and clicks by step
    num_steps = 0

    def step_with_input():
        nonlocal num_steps
        command = inputs.get(num_steps)
        num_steps += 1
        if isinstance(command, tuple):
            page.SetSliderValue(*command)
        elif command is not None:
            page.clicks[command] += 1
        step()

    session.step = step_with_input
    session.run(messages.append, real_time=False, max_steps=200)
    assert num_steps == 81
    assert [text.split()[0] for text in messages] == ["kept", "discarded", "nothing"]
    assert len(session.demonstrations) == 1
    statistics = session.summarize()
    assert statistics["demonstrations"] == 1
    assert statistics["the mean alone succeeds"] is False  # the part was never lowered


def test_gamepad_moves_the_sliders(session):
    session.reset()
    session.panel.meshcat.gamepad = SimpleNamespace(index=0, axes=[1.0, 0.05])
    for _ in range(50):
        session.step()
    assert session.panel.meshcat.sliders["x [mm]"] == pytest.approx(10.0)
    assert session.panel.meshcat.sliders["y [mm]"] == 0.0


def test_keep_refuses_a_demonstration_without_motion(session):
    session.reset()
    move_slider(session, "x [mm]", 0.0, 40)
    with pytest.raises(InputError, match="nothing was shown yet"):
        session.keep()
    assert not session.out.exists()


def test_keep_shortens_rests(session):
    session.reset()
    move_slider(session, "x [mm]", 2.0, 60)
    move_slider(session, "y [mm]", 2.0, 60)
    assert "2.4 s, 0.3 s after rests were shortened" in session.keep()
    times, commands = session.demonstrations[0]
    np.testing.assert_allclose(np.diff(times), 0.02)
    np.testing.assert_allclose(commands[-1] - session.start, [2e-3, 2e-3, 0, 0, 0, 0])


def test_camera_looks_at_the_part(session):
    eye, target = session.panel.meshcat.camera
    assert np.linalg.norm(target - session.task.workcell().X_WT.translation()) < 0.05
    assert np.linalg.norm(eye - target) < 0.3


def test_recorder_opens_a_meshcat_page(tmp_path):
    recorder = DemonstrationRecorder("BncConnector", {}, tmp_path / "recorded.npz")
    assert recorder.panel.meshcat.web_url().startswith("http://localhost:")


def test_keys_are_unique(session):
    keys = [key for slider in SLIDERS.values() for key in slider.keys] + list(BUTTONS.values())
    assert len(set(keys)) == len(keys)
    assert UNDO in BUTTONS


@pytest.mark.parametrize("name", ["file/recorded.npz", f"{'x' * 300}.npz", f"{'x' * 300}/recorded.npz"])
def test_recorder_raises_before_the_page_when_out_is_invalid(name, tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    monkeypatch.setattr(recording.EnvConfig, "resolve", lambda *arguments: pytest.fail("the environment was built"))
    with pytest.raises(InputError, match=r"written|read"):
        DemonstrationRecorder("GridClamp", {}, tmp_path / name, meshcat=Page())


def test_keep_succeeds_after_a_failed_attempt_to_write(session, tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.mkdtemp", Mock(side_effect=OSError))  # no temporary folder can be created
    messages = []
    session.out = tmp_path / "file" / "recorded.npz"
    (tmp_path / "file").touch()
    session.reset()
    move_slider(session, "x [mm]", 2.0, 12)
    session._press(KEEP, messages.append)
    assert "cannot be written" in messages[0]
    (tmp_path / "file").unlink()
    session._press(KEEP, messages.append)
    assert "kept demonstration 1" in messages[1]
    assert Demonstrations.load(session.out).num_demonstrations == 1


def test_recorder_raises_when_arguments_are_invalid(tmp_path):
    (tmp_path / "existing.npz").touch()
    for task, file in (("GridClamp", "existing.npz"), ("GridClamp", "new.txt"), ("NarrowPassage", "new.npz")):
        with pytest.raises(InputError):
            DemonstrationRecorder(task, {}, tmp_path / file, meshcat=Page())
    with pytest.raises(InputError, match="recorded in simulation: leave station=hardware out"):
        DemonstrationRecorder("BncConnector", {"station": "hardware"}, tmp_path / "recorded.npz")
