"""Human-in-the-loop training: corrections, labels and stops, and their record in the run folder."""

from types import SimpleNamespace

import numpy as np
import pytest

from guiderail.models.common.errors import InputError
from guiderail.models.policy import FORMAT, Policy
from guiderail.models.primitives import ReferenceTrajectory, SquaredExponential
from guiderail.models.primitives.reference import pass_through
from guiderail.tools.evaluation.episode import Transition
from guiderail.tools.learning.learner import LEARNERS, Learner
from guiderail.tools.learning.run_folder import RunFolder, configure
from guiderail.tools.learning.trainer import run_training
from guiderail_hardware.teleop.interventions import (
    LABEL_REWARDS,
    VIA_POINT_SPACING,
    InterventionPolicy,
    SupervisedTraining,
    Supervisor,
    ViaPointCorrections,
)


class ZeroLearner(Learner):
    """Learner that records transitions and always returns the action zero."""

    def __init__(self, preset, env, **_):
        self.env, self.transitions = env, []
        learners.append(self)

    def act(self, observation):
        return np.zeros(self.env.action_space.shape, np.float32)

    def on_step(self, transition):
        self.transitions.append(transition)

    def policy(self, description):
        space = self.env.action_space
        size = space.shape[0]
        layer = np.zeros((size, self.env.observation_space.shape[0]), np.float32), np.zeros(size, np.float32)
        limits = {"action_low": space.low.tolist(), "action_high": space.high.tolist()}
        return Policy([layer], {"format": FORMAT, "squash": "tanh", **limits, **description})

    def has_diverged(self):
        return False

    def state(self):
        return {}, {}

    def restore(self, arrays, values):
        pass


learners = []


@pytest.fixture(autouse=True)
def zero_learner():
    LEARNERS.register("zero", ZeroLearner)
    yield
    learners.clear()
    del LEARNERS._entries["zero"]


class ScriptedSupervisor(Supervisor):
    """Supervisor with corrections (first step, last step, offset) and labels (step, label) by episode."""

    def __init__(self, corrections, labels=None):
        self.corrections, self.labels, self.episode = corrections, labels or {}, -1

    def on_episode_start(self, env):
        self.episode += 1
        self.env = env.unwrapped

    def correction(self, observation):
        first, last, offset = self.corrections.get(self.episode, (1, 0, None))
        return np.array(offset) if first <= self.env._control_steps <= last else None

    def label(self):
        step, label = self.labels.get(self.episode, (None, None))
        return label if step is not None and self.env._control_steps >= step else None


def passage(episodes, **environment):
    return configure(
        "NarrowPassage", {"guidance": "kgrl", "action_repeat": 2, **environment}, algorithm="zero", episodes=episodes,
        human_in_the_loop=True, step_log=False,
    )  # fmt: skip


def by(supervisor):
    """Return the start of episodes that a supervisor corrects."""
    return lambda config: SupervisedTraining(config, supervisor)


def test_correction_becomes_transitions_and_via_points(tmp_path):
    folder = RunFolder(tmp_path / "run")
    rows = run_training(folder, passage(2), supervise=by(ScriptedSupervisor({0: (10, 19, [0.5, 3.0])})))
    assert [row["interventions"] for row in rows] == [1, 0]
    actions = np.array([transition.action for transition in learners[0].transitions])
    is_corrected = (actions != 0).any(axis=1)
    np.testing.assert_array_equal(actions[is_corrected], np.tile([0.5, 1.0], (is_corrected.sum(), 1)))  # clipped to 1
    # Actions 5 to 9 are the control steps 10 to 19.
    np.testing.assert_array_equal(np.flatnonzero(is_corrected), [5, 6, 7, 8, 9])
    config = folder.config()
    assert config.human_in_the_loop
    points = np.reshape(config.environment["via_points"], (-1, 3))
    np.testing.assert_array_equal(points[:, 0], [11, 17, 19])
    corrections = ViaPointCorrections("NarrowPassage", {"guidance": "kgrl"})
    reference = corrections._reference.means[points[:, 0].astype(int)]
    expected = reference + np.array([0.5, 3.0]) * corrections.reach
    assert (np.abs(points[:, 1:] - expected).min(axis=0) < 1e-9).all()  # the constraints reduce some offsets
    assert max(row["max_commanded_violation"] for row in rows) <= 1e-9


