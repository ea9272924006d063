"""Page of episodes: signals, equal starts of demonstration and policy, links, and refused arguments."""

import base64
import json
import re
from pathlib import Path

import numpy as np
import pytest

from guiderail.models.primitives import LinearConstraints
from guiderail.tools.environments import check_environment, make_environment
from guiderail.tools.evaluation.baselines import constant_policy
from guiderail.tools.evaluation.rollout import rollout
from guiderail.tools.evaluation.subject import EpisodeSpec
from guiderail.tools.visualization import replay
from guiderail.tools.visualization.replay import (
    VISUALIZER_PATH,
    MotionRecorder,
    default_page,
    find_report,
    violation_unit,
    write_page,
)

ENVIRONMENT = {"guidance": "kgrl", "action_repeat": 10}
BALL = f"{VISUALIZER_PATH}/robot/ball"


def constant_x_action(env):
    return constant_policy(env, np.array([1.0, 0.0]))


def poses(text):
    """Return the positions and quaternions (N, 7) of a body from the data of the page."""
    return np.frombuffer(base64.b64decode(text), "<f4").reshape(-1, 7)


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    study = tmp_path_factory.mktemp("study")
    (study / "report.html").write_text("")
    (study / "run").mkdir()
    file = study / "run" / "replay.html"
    arguments = check_environment("NarrowPassage", ENVIRONMENT)
    spec = EpisodeSpec("NarrowPassage", arguments, constant_x_action, "action (1, 0)", "constant", run=file.parent)
    row = write_page(file, spec, episodes=2)
    return file.read_text(encoding="utf-8"), row


def page_data(text):
    """Return the data of the page's script."""
    return json.loads(re.search(r"const data = (\{.*\});\n", text).group(1))


def test_page_has_equal_times_for_all_signals_of_both_sides(page):
    demonstration, policy = page_data(page[0])["sides"]
    for episode in (*demonstration["episodes"], *policy["episodes"]):
        n = len(episode["times"])
        assert all(len(episode[name]) == n for name in ("force", "commanded", "measured", "time"))
        assert [len(values) for values in episode["action"]] == [n, n]
        assert len(poses(episode["frames"][BALL])) == n
    assert len(demonstration["episodes"]) == len(policy["episodes"]) == 2


def test_demonstration_and_policy_have_the_same_starts(page):
    demonstration, policy = page_data(page[0])["sides"]
    for reference, learned in zip(demonstration["episodes"], policy["episodes"], strict=True):
        np.testing.assert_array_equal(poses(reference["frames"][BALL])[0], poses(learned["frames"][BALL])[0])
        assert np.ptp(reference["action"]) == 0.0
        assert max(learned["action"][0]) == 1.0
    first, second = (poses(episode["frames"][BALL])[0] for episode in policy["episodes"])
    assert not np.array_equal(first, second)


def test_page_has_the_largest_violation_and_force(page):
    text, row = page
    (episode, _) = page_data(text)["sides"][1]["episodes"]
    assert max(episode["commanded"]) == pytest.approx(row["max_commanded_violation"], abs=1e-9)
    assert max(episode["force"]) == pytest.approx(row["peak_force"], rel=1e-4)
    assert page_data(text)["violation"] == {"unit": "mm", "scale": 1000.0}


def test_page_is_self_contained_with_a_layout_for_phones(page):
    text = page[0]
    assert '<meta name="viewport" content="width=device-width' in text
    assert "<title>NarrowPassage · kgrl · constant" in text
    assert "@media (max-width: 700px)" in text
    assert all(words in text for words in ("the constraint", "demonstrations", "transparent</button>"))
    assert "<script src=" not in text
    assert "<link" not in text
    assert "https://" not in text.partition("<body>")[0]


def test_page_links_an_existing_report(page, tmp_path):
    assert '<a href="../report.html">' in page[0]
    run = tmp_path / "run"
    run.mkdir()
    assert find_report(run / "replay.html", run) is None
    (run / "report.html").write_text("")
    assert find_report(run / "replay.html", run) == "report.html"
    assert find_report(tmp_path / "replay.html", run) == "run/report.html"


