"""Guard of chunks in LeRobot's pipelines; run by `make lerobot`."""

import numpy as np
import pytest
import torch
from lerobot.policies.factory import make_pre_post_processors
from lerobot.processor import PolicyProcessorPipeline, ProcessorStepRegistry, RobotProcessorPipeline
from lerobot.processor.converters import (
    policy_action_to_transition,
    robot_action_observation_to_transition,
    transition_to_policy_action,
    transition_to_robot_action,
)
from lerobot.utils.import_utils import register_third_party_plugins
from lerobot_robot_guiderail.export import export
from lerobot_robot_guiderail.guard import ChunkGuardProcessorStep, add_guard
from test_plugin import write_policy

PERIOD, VELOCITY, JERK, BOUND = 0.1, 0.5, 5.0, 0.2
LIMITS = {
    "lower": [-BOUND, -BOUND, None],
    "upper": [BOUND, BOUND, None],
    "velocity": [VELOCITY] * 3,
    "jerk": [JERK] * 3,
    "period": PERIOD,
}
START = [0.0, 0.0, 0.0]


def check(actions):
    motion = np.concatenate([np.zeros((3, 3)), actions])
    assert np.abs(np.diff(motion, axis=0)).max() <= VELOCITY * PERIOD * (1 + 1e-5)
    assert np.abs(np.diff(motion, n=3, axis=0)).max() <= JERK * PERIOD**3 * (1 + 1e-4)
    assert np.abs(motion[:, :2]).max() <= BOUND * (1 + 1e-6)
    assert np.ptp(actions, axis=0).min() > 0.05


def pipeline():
    return PolicyProcessorPipeline(
        steps=[ChunkGuardProcessorStep(**LIMITS, start=START)],
        to_transition=policy_action_to_transition,
        to_output=transition_to_policy_action,
    )


def test_step_is_registered_by_the_plugin():
    register_third_party_plugins()
    assert ProcessorStepRegistry.get("guiderail_chunk_guard") is ChunkGuardProcessorStep


@pytest.mark.parametrize("shape", [(1, 3), (1, 8, 3)])
def test_actions_of_a_policy_are_within_the_limits(shape):
    guarded, random = pipeline(), np.random.default_rng(0)
    sent = [guarded(torch.from_numpy(random.uniform(-0.5, 0.5, shape).astype("f4"))) for _ in range(40)]
    assert all(action.shape == shape and action.dtype == torch.float32 for action in sent)
    check(torch.cat(sent).reshape(-1, 3).numpy().astype(float))


def test_actions_by_name_start_at_the_observed_position():
    names = ["a.pos", "b.pos", "c.pos"]
    guarded = RobotProcessorPipeline(
        steps=[ChunkGuardProcessorStep(**LIMITS, names=names)],
        to_transition=robot_action_observation_to_transition,
        to_output=transition_to_robot_action,
    )
    observed = dict.fromkeys(names, 0.1)
    assert guarded((dict.fromkeys(names, 0.1), observed)) == pytest.approx(observed, abs=1e-4)
    moved = guarded((dict.fromkeys(names, 0.2), observed))
    assert all(0.1 < value < 0.12 for value in moved.values())


def test_guard_of_a_stored_policy_is_applied_after_loading(tmp_path):
    write_policy(tmp_path / "run", [7, 16, 3])
    export(tmp_path / "run", tmp_path / "out")
    add_guard(tmp_path / "out", **LIMITS, start=START)
    policy = export(tmp_path / "run", tmp_path / "other")
    _, after = make_pre_post_processors(policy.config, pretrained_path=str(tmp_path / "out"))
    sent = [after(torch.full((1, 3), 0.4)) for _ in range(20)]
    check(torch.cat(sent).numpy().astype(float))
    second = torch.cat(sent)[0]
    after.reset()
    assert (after(torch.full((1, 3), 0.4))[0] == second).all()
