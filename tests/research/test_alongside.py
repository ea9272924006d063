"""Training of a student alongside its teacher: equivalent task-space actions, and the comparison of variants."""

import numpy as np
import pandas as pd
import pytest

import research.alongside as alongside
from guiderail.models.common.errors import InputError
from guiderail.tools.environments import make_environment
from guiderail.tools.evaluation.rollout import rollout
from guiderail.tools.tables import write_table


class RecordingStudent:
    """Stub of a student that records its transitions."""

    def __init__(self):
        self.transitions, self.episodes = [], 0

    def actor(self):
        return None

    def start_recorded(self, is_greedy, actor):
        self.episodes += 1

    def on_step(self, transition):
        self.transitions.append(transition)


def test_equivalent_actions_command_nearly_the_same_poses():
    """Equivalent actions in the student's environment command nearly the same poses as the teacher's actions."""
    coarse = {"time_step": 0.01}  # only commands are compared
    teacher, student = (
        make_environment(alongside.TASK, env | coarse) for env in (alongside.TEACHER, alongside.STUDENT)
    )
    recorder = RecordingStudent()
    callback = alongside.TaskSpaceTransitions(teacher, recorder, alongside.STUDENT)
    rollout(teacher, lambda observation: np.array([0.6, -0.3], np.float32), callback, seed=3)
    teacher_poses = teacher.unwrapped.trace.commanded.copy()
    assert recorder.episodes == 1
    assert recorder.transitions[-1].is_last
    actions = iter([transition.action for transition in recorder.transitions])
    rollout(student, lambda observation: next(actions, np.zeros(2, np.float32)), seed=3)
    student_poses = student.unwrapped.trace.commanded[: len(teacher_poses)]
    size = min(len(teacher_poses), len(student_poses))
    # During an action, the displacement changes for the teacher and is constant for the student.
    np.testing.assert_allclose(student_poses[:size, :2], teacher_poses[:size, :2], atol=2.5e-4)  # [m]
    np.testing.assert_allclose(student_poses[:size, 2:], teacher_poses[:size, 2:], atol=2e-2)


@pytest.fixture
def evaluated(monkeypatch):
    """Replace training and evaluation; return the list of evaluated variants and numbers of episodes."""
    evaluated = []

    def evaluate(out, variant, episodes, seed, run_seed):
        evaluated.append((variant, episodes))
        columns = ("peak_force", "jerk_commanded_linear", "max_commanded_violation")
        return pd.DataFrame([{"success": 1, **dict.fromkeys(columns, 1.0)}] * episodes)

    def train(out, episodes, refinement, seed):
        acting = ["teacher"] * episodes + ["student"] * refinement
        write_table(out / "training", [{"seed": seed, "acting": name} for name in acting])

    monkeypatch.setattr(alongside, "evaluate_variant", evaluate)
    monkeypatch.setattr(alongside, "train_both", train)
    monkeypatch.setattr(alongside, "times_per_action", lambda out: {"teacher": 1.0})
    return evaluated


def test_comparison_has_a_row_per_variant_and_stores_blocks(tmp_path, evaluated):
    for _ in range(2):
        rows = alongside.compare(tmp_path / "out", episodes=11)
        assert [row["variant"] for row in rows] == list(alongside.VARIANTS)
        assert len(evaluated) == 2 * len(alongside.VARIANTS)
    with pytest.raises(InputError, match="at least one"):
        alongside.compare(tmp_path / "out", episodes=0)


@pytest.mark.parametrize("change", [{"seed": 1}, {"training": 3}, {"refinement": 2}])
def test_comparison_is_refused_when_other_training_is_stored(change, tmp_path, evaluated):
    arguments = {"episodes": 1, "training": 2, "refinement": 1, "seed": 0}
    alongside.compare(tmp_path, **arguments)
    with pytest.raises(InputError, match="--seed, --training and --refinement, or another --out"):
        alongside.compare(tmp_path, **arguments | change)
    assert len(evaluated) == len(alongside.VARIANTS)
