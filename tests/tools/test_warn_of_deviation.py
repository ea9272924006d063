"""Warning about a primitive whose motion without actions deviates from the demonstrations."""

import pytest

from guiderail.diagrams.envs.config import EnvConfig
from guiderail.tools.environments import warn_of_deviation


@pytest.mark.parametrize(
    ("task", "options", "is_warned"),
    [
        ("NarrowPassage", {}, False),
        ("NarrowPassage", {"lambda_": 1e4, "beta": 1e4}, True),
        ("NarrowPassage", {"length_scale": 50.0}, True),
        ("Pouring", {}, False),
    ],
)
def test_deviation_from_demonstrations_causes_a_warning(task, options, is_warned, caplog):
    warn_of_deviation(EnvConfig.resolve(task, options))
    assert ("dataset validate FILE --fit" in caplog.text) is is_warned
