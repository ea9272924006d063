"""Description of the differences between a configuration and the thesis."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from guiderail.diagrams.envs.config import option_models, prior_of, stations_of
from guiderail.diagrams.envs.options import choices_of, option_fields
from guiderail.diagrams.guidance.registry import possible_guidance
from guiderail.diagrams.stations.disturbances import Disturbances
from guiderail.diagrams.tasks.registry import TASKS
from guiderail.tools.learning.run_folder import configure
from guiderail_lerobot.base_policy import BASE_POLICIES
from research.thesis import HISTORY, NEUTRAL, THESIS, describe_differences


def differences_of(task, environment=None, **given):
    """Return the described differences of a configuration from the thesis."""
    return describe_differences(configure(task, environment or {}, **given))


def test_thesis_options_exist_and_accept_the_thesis_values():
    for task, setting in THESIS.items():
        known = configure(task, {}).environment
        for name, values in setting.options.items():
            assert name in known, f"{task} has no option {name}"
            for value in values:
                assert configure(task, {name: value}).environment[name] == value


def test_thesis_has_every_shipped_task(bead_config):
    assert {name for name in TASKS.names() if TASKS.get(name).__module__.startswith("guiderail.")} == set(THESIS)
    assert describe_differences(bead_config) == ["it has no task Bead"]


AS_PRINTED = {
    "guidance": "skgrl", "reward": "sparse", "action_repeat": 1, "action_dims": None, "history.variance": 1e-8,
    "history.source": "measured", "fixture_offset": "per_run", "station": "arm",
}  # fmt: skip


def test_printed_connector_settings_differ_in_remarks_only():
    remarks = differences_of("BncConnector", AS_PRINTED, algorithm="tqc", preset="table_4_1_robot")
    assert all("thesis: " in remark for remark in remarks)
    assert not any(remark.startswith(("control steps", "ρ", "learning rate", "gamma", "station")) for remark in remarks)
    assert any(remark.startswith("simulated") for remark in remarks)
    environment = configure("BncConnector", AS_PRINTED).environment
    assert len(remarks) == sum(applies(environment) for _, applies in THESIS["BncConnector"].remarks)


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"reward": "shaped"}, "reward shaped (thesis: sparse)"),
        ({"action_repeat": 10}, "control steps of an action 10 (thesis: 1)"),
        ({"action_dims": (0, 1)}, "action dims 0, 1 (thesis: all)"),
        ({"history.variance": 1e-11}, "ρ = 1e-11 (thesis: 1e-08)"),
        ({"history.source": "commanded"}, "history of poses: commanded (thesis: measured)"),
        ({"fixture_offset": "per_episode"}, "fixture offset per_episode (thesis: per_run)"),
        ({"station": "gantry"}, "station gantry (thesis: arm)"),
    ],
)
def test_option_difference_is_described_with_both_values(changed, words):
    before = differences_of("BncConnector", AS_PRINTED, algorithm="tqc", preset="table_4_1_robot")
    after = differences_of("BncConnector", AS_PRINTED | changed, algorithm="tqc", preset="table_4_1_robot")
    assert set(after) - set(before) == {words}


OTHER_VALUES = {
    "offset_range": (0.0, 0.001), "action_dims": (0,), "gains": (1.0, 1.0),
    "via_points": (10, 0.3, 0.3), "balls_in": 1, "balls": 3, "active_constraints": False, "input_speed": 1.5,
    "time_step": 0.005, "engine_step": 0.0005, "control_period": 0.1, "disturbances.clock_factor": 2.0,
    "robot": "other.urdf", "end_effector": "other", "robot_url": "udpm://",
    "mug_error_least": 0.01, "mug_inner_diameter": 0.09, "mug_depth": 0.1, "demonstrations": "search",
    "force_limit_range": (12.0, 12.0), "sensing.wrench_scale": (0.5, 2.0),
    "sensing.wrench_bias": (1.0, 0.1), "sensing.wrench_noise": (1.0, 0.1),
    "sensing.wrench_delay": 3, "sensing.calibration_error": (0.001, 0.01), "sensing.tare": True,
    "max_speed": (0.1,), "max_acceleration": (1.0,), "joint_margin": 0.1,
    "progress": "state", "base_policy": "other", "base_policy.guard": "none",
    "base_policy.max_jerk": (100.0,), "num_demonstrations": 1, "prior_std": (0.001, 0.001, 0.001, 0.01, 0.01, 0.01),
    "pour_distance": 0.09,
}  # fmt: skip
# Options without which the value in `OTHER_VALUES` is refused.
FURTHER_OPTIONS = {
    "balls": {"ball_diameter": 0.026},
    "mug_error_least": {"mug_error_most": 0.02},
    "shield": {"aim": True},
}


def other_value(task, name, field, default):
    """Return a value that equals neither the default nor, if the default has the thesis's value, a value of the thesis.

    None is returned if there is no such value.
    """
    if name in OTHER_VALUES:
        return OTHER_VALUES[name]
    thesis_values = THESIS[task].options.get(name, (default,))
    excluded = thesis_values if default in thesis_values else (default,)
    choices = {name: choices_of(TASKS.get(task), name) for name in ("reward", "observation")} | {
        "difficulty": ("hard",)
    }
    choices["history.source"], choices["impedance_control"] = ("commanded", "measured"), ("joint", "cartesian")
    choices["fixture_offset"] = ("per_run", "per_episode", "none")
    choices["kernel"], choices["sensing"] = ("squared_exponential", "matern52"), ("exact", "robot")
    if isinstance(default, bool):
        values = (True, False)
    elif name in choices:
        values = choices[name]
    elif isinstance(default, tuple):
        values = (tuple(1.0 + number for number in default), tuple(0.5 * number for number in default))
        values = tuple((min(numbers), max(numbers)) for numbers in values)
    elif isinstance(default, int):
        values = (1, 2, 3)
    else:
        limits = [getattr(constraint, bound, None) for constraint in field.metadata for bound in ("le", "ge")]
        values = (*(limit for limit in limits if limit is not None), 0.5 * default, 0.25)
    return next((value for value in values if value not in excluded), None)


def all_options():
    """Yield every option of every task, guidance and station."""
    for task in THESIS:
        declared = TASKS.get(task)
        for guidance in possible_guidance(prior_of(declared).provides):
            for station in stations_of(declared):
                for model in option_models(declared, guidance, station).values():
                    for name, field in option_fields(model).items():
                        yield task, guidance, station, name, model.model_fields[field]


@cache
def default_and_its_differences(task, guidance, station):
    """Return the default configuration of a guidance and a station, and its described differences."""
    config = configure(task, {"guidance": guidance, "station": station})
    return config, set(describe_differences(config, learns=False))


def test_every_non_default_option_is_described_unless_neutral(monkeypatch):
    monkeypatch.setattr(BASE_POLICIES, "_entries", {})
    monkeypatch.setattr(BASE_POLICIES, "_origins", {})
    BASE_POLICIES.register("other", lambda observation: np.zeros((1, 2, 6)))
    checked = set()
    for task, guidance, station, name, field in all_options():
        is_skipped = name in (*NEUTRAL, "station") or (name in HISTORY and guidance != "skgrl")
        if is_skipped or (task, name) in checked or (task, name) == ("Pouring", "reward"):
            continue
        default, before = default_and_its_differences(task, guidance, station)
        value = other_value(task, name, field, default.environment[name])
        if value is None:
            assert name in ("reward", "observation"), f"add a non-default value of {name} here"
            continue
        options = {"guidance": guidance, "station": station}
        if further := FURTHER_OPTIONS.get(name):
            options |= further
            before = set(describe_differences(configure(task, options), learns=False))
        after = set(describe_differences(configure(task, options | {name: value}), learns=False))
        assert before != after, f"{task}, {guidance}: {name}"
        checked.add((task, name))
    assert {name for task, name in checked if task == "BncConnector"} >= set(option_fields(Disturbances))


@pytest.mark.parametrize(
    ("task", "given", "words"),
    [
        ("BncConnector", {"bound": 0.006}, "bound 0.006 (thesis: 0.002)"),
        ("BncConnector", {"offset_range": (0.0, 0.0)}, "offset range 0, 0 (default: unset)"),
        ("BncConnector", {"sensing.wrench_noise": (5.0, 0.5)}, "wrench noise 5, 0.5 (default: unset)"),
        ("BncConnector", {"difficulty": "hard", "force_limit": 35.0}, "force limit 35 (default: 20)"),
        ("Pouring", {"active_constraints": False}, "active constraints no (thesis: yes)"),
        ("Pouring", {"guidance": "none", "active_constraints": True}, "active constraints yes (default: unset)"),
        ("NarrowPassage", {"second_obstacle": True}, "second obstacle yes (default: no)"),
    ],
)
def test_non_default_option_is_described_with_its_default(task, given, words):
    assert words in differences_of(task, given)


@pytest.mark.parametrize("task", THESIS)
def test_difficulty_is_described_once(task):
    remarks = differences_of(task, {"difficulty": "hard"})
    assert sum("difficulty" in remark for remark in remarks) == 1
    assert not any("default:" in remark for remark in remarks)


def test_history_is_not_compared_when_guidance_is_kgrl():
    remarks = differences_of("BncConnector", {"guidance": "kgrl"})
    assert not any("ρ" in remark or "history" in remark for remark in remarks)


@pytest.mark.parametrize(
    ("setting", "words"),
    [
        ({"greedy_episode_fraction": 0.8}, "80% of the episodes are greedy"),
        ({"symmetry": True}, "symmetry data augmentation"),
        ({"selection_window": 8}, "checkpoint selection"),
        ({"learning_rate": 3e-4}, "learning rate 0.0003 (thesis: 0.001)"),
        ({"gamma": 0.99}, "gamma of a control step 0.99 (thesis: 0.995)"),
    ],
)
def test_learner_setting_difference_is_described(setting, words):
    config = configure("BncConnector", AS_PRINTED, algorithm="tqc", preset="table_4_1_robot")
    changed = replace(config, learner=replace(config.learner, **setting))
    (added,) = set(describe_differences(changed)) - set(describe_differences(config))
    assert words in added


@pytest.mark.parametrize(
    ("task", "guidance", "count"), [("BncConnector", "kgrl", 1), ("NarrowPassage", "kgrl", 0), ("GridClamp", "sct", 0)]
)
def test_symmetry_is_described_when_the_task_is_symmetric(task, guidance, count):
    remarks = differences_of(task, {"guidance": guidance}, algorithm="tqc", preset="tqc_contact")
    assert sum("symmetry data augmentation" in remark for remark in remarks) == count


def test_gamma_is_compared_per_control_step():
    options = AS_PRINTED | {"action_repeat": 10}
    remarks = differences_of("BncConnector", options, algorithm="tqc", preset="table_4_1_robot")
    assert not any("gamma" in remark for remark in remarks)


def test_actions_are_compared_per_second_where_the_thesis_states_their_rate():
    longer = differences_of("Pouring", {"control_period": 0.1, "action_repeat": 1}, preset="table_3_2_iiwa")
    assert not any(remark.startswith(("control steps", "gamma")) for remark in longer)
    rarer = differences_of("Pouring", {"control_period": 0.1, "action_repeat": 2}, preset="table_3_2_iiwa")
    assert "control steps of an action 20 (thesis: 10)" in rarer


def test_pouring_remarks_depend_on_reward():
    assert any("weights in equation 3.7" in remark for remark in differences_of("Pouring"))
    sparse = differences_of("Pouring", {"reward": "sparse"})
    assert any("1.7 times" in remark for remark in sparse)
    assert not any("equation 3.7" in remark for remark in sparse)


def test_connector_remarks_have_the_dimensions_of_the_run():
    text = " ".join(describe_differences(configure("BncConnector", {"difficulty": "hard"})))
    assert "chamfer of 0.1 mm" in text
    assert "difficulty 'hard', added here" in text
    assert "difficulty" not in " ".join(describe_differences(configure("BncConnector", {})))


def test_learner_is_not_compared_when_nothing_is_trained():
    config = configure("Pouring", {"difficulty": "hard"}, algorithm="tqc", preset="tqc_contact")
    without = describe_differences(config, learns=False)
    assert set(without) < set(describe_differences(config))
    assert not any("learning rate" in remark or "hidden units" in remark for remark in without)
    assert any("difficulty" in remark for remark in without)
