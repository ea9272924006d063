"""Options of all tasks: every declared range, and combinations that a task refuses."""

import pytest

from guiderail.diagrams.envs.config import EnvConfig, option_models
from guiderail.diagrams.envs.options import describe_options
from guiderail.models.common.errors import InputError

TASKS = ("BncConnector", "GridClamp", "NarrowPassage", "Pouring")
GUIDANCE = {"BncConnector": "skgrl", "GridClamp": "sct", "NarrowPassage": "skgrl", "Pouring": "sct"}
BEYOND = {"minimum": -1, "maximum": 1, "exclusiveMinimum": 0, "exclusiveMaximum": 0}
"""Amount by which a wrong value is beyond each kind of bound."""


def wrong_values():
    """Yield a task, an option and a value beyond a bound of the option, for every bound."""
    for name in TASKS:
        config = EnvConfig.resolve(name, {})
        for model in option_models(type(config.declared), GUIDANCE[name], config.station).values():
            for row in describe_options(model):
                yield from ((name, row["name"], row[key] + more) for key, more in BEYOND.items() if key in row)


@pytest.mark.parametrize(("task", "option", "value"), [*wrong_values()])
def test_option_is_refused_when_out_of_range(task, option, value):
    with pytest.raises(InputError, match=f"^{option.replace('.', '[.]')} must be "):
        EnvConfig.resolve(task, {"guidance": GUIDANCE[task], option: value})


@pytest.mark.parametrize(
    ("task", "options", "message"),
    [
        ("BncConnector", {"offset_range": (0.003, 0.001)}, "offset_range cannot be .*the smaller one first"),
        ("BncConnector", {"offset_range": (0.0, 0.002), "fixture_offset": "none"}, "choose fixture_offset=per_episode"),
        ("BncConnector", {"demonstrations": "none.npz"}, "or the path of an existing file"),
        ("BncConnector", {"force_limit_range": (30.0, 20.0)}, "force_limit_range cannot be"),
        ("BncConnector", {"sensing": "perfect"}, "there is no sensing 'perfect'"),
        ("BncConnector", {"sensing.calibration_error": (1.0, 0.0)}, "an error in meters and one in radians"),
        ("BncConnector", {"disturbances.friction_factor": (2.0, 1.0)}, "the smaller one first"),
        ("BncConnector", {"offset_range": (0.002, 0.001)}, "offset_range cannot be .*the smaller one first"),
        ("GridClamp", {"reward": "dense"}, "there is no reward 'dense'"),
        ("NarrowPassage", {"obstacles_constrain": True, "second_obstacle": True}, "needs a single fixed obstacle"),
        ("NarrowPassage", {"observation": "images"}, "there is no observation 'images': did you mean image"),
        ("NarrowPassage", {"bored": 1}, "NarrowPassage has no option 'bored'"),
        ("Pouring", {"shield": True}, "the option shield needs the option aim"),
        ("Pouring", {"balls_in": 3}, "balls_in must be at most balls, which is 2"),
        ("Pouring", {"balls": 8, "ball_diameter": 0.045}, "do not fit into the thermos"),
        ("Pouring", {"mug_error_least": 0.05}, "mug_error_least must be at most mug_error_most"),
    ],
)
def test_options_are_refused_when_incompatible(task, options, message):
    with pytest.raises(InputError, match=message):
        EnvConfig.resolve(task, options)