def test_via_points_change_the_reference_locally():
    t = 0.02 * np.arange(400)
    reference = ReferenceTrajectory(t, np.column_stack([np.sin(t), t]), np.tile(0.01 * np.eye(2), (400, 1, 1)))
    points = [200, 1.5, 3.9, 205, 1.5, 4.0]
    moved = pass_through(reference, points, SquaredExponential(0.5))
    np.testing.assert_allclose(moved.means[[200, 205]], [[1.5, 3.9], [1.5, 4.0]], atol=2e-2)
    np.testing.assert_allclose(moved.means[[0, 399]], reference.means[[0, 399]], atol=1e-6)
    np.testing.assert_array_equal(moved.covariances, reference.covariances)
    for invalid in ([1.0, 2.0], [0.5, 0.0, 0.0], [400, 0.0, 0.0], [3, np.nan, 0.0]):
        with pytest.raises(InputError, match="via-point"):
            pass_through(reference, invalid, SquaredExponential(0.5))


def test_held_correction_applies_to_the_rest_of_the_motion():
    corrections = ViaPointCorrections("NarrowPassage", {"guidance": "kgrl"})
    last = corrections._reference.num_steps - 1
    points = np.reshape(corrections.with_offsets({20: np.array([0.1, 0.0])}, is_held=True), (-1, 3))
    assert (points[0, 0], points[-1, 0]) == (20, last)
    assert np.diff(points[:-1, 0]).max() <= VIA_POINT_SPACING
    corrections.points = tuple(points.ravel())
    updated = np.reshape(corrections.with_offsets({20: np.array([-0.1, 0.0]), 30: np.array([-0.1, 0.0])}), (-1, 3))
    assert sum(updated[:, 0] <= 30) == 2
    assert (updated[updated[:, 0] > 34] == points[points[:, 0] > 34]).all()


def test_correction_of_a_failed_first_step_is_no_via_point():
    """A failed step has a via-point only if a control step was completed before the failure."""
    corrections, observation = ViaPointCorrections("NarrowPassage", {"guidance": "kgrl"}), np.zeros(2, np.float32)
    supervisor = ScriptedSupervisor({0: (0, 400, [0.5, 0.5])})
    env = SimpleNamespace(unwrapped=SimpleNamespace(_control_steps=0))
    policy = InterventionPolicy(env, supervisor, lambda observation: observation, corrections)
    for control_steps, num_points in ((0, 0), (1, 1)):
        policy.on_episode_start()
        supervisor.episode = 0
        info = {"control_steps": control_steps, "simulation_failure": "diverged"}
        policy.on_step(Transition(observation, policy(observation), 0.0, observation, False, True, info))
        assert len(policy._offsets) == num_points
        assert min(policy.via_points[::3], default=0.0) >= 0.0


@pytest.mark.parametrize("offset", [[np.nan, 0.0], [0.5], 0.5, [[0.5, 0.5]], ["a", "b"]])
def test_correction_is_refused_without_an_offset_per_action(offset):
    corrections, env = ViaPointCorrections("NarrowPassage", {"guidance": "kgrl"}), SimpleNamespace(unwrapped=None)
    supervisor = SimpleNamespace(correction=lambda observation: np.array(offset))
    with pytest.raises(InputError, match="a correction"):
        InterventionPolicy(env, supervisor, lambda observation: observation, corrections)(np.zeros(2))


def test_label_ends_the_episode_and_changes_the_reward(tmp_path):
    labels = {0: (10, "success"), 1: (10, "failure"), 2: (10, "stop")}
    rows = run_training(RunFolder(tmp_path / "run"), passage(3), supervise=by(ScriptedSupervisor({}, labels)))
    assert [row["termination"] for row in rows] == ["success", "failure", "stop"]
    assert [row["success"] for row in rows] == [1, 0, 0]
    last = [transition for transition in learners[0].transitions if transition.is_last]
    assert [transition.terminated for transition in last] == [True, True, False]
    unlabeled = last[2].reward
    np.testing.assert_allclose(
        [transition.reward - unlabeled for transition in last],
        [LABEL_REWARDS["success"], LABEL_REWARDS["failure"], 0.0],
        atol=5.0,
    )


def test_supervised_run_resumes_with_its_corrections(tmp_path):
    corrections = {0: (10, 19, [0.5, 3.0]), 2: (4, 8, [-1.0, 0.0])}
    whole, folder = RunFolder(tmp_path / "whole"), RunFolder(tmp_path / "parts")
    rows = run_training(whole, passage(3), supervise=by(ScriptedSupervisor(corrections)))
    run_training(folder, passage(2), supervise=by(ScriptedSupervisor(corrections)))
    remaining = ScriptedSupervisor({episode - 2: correction for episode, correction in corrections.items()})
    resumed = run_training(folder, passage(3), resume=True, supervise=by(remaining))
    assert [row | {"wall_time": 0} for row in resumed] == [row | {"wall_time": 0} for row in rows]
    assert folder.config().environment == whole.config().environment
    with pytest.raises(InputError, match="--human-in-the-loop"):
        run_training(folder, folder.config(), resume=True)


