"""A person's keys become demonstrations: by a page that answers as Meshcat's does."""

from types import SimpleNamespace

import numpy as np
import pytest

from guiderail.models.common import files as writing
from guiderail.models.common.errors import InputError
from guiderail.models.primitives import Demonstrations
from guiderail.tools.teleop import teach as teaching
from guiderail.tools.teleop.teach import (
    BUTTONS,
    CALM,
    DISCARD,
    END,
    KEEP,
    LENGTH,
    PATH,
    RED,
    SLIDERS,
    SLOW,
    UNDO,
    ForceGauge,
    Teaching,
)


class Page:
    """What a session asks of a Meshcat: sliders that stay where they are, buttons that count their clicks."""

    def __init__(self):
        self.sliders, self.clicks, self.lines = {}, dict.fromkeys(BUTTONS, 0), {}
        self.gamepad = SimpleNamespace(index=None, axes=[])
        self.poses, self.properties = {}, {}

    def AddSlider(self, name, low, high, step, value, lower, higher):
        self.sliders[name] = value

    def AddButton(self, name, key):
        pass

    def SetSliderValue(self, name, value):
        self.sliders[name] = value

    def GetSliderValue(self, name):
        return self.sliders[name]

    def GetButtonClicks(self, name):
        return self.clicks[name]

    def GetGamepad(self):
        return self.gamepad

    def SetProperty(self, path, name, value):
        self.properties[path, name] = value

    def SetObject(self, path, shape, colour):
        pass

    def SetTransform(self, path, pose):
        self.poses[path] = np.array(pose)

    def SetCameraPose(self, eye, target):
        self.lines["camera"] = np.array([eye, target])

    def SetLine(self, path, vertices, width, colour):
        self.lines[path] = vertices


@pytest.fixture
def session(tmp_path):
    return Teaching("GridClamp", {}, tmp_path / "shown.npz", meshcat=Page())


def lead(session, name, to, steps):
    session.meshcat.SetSliderValue(name, to)
    for _ in range(steps):
        session.step()


def test_what_is_led_is_kept_at_once(session):
    session.begin()
    lead(session, "x [mm]", 2.0, 20)
    assert "kept demonstration 1" in session.keep()
    shown = Demonstrations.load(session.out)
    moved = shown.outputs[0] - session.start
    assert moved[-1] == pytest.approx([2e-3, 0, 0, 0, 0, 0])
    # At a hand's speed, however far the slider jumped.
    assert np.abs(np.diff(moved[:, 0])).max() <= teaching.SPEED[0] * 0.02 + 1e-12
    session.begin()
    lead(session, "y [mm]", 1.0, 20)
    session.keep()
    assert Demonstrations.load(session.out).num_demonstrations == 2


def test_the_robot_follows_and_its_force_is_shown(session):
    session.begin()
    lead(session, "x [mm]", 3.0, 15)  # beside the holes
    lead(session, "z [mm]", -12.0, 60)
    force = session._force()
    assert force[2] > 1.0  # it stands on something
    shaft, bar = (session.meshcat.poses[f"{PATH}/{part}"] for part in ("shaft", "bar"))
    # The arrow points where the force does, and is as long as its share of the limit.
    full = np.linalg.norm(np.subtract(*session.meshcat.lines["camera"])) * LENGTH
    share = np.linalg.norm(force) / session.task.collision.above
    np.testing.assert_allclose(shaft[:3, 2], force / np.linalg.norm(force) * share * full, rtol=1e-9)
    assert bar[2, 2] == pytest.approx(share * full)


