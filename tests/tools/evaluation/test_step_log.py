import numpy as np
import pytest

from guiderail.models.common.errors import InputError
from guiderail.tools.environments import make_environment
from guiderail.tools.evaluation.metrics import TOLERANCE
from guiderail.tools.evaluation.rollout import rollout
from guiderail.tools.evaluation.step_log import MEANINGS, StepLog, read_step_log, remove_step_logs, step_log_file


def random_policy(env, seed):
    rng = np.random.default_rng(seed)
    return lambda observation: rng.uniform(-1, 1, env.action_space.shape)


@pytest.fixture(scope="module")
def logged(tmp_path_factory):
    folder = tmp_path_factory.mktemp("steps")
    env = make_environment("NarrowPassage", {"guidance": "kgrl", "action_repeat": 5})
    rows = [
        rollout(env, random_policy(env, index), StepLog(env, folder), index=index, seed=index) for index in range(2)
    ]
    trace = env.unwrapped.trace
    return folder, rows, trace


def test_step_log_has_every_step_and_agrees_with_the_rows(logged):
    folder, rows, trace = logged
    step_log = read_step_log(folder)
    assert [len(group) for _, group in step_log.groupby("episode")] == [row["steps"] for row in rows]
    for row, (_, steps) in zip(rows, step_log.groupby("episode"), strict=True):
        assert steps["step"].tolist() == list(range(row["steps"]))
        assert steps["commanded_violation"].max() == row["max_commanded_violation"] <= TOLERANCE
        assert steps["measured_violation"].max() == row["max_measured_violation"]
        assert steps["force"].max() == row["peak_force"]
        assert steps["collision"].sum() == row["collision_steps"]
        assert steps["fallback"].sum() == row["fallback_steps"]
        assert not steps["command_timed_out"].any()
        assert (steps["saturation"] > 0).sum() == row["saturated_steps"]
        assert steps["reward"].sum() == pytest.approx(row["return"])
    last = step_log[step_log["episode"] == 1]
    np.testing.assert_array_equal(last[["desired_pose_0", "desired_pose_1"]], trace.commanded)
    np.testing.assert_array_equal(last[["pose_0", "pose_1"]], trace.measured)
    # The restricted zone is x > 0.6 m.
    np.testing.assert_allclose(step_log["commanded_violation"], step_log["desired_pose_0"] - 0.6, atol=1e-12)


def test_every_step_log_column_has_a_meaning(logged):
    for name in read_step_log(logged[0]).columns:
        stem, _, end = name.rpartition("_")
        assert (f"{stem}_i" if end.isdigit() else name) in MEANINGS


def test_step_log_has_collisions_and_wrenches(tmp_path):
    env = make_environment("NarrowPassage", {"guidance": "residual", "action_repeat": 5})
    row = rollout(env, lambda observation: np.array([1.0, 0.0]), StepLog(env, tmp_path), seed=0)
    step_log = read_step_log(tmp_path)
    assert row["collision_steps"] == step_log["collision"].sum() > 0
    assert np.linalg.norm(step_log.loc[step_log["collision"], ["wrench_0", "wrench_1"]], axis=1).max() > 0


def test_removal_of_step_logs_leaves_other_files(tmp_path):
    files = [*(step_log_file(tmp_path, number) for number in range(3)), tmp_path / "episode-abc.parquet"]
    for file in files:
        file.touch()
    remove_step_logs(tmp_path, 2)
    assert [file.exists() for file in files] == [True, True, False, True]


def test_step_log_is_refused_when_absent_or_damaged(logged, tmp_path):
    with pytest.raises(InputError, match="has no step log"):
        read_step_log(tmp_path)
    step_log_file(tmp_path, 0).write_bytes(b"PAR1 and nothing else")
    with pytest.raises(InputError, match="damaged"):
        read_step_log(tmp_path)