def test_corrections_are_refused_without_demonstrations():
    with pytest.raises(InputError, match="has no demonstrations to correct"):
        ViaPointCorrections("Pouring", {})


def test_corrections_compensate_demonstrations_5_mm_off(tmp_path):
    """The reference leads 5 mm past the jack; after corrections in the first episode, the second succeeds."""
    environment = {"guidance": "kgrl", "fixture_offset": "none", "bound": 6e-3, "action_repeat": 10}
    environment["time_step"] = 0.01  # twice the default
    environment["action_dims"] = (0, 1)
    corrections = ViaPointCorrections("BncConnector", environment)
    steps = np.arange(0, corrections._reference.num_steps, VIA_POINT_SPACING)
    displaced = np.column_stack([steps, corrections._reference.means[steps]])
    displaced[:, 1] += 5e-3
    environment["via_points"] = tuple(displaced.ravel())
    offset = [-5e-3 / corrections.reach[0], 0.0]
    config = configure(
        "BncConnector", environment, algorithm="zero", episodes=2, human_in_the_loop=True, step_log=False
    )
    rows = run_training(RunFolder(tmp_path / "run"), config, supervise=by(ScriptedSupervisor({0: (0, 10**6, offset)})))
    assert [row["success"] for row in rows] == [0, 1]
    assert sum(row["interventions"] for row in rows) <= 5
    assert max(row["max_commanded_violation"] for row in rows) <= 1e-9


def returns(value):
    """Return a method that returns a value."""
    return lambda self, *arguments, **keywords: value


def on_episode_end(*columns):
    return {"on_episode_end": lambda self, row: columns[row["episode"]]}


def activation_no(self, description):
    return ZeroLearner.policy(self, {**description, "activation": "no"})


FAILURE = r"failed: test_interventions\.py, line \d+: ZeroDivisionError"
# Methods of a learner, and what its refusal says.
INVALID = {
    "column of another": (on_episode_end({"return": 0.0}), "returns the column 'return', which"),
    "text": (on_episode_end({"word": "good"}), "the column 'word' of an episode must be a number, not 'good'"),
    "other column": (on_episode_end({"a": 1}, {"b": 1}), "the column 'a' is missing in some episodes"),
    "no policy": ({"policy": returns(None)}, "Invalid.policy must return a Policy, not None"),
    "wrong policy": ({"policy": activation_no}, "Invalid.policy failed: a policy has no activation 'no'"),
    "array of texts": (
        {"state": returns(({"words": np.array(["a"])}, {}))},
        "the array 'words' of Invalid.state has no numbers",
    ),
    "array as value": (
        {"state": returns(({}, {"mean": np.zeros(2)}))},
        "the values of Invalid.state must be values of JSON: Object of type ndarray",
    ),
    "tuple": (
        {"state": returns(({}, {"a": [{"b": (1, 2)}]}))},
        r"the values of Invalid.state must not contain the tuple \(1, 2\), because JSON",
    ),
    "number as key": (
        {"state": returns(({}, {"a": {3: 4}}))},
        "the values of Invalid.state must not contain the key 3, because JSON changes it",
    ),
    "failing constructor": ({"__init__": lambda *_, **__: 1 / 0}, f"constructing the learner Invalid {FAILURE}"),
    "failing method": ({"act": lambda *_: 1 / 0}, rf"Invalid\.act {FAILURE}: division by zero"),
}


@pytest.mark.parametrize("name", INVALID)
def test_invalid_learner_is_named(name, tmp_path):
    methods, message = INVALID[name]
    LEARNERS.register("invalid")(type("Invalid", (ZeroLearner,), methods))
    config = configure("Bead", {}, algorithm="invalid", episodes=2 if name == "other column" else 1, seed=1)
    try:
        with pytest.raises(InputError, match=message):
            run_training(RunFolder(tmp_path / "run"), config)
    finally:
        del LEARNERS._entries["invalid"]


@pytest.mark.parametrize(
    ("name", "learner", "message"),
    [
        ("invalid", type("Other", (), {}), "Config of invalid must be a pydantic dataclass"),
        ("Bad Name/..", ZeroLearner, "the name of a learner has letters, digits, '_', '-' and '.', unlike 'Bad Name"),
    ],
)
def test_learner_that_cannot_be_constructed_is_refused(name, learner, message):
    with pytest.raises(InputError, match=message):
        LEARNERS.register(name)(learner)
    assert name not in LEARNERS.names()