@pytest.mark.parametrize(("newtons", "share", "colour"), [(6.9, 0.69, CALM), (7.1, 0.71, RED), (80.0, 1.0, RED)])
def test_the_bar_is_full_at_the_limit_and_red_before(newtons, share, colour):
    page = Page()
    gauge = ForceGauge(page, ((0.0, -2.0, 1.0), (0.0, 0.0, 1.0)), limit=10.0)
    gauge.show(np.array([newtons, 0.0, 0.0]))
    assert page.poses[f"{PATH}/bar"][2, 2] == pytest.approx(share * 2.0 * LENGTH)
    np.testing.assert_allclose(page.poses[f"{PATH}/shaft"][:3, 2], [share * 2.0 * LENGTH, 0, 0], atol=1e-12)
    assert page.properties[f"{PATH}/bar/<object>", "color"] == list(colour)
    # The arrow stands right of the part, the bar left of it, as the camera looks along y.
    assert page.poses[f"{PATH}/shaft"][0, 3] > 0.1 > -0.1 > page.poses[f"{PATH}/bar"][0, 3]
    gauge.show(np.zeros(3))
    assert all(np.isfinite(pose).all() and abs(np.linalg.det(pose)) > 0 for pose in page.poses.values())


def test_undo_takes_a_second_back(session):
    session.begin()
    lead(session, "x [mm]", 1.0, 60)
    before = [command.copy() for command in session.taken.commands]
    lead(session, "x [mm]", -3.0, 50)
    session.undo()  # to before the motion that was begun a second or more after the one before it
    assert session.steps == 60
    np.testing.assert_array_equal(session.taken.commands, before)
    assert session.meshcat.sliders["x [mm]"] == pytest.approx(1.0)
    lead(session, "x [mm]", 1.0, 10)
    assert session.simulator.get_context().get_time() == pytest.approx(70 * 0.02)


def test_undo_goes_second_by_second_through_one_motion(session):
    session.begin()
    lead(session, "z [mm]", 40.0, 90)  # two seconds of motion, at a hand's speed
    for steps, left in ((50, 50), (0, 0), (0, 0)):
        session.undo()
        assert session.steps == steps
        assert len(session.taken.commands) == left
    lead(session, "z [mm]", 40.0, 60)
    session.undo()  # the second that has only begun is no second: the one before it goes as well
    assert session.steps == 0


def test_whoever_does_nothing_keeps_nothing(session):
    session.begin()
    lead(session, "x [mm]", 2.0, 60)
    held = len(session.taken.commands), len(session.taken.snapshots)
    before = session.command
    lead(session, "x [mm]", 2.0, 200)
    assert (len(session.taken.commands), len(session.taken.snapshots)) == held
    assert held[0] <= 10
    assert held[1] == 1
    session.undo()
    assert (session.steps, session.taken.commands) == (0, [])
    assert not np.array_equal(session.command, before)


def test_only_so_much_can_be_undone(session, monkeypatch):
    monkeypatch.setattr(teaching, "UNDONE", 2)
    session.begin()
    for turn in (60.0, 0.0, 60.0, 0.0):
        lead(session, "turn [degrees]", turn, 50)
    assert len(session.taken.snapshots) == 2
    for steps in (150, 100, 100):
        session.undo()
        assert session.steps == steps


def test_where_nothing_was_shown_undo_does_nothing(session):
    session.begin()
    session.undo()
    lead(session, "x [mm]", 1.0, 5)
    session.undo()
    session.undo()
    assert (session.steps, session.taken.commands) == (0, [])
    lead(session, "x [mm]", 1.0, 5)
    assert session.simulator.get_context().get_time() == pytest.approx(5 * 0.02)


def test_slow_motion_is_slow_from_now_on_and_catches_up_with_nothing(session, monkeypatch):
    monkeypatch.setattr(teaching, "SLOWLY", 4.0)  # what is slow takes a test too long
    paced, step = [], session.step

    def stepped():
        step()
        paced.append((session.simulator.get_target_realtime_rate(), session.simulator.get_num_steps_taken()))
        session.meshcat.clicks[SLOW] += len(paced) in (3, 6)

    session.step = stepped
    session.run(lambda words: None, most_steps=9)
    rates, since = zip(*paced, strict=True)
    assert rates == (1.0,) * 3 + (4.0,) * 3 + (1.0,) * 3
    # Drake's steps since it began to compare its time with the wall's.
    assert since[0] == since[3] == since[6] < since[1] == since[4] == since[7]


