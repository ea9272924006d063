"""First commands at random starts over all orientations; `oracles.random_starts` has a command for thousands."""

import pytest

from oracles.random_starts import largest_jump


@pytest.mark.filterwarnings("ignore:without actions the primitive is")
def test_first_commands_are_slower_than_the_demonstrations():
    jump, seed, refused = largest_jump(range(60))
    assert jump < 1.0, seed
    assert refused < 6
