import numpy as np
import pytest
import torch

from guiderail.models.common.errors import InputError
from guiderail.tools.learning.checkpoint import CheckpointSelection, load_checkpoint, save_checkpoint


@pytest.fixture
def checkpoint(tmp_path):
    path = tmp_path / "checkpoint" / "state.safetensors"
    arrays = {"weights": np.arange(6, dtype=np.float32).reshape(2, 3), "empty": np.zeros((0, 4))}
    save_checkpoint(path, arrays, {"episodes": 3, "big": 2**100})
    return path


def test_checkpoint_is_read_as_written(checkpoint):
    arrays, values = load_checkpoint(checkpoint)
    np.testing.assert_array_equal(arrays["weights"], [[0, 1, 2], [3, 4, 5]])
    assert arrays["weights"].dtype == np.float32
    assert arrays["empty"].shape == (0, 4)
    assert values == {"episodes": 3, "big": 2**100}


@pytest.mark.parametrize("num_bytes", [0, 7, 100, -1])
def test_load_checkpoint_refuses_a_truncated_file(checkpoint, num_bytes):
    checkpoint.write_bytes(checkpoint.read_bytes()[:num_bytes])
    with pytest.raises(InputError, match="damaged"):
        load_checkpoint(checkpoint)


def test_load_checkpoint_refuses_a_flipped_bit(checkpoint):
    content = bytearray(checkpoint.read_bytes())
    content[-2] ^= 1
    checkpoint.write_bytes(bytes(content))
    with pytest.raises(InputError, match="damaged"):
        load_checkpoint(checkpoint)


def run_greedy_episodes(selection, outcomes, first=0, num_successes=0):
    """Run greedy episodes with these outcomes; the weight of each actor is the number of its episode."""
    for number, success in enumerate(outcomes, first):
        actor = torch.nn.Linear(1, 1)
        torch.nn.init.constant_(actor.weight, number)
        selection.begin(actor, num_successes)
        selection.finish(success)
        num_successes = num_successes + 1 if success else 0
    return selection


def selected_episode(selection):
    """Return the number of the episode whose actor is selected_episode, or None."""
    result = selection.result()
    return None if result is None else int(result["weight"])


def test_selection_is_empty_without_successes_on_both_sides():
    assert selected_episode(run_greedy_episodes(CheckpointSelection(3), [1])) is None
    assert selected_episode(run_greedy_episodes(CheckpointSelection(3), [0, 1, 0, 1, 0])) is None
    assert selected_episode(run_greedy_episodes(CheckpointSelection(3), [0, 1, 1])) == 2


def test_selection_is_the_middle_of_the_longest_streak():
    # The longest streaks are the episodes 1 to 6, and 4 to 8; the later of two middle episodes is selected.
    assert selected_episode(run_greedy_episodes(CheckpointSelection(5), [0, 1, 1, 1, 1, 1, 1, 0, 0, 1, 1, 1])) == 4
    assert selected_episode(run_greedy_episodes(CheckpointSelection(5), [0, 1, 1, 0, 1, 1, 1, 1, 1])) == 7


def test_selection_is_in_the_longest_streak_also_if_earlier():
    # Episode 9 is followed by six successes, but preceded by a failure.
    assert selected_episode(run_greedy_episodes(CheckpointSelection(6), [1] * 8 + [0] + [1] * 6)) == 4


def test_selection_is_the_latest_when_streaks_exceed_the_window():
    assert selected_episode(run_greedy_episodes(CheckpointSelection(2), [1] * 9)) == 7
    assert selected_episode(run_greedy_episodes(CheckpointSelection(2), [1] * 9 + [0])) == 7


def test_selection_continues_when_restored():
    first = run_greedy_episodes(CheckpointSelection(3), [0, 1, 1, 0, 1])
    second = CheckpointSelection(3)
    second.restore(*first.state())
    for selection in (first, second):
        run_greedy_episodes(selection, [1, 1, 1, 1, 1], first=5, num_successes=1)
    assert selected_episode(first) == selected_episode(second) == 7
    assert first.state()[1] == second.state()[1]


def test_selection_ignores_an_excluded_episode():
    plain, excluded = (run_greedy_episodes(CheckpointSelection(3), outcomes) for outcomes in ([0, 1, 1], [0, 1]))
    excluded.begin(torch.nn.Linear(1, 1), 1)
    excluded.exclude()
    run_greedy_episodes(excluded, [1], first=2, num_successes=1)
    assert selected_episode(excluded) == selected_episode(plain) == 2
    assert excluded.state()[1] == plain.state()[1]