def test_motion_keeps_the_peak_force_when_it_is_resampled(monkeypatch):
    monkeypatch.setattr(replay, "POINTS", 7)
    env = make_environment("NarrowPassage", {"guidance": "residual", "action_repeat": 10}, render_mode="human")
    env.unwrapped.simulator.set_target_realtime_rate(0.0)
    env.reset(seed=0)
    motion = MotionRecorder(env)
    row = rollout(env, constant_policy(env, np.array([1.0, 0.0])), motion, seed=1_000_000, held_out=True)
    recorded, trace = motion.data(), env.unwrapped.trace
    assert len(recorded["times"]) <= 8
    assert recorded["times"][-1] == pytest.approx(len(trace) * trace.period)
    assert max(recorded["force"]) == pytest.approx(row["peak_force"], rel=1e-4)
    assert max(recorded["commanded"]) == pytest.approx(row["max_commanded_violation"], rel=1e-4)
    np.testing.assert_allclose(poses(recorded["frames"][BALL])[-1, :2], trace.measured[-1], atol=1e-6)
    env.close()


def test_motion_has_one_sample_without_a_control_step():
    env = make_environment("NarrowPassage", {"guidance": "kgrl"}, render_mode="human")
    env.unwrapped.simulator.set_target_realtime_rate(0.0)
    env.reset(seed=0)
    motion = MotionRecorder(env)
    env.reset(seed=1)
    motion.on_episode_start()
    recorded = motion.data()
    assert recorded["times"] == [0.0]
    assert poses(recorded["frames"][BALL]).shape == (1, 7)
    assert recorded["force"] is None
    env.close()


def test_default_page_is_not_written_to_a_task_folder(tmp_path):
    assert default_page(tmp_path, {}) == tmp_path / "replay.html"
    (tmp_path / "task.yaml").touch()
    assert default_page(tmp_path, {"station": "arm"}) == Path("replay-arm.html")


def test_page_has_the_report_command_of_its_run(tmp_path):
    run = tmp_path / "runs" / "passage"
    run.mkdir(parents=True)
    arguments = check_environment("NarrowPassage", ENVIRONMENT)
    spec = EpisodeSpec("NarrowPassage", arguments, constant_x_action, "action (1, 0)", "constant", run=run)
    write_page(run / "replay.html", spec, episodes=1)
    text = (run / "replay.html").read_text(encoding="utf-8")
    assert f"guiderail report {run} --out {run}/report.html" in text
    assert "largest constraint violation: commanded" in text


@pytest.mark.parametrize(
    ("constraints", "outputs", "unit"),
    [
        (LinearConstraints.box(-np.ones(2), np.ones(2)), 2, "mm"),
        (LinearConstraints.box(-np.array([1, 1, *[np.inf] * 4]), np.array([1, 1, *[np.inf] * 4])), 6, "mm"),
        (LinearConstraints.box(-np.ones(6), np.ones(6)), 6, "m or rad"),
        (None, 6, "m or rad"),
    ],
)
def test_violation_unit_depends_on_the_bounded_outputs(constraints, outputs, unit):
    assert violation_unit(constraints, outputs)[0] == unit


def test_motion_has_the_contacts_of_a_pressed_tool():
    env = make_environment(
        "GridClamp", check_environment("GridClamp", {"guidance": "sct", "action_repeat": 5}), render_mode="human"
    )
    env.unwrapped.simulator.set_target_realtime_rate(0.0)
    motion = MotionRecorder(env)
    rollout(env, constant_policy(env, np.array([0.3, 0.0, -1.0])), motion, seed=0)
    data = motion.data()
    contacts = [np.frombuffer(base64.b64decode(text), "<f4").reshape(-1, 6) for text in data["contacts"]]
    assert 1 <= len(contacts) <= replay.CONTACTS
    assert {len(values) for values in contacts} == {len(data["times"])}
    forces = np.linalg.norm(np.array(contacts)[..., 3:], axis=2)
    assert (np.diff(forces, axis=0) <= 0.0).all()  # the largest first
    assert forces[0, 0] == 0.0  # no contact at the start
    assert 0.5 < forces.max() < 100.0
    env.close()