def test_what_was_kept_outlasts_whoever_dies_while_writing(session, monkeypatch):
    def die(*paths):
        raise KeyboardInterrupt

    session.begin()
    lead(session, "x [mm]", 2.0, 12)
    session.keep()
    monkeypatch.setattr(writing.os, "replace", die)
    with pytest.raises(KeyboardInterrupt):
        session.keep()
    assert Demonstrations.load(session.out).num_demonstrations == 1


def test_buttons_do_what_they_say(session):
    said = []
    page, step = session.meshcat, session.step
    script = {15: ("y [mm]", 1.0), 30: KEEP, 60: DISCARD, 61: KEEP, 80: END}
    count = [0]

    def scripted():
        act = script.get(count[0])
        count[0] += 1
        if isinstance(act, tuple):
            page.SetSliderValue(*act)
        elif act is not None:
            page.clicks[act] += 1
        step()

    session.step = scripted
    session.run(said.append, real_time=False, most_steps=200)
    assert count[0] == 81
    assert [words.split()[0] for words in said] == ["kept", "discarded", "nothing"]
    assert len(session.kept) == 1
    found = session.learned()
    assert found["demonstrations"] == 1
    assert found["the mean alone succeeds"] is False  # it never went down


def test_a_gamepad_pushes_the_sliders(session):
    session.begin()
    session.meshcat.gamepad = SimpleNamespace(index=0, axes=[1.0, 0.05])
    for _ in range(50):
        session.step()
    assert session.meshcat.sliders["x [mm]"] == pytest.approx(10.0)
    assert session.meshcat.sliders["y [mm]"] == 0.0


def test_whoever_rests_does_not_demonstrate_resting(session):
    session.begin()
    lead(session, "x [mm]", 2.0, 60)
    lead(session, "y [mm]", 2.0, 60)
    assert "2.4 s, 0.3 s of them without rests" in session.keep()
    times, commands = session.kept[0]
    np.testing.assert_allclose(np.diff(times), 0.02)
    np.testing.assert_allclose(commands[-1] - session.start, [2e-3, 2e-3, 0, 0, 0, 0])


def test_the_page_opens_before_the_part(session):
    eye, target = session.meshcat.lines["camera"]
    assert np.linalg.norm(target - session.task.workcell().X_WT.translation()) < 0.05
    assert np.linalg.norm(eye - target) < 0.3


def test_a_real_page_is_opened(tmp_path):
    assert Teaching("BncConnector", {}, tmp_path / "shown.npz").meshcat.web_url().startswith("http://localhost:")


def test_every_key_is_one_things(session):
    keys = [key for _, _, *pair, _ in SLIDERS.values() for key in pair] + list(BUTTONS.values())
    assert len(set(keys)) == len(keys)
    assert UNDO in BUTTONS


@pytest.mark.parametrize("name", ["file/shown.npz", f"{'x' * 300}.npz", f"{'x' * 300}/shown.npz"])
def test_where_nothing_can_be_written_nobody_begins_to_show_anything(name, tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    monkeypatch.setattr(teaching.EnvConfig, "resolve", lambda *given: pytest.fail("the page opens"))
    with pytest.raises(InputError, match=r"written|read"):
        Teaching("GridClamp", {}, tmp_path / name, meshcat=Page())


def test_what_cannot_be_written_in_the_end_is_still_there_to_be_kept(session, tmp_path):
    said = []
    session.out = tmp_path / "file" / "shown.npz"
    (tmp_path / "file").touch()
    session.begin()
    lead(session, "x [mm]", 2.0, 12)
    session._press(KEEP, said.append)
    assert "cannot be written" in said[0]
    (tmp_path / "file").unlink()
    session._press(KEEP, said.append)
    assert "kept demonstration 1" in said[1]
    assert Demonstrations.load(session.out).num_demonstrations == 1


def test_what_makes_no_sense_is_refused(tmp_path):
    (tmp_path / "there.npz").touch()
    for task, file in (("GridClamp", "there.npz"), ("GridClamp", "new.txt"), ("NarrowPassage", "new.npz")):
        with pytest.raises(InputError):
            Teaching(task, {}, tmp_path / file, meshcat=Page())
