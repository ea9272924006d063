"""Tests of the page of episodes: its numbers are those of the episodes, from the same conditions on both sides."""

import base64
import json
import re
from pathlib import Path

import numpy as np
import pytest

from guiderail.models.common.errors import InputError
from guiderail.models.primitives import LinearConstraints
from guiderail.tools.environments import check_environment, make_environment
from guiderail.tools.evaluation.baselines import BaselinePolicy, constant_policy, uniform_random
from guiderail.tools.evaluation.rollout import rollout
from guiderail.tools.evaluation.subject import EpisodeSpec
from guiderail.tools.visualization import replay
from guiderail.tools.visualization.replay import (
    VISUALIZER_PATH,
    Motion,
    default_page,
    find_report,
    violation_unit,
    write_page,
)

ENVIRONMENT = {"guidance": "kgrl", "action_repeat": 10}
BALL = f"{VISUALIZER_PATH}/robot/ball"


def _to_the_right(env):
    return constant_policy(env, np.array([1.0, 0.0]))


def poses(text):
    return np.frombuffer(base64.b64decode(text), "<f4").reshape(-1, 7)


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    study = tmp_path_factory.mktemp("study")
    (study / "report.html").write_text("")
    (study / "run").mkdir()
    file = study / "run" / "replay.html"
    arguments = check_environment("NarrowPassage", ENVIRONMENT)
    shown = EpisodeSpec("NarrowPassage", arguments, _to_the_right, "to the right", "constant", run=file.parent)
    row = write_page(file, shown, episodes=2)
    return file.read_text(encoding="utf-8"), row


def data(text):
    return json.loads(re.search(r"const data = (\{.*\});\n", text).group(1))


def test_page_has_all_signals_of_both_sides_on_one_time_axis(page):
    before, after = data(page[0])["sides"]
    for episode in (*before["episodes"], *after["episodes"]):
        n = len(episode["times"])
        assert all(len(episode[name]) == n for name in ("force", "commanded", "measured", "time"))
        assert [len(values) for values in episode["action"]] == [n, n]
        assert len(poses(episode["frames"][BALL])) == n
    assert len(before["episodes"]) == len(after["episodes"]) == 2


def test_before_is_the_demonstration_from_the_same_start(page):
    before, after = data(page[0])["sides"]
    for one, other in zip(before["episodes"], after["episodes"], strict=True):
        np.testing.assert_array_equal(poses(one["frames"][BALL])[0], poses(other["frames"][BALL])[0])
        assert np.ptp(one["action"]) == 0.0
        assert max(other["action"][0]) == 1.0
    first, second = (poses(episode["frames"][BALL])[0] for episode in after["episodes"])
    assert not np.array_equal(first, second)


def test_page_has_the_largest_violation_and_force(page):
    text, row = page
    (episode, _) = data(text)["sides"][1]["episodes"]
    assert max(episode["commanded"]) == pytest.approx(row["max_commanded_violation"], abs=1e-9)
    assert max(episode["force"]) == pytest.approx(row["peak_force"], rel=1e-4)
    assert data(text)["violation"] == {"unit": "mm", "scale": 1000.0}


def test_page_is_self_contained_and_fits_a_phone(page):
    text = page[0]
    assert '<meta name="viewport" content="width=device-width' in text
    assert "<title>NarrowPassage · kgrl · constant" in text
    assert "@media (max-width: 700px)" in text
    assert "<script src=" not in text
    assert "<link" not in text


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
    watching = Motion(env)
    row = rollout(env, constant_policy(env, np.array([1.0, 0.0])), watching, seed=1_000_000, held_out=True)
    recorded, trace = watching.data(), env.unwrapped.trace
    assert len(recorded["times"]) <= 8
    assert recorded["times"][-1] == pytest.approx(len(trace) * trace.period)
    assert max(recorded["force"]) == pytest.approx(row["peak_force"], rel=1e-4)
    assert max(recorded["commanded"]) == pytest.approx(row["max_commanded_violation"], rel=1e-4)
    np.testing.assert_allclose(poses(recorded["frames"][BALL])[-1, :2], trace.measured[-1], atol=1e-6)
    env.close()


def test_motion_has_one_sample_when_no_control_step_was_done(tmp_path):
    env = make_environment("NarrowPassage", {"guidance": "kgrl"}, render_mode="human")
    env.unwrapped.simulator.set_target_realtime_rate(0.0)
    env.reset(seed=0)
    motion = Motion(env)
    env.reset(seed=1)
    motion.on_episode_start()
    recorded = motion.data()
    assert recorded["times"] == [0.0]
    assert poses(recorded["frames"][BALL]).shape == (1, 7)
    assert recorded["force"] is None
    env.close()


def test_page_of_a_task_folder_is_in_the_current_folder(tmp_path):
    assert default_page(tmp_path, {}) == tmp_path / "replay.html"
    (tmp_path / "task.yaml").touch()
    assert default_page(tmp_path, {"station": "arm"}) == Path("replay-arm.html")


def test_page_names_the_report_command_with_the_folder_of_the_run(tmp_path):
    run = tmp_path / "runs" / "passage"
    run.mkdir(parents=True)
    arguments = check_environment("NarrowPassage", ENVIRONMENT)
    spec = EpisodeSpec("NarrowPassage", arguments, _to_the_right, "to the right", "constant", run=run)
    write_page(run / "replay.html", spec, episodes=1)
    page = (run / "replay.html").read_text(encoding="utf-8")
    assert f"guiderail report {run} --out {run}/report.html" in page
    assert "largest constraint violation: commanded" in page


@pytest.mark.parametrize(
    ("constraints", "outputs", "unit"),
    [
        (LinearConstraints.box(-np.ones(2), np.ones(2)), 2, "mm"),
        (LinearConstraints.box(-np.array([1, 1, *[np.inf] * 4]), np.array([1, 1, *[np.inf] * 4])), 6, "mm"),
        (LinearConstraints.box(-np.ones(6), np.ones(6)), 6, "m or rad"),
        (None, 6, "m or rad"),
    ],
)
def test_violation_unit_is_that_of_the_bounded_outputs(constraints, outputs, unit):
    assert violation_unit(constraints, outputs)[0] == unit


def test_write_page_refuses_zero_episodes(tmp_path):
    shown = EpisodeSpec(
        "NarrowPassage", {}, lambda env: BaselinePolicy(uniform_random, env), "uniform_random", "uniform_random"
    )
    with pytest.raises(InputError, match="at least one episode"):
        write_page(tmp_path / "replay.html", shown, episodes=0)


@pytest.mark.parametrize("name", ["policy.safetensors", "."])
def test_write_page_refuses_another_ending_before_it_runs(name, tmp_path):
    (tmp_path / "policy.safetensors").write_text("weights")
    shown = EpisodeSpec(
        "NarrowPassage", {}, lambda env: pytest.fail("an episode is run"), "uniform_random", "uniform_random"
    )
    with pytest.raises(InputError, match="a page is"):
        write_page(tmp_path / name, shown)
    assert (tmp_path / "policy.safetensors").read_text() == "weights"
