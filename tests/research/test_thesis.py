from dataclasses import replace

import pytest

from guiderail.diagrams.envs.config import option_models
from guiderail.diagrams.guidance.registry import possible_guidance
from guiderail.diagrams.stations.disturbances import Disturbances
from guiderail.diagrams.stations.registry import stations_for
from guiderail.diagrams.tasks.registry import TASKS
from guiderail.tools.learning.train import configure, with_defaults
from research.thesis import HISTORY, NEUTRAL, THESIS, differences


def told(task, environment=None, **given):
    return differences(configure(task, environment or {}, **with_defaults(task, given)))


def test_every_option_that_is_compared_is_one_of_its_task():
    for task, setting in THESIS.items():
        known = configure(task, {}).environment
        for name, values in setting.options.items():
            assert name in known, f"{task} has no option {name}"
            for value in values:
                assert configure(task, {name: value}).environment[name] == value, "the thesis's value can be had"


def test_all_tasks_of_ours_are_in_the_thesis_and_others_are_said_not_to_be(bead_config):
    assert {name for name in TASKS.names() if TASKS.get(name).__module__.startswith("guiderail.")} == set(THESIS)
    assert differences(bead_config) == ["it has no task Bead"]


AS_PRINTED = {
    "guidance": "skgrl", "reward": "sparse", "action_repeat": 1, "action_dims": None, "history_variance": 1e-8,
    "history_source": "measured", "fixture_offset": "per_run", "station": "arm",
}  # fmt: skip


def test_the_connector_as_the_thesis_has_it_differs_only_in_what_cannot_be_had():
    words = told("BncConnector", AS_PRINTED, algorithm="tqc", preset="table_4_1_robot")
    assert all("thesis: " in one for one in words)
    assert not any(one.startswith(("control steps", "ρ", "learning rate", "gamma", "station")) for one in words)
    assert any(one.startswith("simulated") for one in words)
    command_timed_out = [
        holds(configure("BncConnector", AS_PRINTED).environment) for _, holds in THESIS["BncConnector"].remarks
    ]
    assert len(words) == sum(command_timed_out)


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"reward": "shaped"}, "reward shaped (thesis: sparse)"),
        ({"action_repeat": 10}, "control steps of a decision 10 (thesis: 1)"),
        ({"action_dims": (0, 1)}, "explored outputs 0, 1 (thesis: all)"),
        ({"history_variance": 1e-11}, "ρ = 1e-11 (thesis: 1e-08)"),
        ({"history_source": "commanded"}, "history of poses that were commanded (thesis: measured)"),
        ({"fixture_offset": "per_episode"}, "uncertainty disc (thesis: calibration)"),
        ({"station": "gantry"}, "station rails (thesis: arm)"),
    ],
)
def test_each_option_that_differs_is_named_with_both_values(changed, words):
    before = told("BncConnector", AS_PRINTED, algorithm="tqc", preset="table_4_1_robot")
    after = told("BncConnector", AS_PRINTED | changed, algorithm="tqc", preset="table_4_1_robot")
    assert set(after) - set(before) == {words}


OTHER_VALUES = {
    "offset_range": (0.0, 0.001), "start_height": (0.02, 0.03), "action_dims": (0,), "gains": (1.0, 1.0),
    "via_points": (10, 0.3, 0.3), "balls_in": 1, "balls": 3, "active_constraints": False, "input_speed": 1.5,
    "time_step": 0.005, "control_period": 0.004, "robot": "other.urdf", "end_effector": "other", "lcm_url": "udpm://",
    "mug_error_least": 0.01, "mug_inner_diameter": 0.09, "mug_depth": 0.1, "demonstrations": "search",
}  # fmt: skip
TOGETHER = {"balls": {"ball_diameter": 0.026}, "mug_error_least": {"mug_error_most": 0.02}}
"""What an option of that name needs beside it, for a value that the thesis does not have."""


def _another(task, name, field, default):
    """A value of an option that differs from the thesis if its default does not, and the other way round."""
    if name in OTHER_VALUES:
        return OTHER_VALUES[name]
    theirs = THESIS[task].options.get(name, (default,))
    usual = theirs if default in theirs else (default,)
    words = {"reward": TASKS.get(task).rewards, "observation": TASKS.get(task).observations, "difficulty": ("hard",)}
    words["history_source"], words["impedance_control"] = ("commanded", "measured"), ("joint", "cartesian")
    words["fixture_offset"], words["solver"] = ("per_run", "per_episode", "none"), ("daqp", "osqp")
    words["kernel"] = ("squared_exponential", "matern52")
    if isinstance(default, bool):
        values = (True, False)
    elif name in words:
        values = words[name]
    elif isinstance(default, tuple):
        values = (tuple(1.0 + one for one in default), tuple(0.5 * one for one in default))
        values = tuple((min(one), max(one)) for one in values)
    elif isinstance(default, int):
        values = (1, 2, 3)
    else:
        limits = [getattr(one, bound, None) for one in field.metadata for bound in ("le", "ge")]
        values = (*(limit for limit in limits if limit is not None), 0.5 * default, 0.25)
    return next((value for value in values if value not in usual), None)


def _options():
    """Every option of every task, once for each guidance, at the station that it is used at first."""
    for task in THESIS:
        declared = TASKS.get(task)
        for guidance in possible_guidance(declared.provides()):
            for station in stations_for(declared.workcell_kind):
                for model in option_models(declared, guidance, station).values():
                    for name, field in model.model_fields.items():
                        yield task, guidance, station, name, field


def test_every_option_that_is_not_as_usual_is_named_unless_it_is_neutral():
    checked = set()
    for task, guidance, station, name, field in _options():
        nothing_said = name in (*NEUTRAL, "station") or (name in HISTORY and guidance != "skgrl")
        if nothing_said or (task, guidance, name) in checked or (task, name) == ("Pouring", "reward"):
            continue
        usual = configure(task, {"guidance": guidance, "station": station})
        value = _another(task, name, field, usual.environment[name])
        if value is None:
            assert name in ("reward", "observation"), f"a value of {name} that is not as usual is needed here"
            continue
        beside = {"guidance": guidance, "station": station} | TOGETHER.get(name, {})
        before, after = configure(task, beside), configure(task, beside | {name: value})
        assert set(differences(after, learns=False)) != set(differences(before, learns=False)), (task, guidance, name)
        checked.add((task, guidance, name))
    assert {name for task, _, name in checked if task == "BncConnector"} >= set(Disturbances.model_fields)


@pytest.mark.parametrize(
    ("task", "given", "words"),
    [
        ("BncConnector", {"bound": 0.006}, "bound 0.006 (thesis: 0.002)"),
        ("BncConnector", {"offset_range": (0.0, 0.0)}, "offset range 0, 0 (default: unset)"),
        ("BncConnector", {"wrench_noise": (5.0, 0.5)}, "wrench noise 5, 0.5 (default: 0, 0)"),
        ("BncConnector", {"difficulty": "hard", "force_limit": 35.0}, "force limit 35 (default: 20)"),
        ("Pouring", {"active_constraints": False}, "active constraints no (thesis: yes)"),
        ("Pouring", {"guidance": "none", "active_constraints": True}, "active constraints yes (default: unset)"),
        ("NarrowPassage", {"second_obstacle": True}, "second obstacle yes (default: no)"),
    ],
)
def test_what_is_not_as_usual_is_named_with_what_is_usual(task, given, words):
    assert words in told(task, given)


@pytest.mark.parametrize("task", THESIS)
def test_what_a_difficulty_stands_for_is_one_statement(task):
    words = told(task, {"difficulty": "hard"})
    assert sum("difficulty" in one for one in words) == 1
    assert not any("default:" in one for one in words)


def test_kgrl_has_no_history_to_differ_in():
    assert not any("ρ" in one or "history" in one for one in told("BncConnector", {"guidance": "kgrl"}))


@pytest.mark.parametrize(
    ("setting", "words"),
    [
        ({"greedy_episode_fraction": 0.8}, "80% of the episodes are greedy"),
        ({"symmetry": True}, "seen from other sides"),
        ({"selection_window": 8}, "checkpoint selection"),
        ({"learning_rate": 3e-4}, "learning rate 0.0003 (thesis: 0.001)"),
        ({"gamma": 0.99}, "discount of a control step 0.99 (thesis: 0.995)"),
        ({"n_steps": 3}, "returns are of 3 decisions"),
    ],
)
def test_each_setting_of_the_learner_that_differs_is_named(setting, words):
    config = configure("BncConnector", AS_PRINTED, algorithm="tqc", preset="table_4_1_robot")
    changed = replace(config, learner=replace(config.learner, **setting))
    (added,) = set(differences(changed)) - set(differences(config))
    assert words in added


@pytest.mark.parametrize(
    ("task", "guidance", "sides"), [("BncConnector", "kgrl", 1), ("NarrowPassage", "kgrl", 0), ("GridClamp", "sct", 0)]
)
def test_other_sides_are_named_where_there_are_any(task, guidance, sides):
    words = told(task, {"guidance": guidance}, algorithm="tqc", preset="tqc_contact")
    assert sum("seen from other sides" in one for one in words) == sides


def test_a_discount_means_the_same_whatever_an_action_lasts():
    words = told("BncConnector", {**AS_PRINTED, "action_repeat": 10}, algorithm="tqc", preset="table_4_1_robot")
    assert not any("gamma" in one for one in words)


def test_pouring_names_its_weights_and_its_speed():
    assert any("equation 3.7 are weighted" in one for one in told("Pouring"))
    sparse = told("Pouring", {"reward": "sparse"})
    assert any("1.7 times" in one for one in sparse)
    assert not any("equation 3.7" in one for one in sparse)


def test_the_connectors_dimensions_are_the_runs_own():
    told = " ".join(differences(configure("BncConnector", {"difficulty": "hard"})))
    assert "chamfer of 0.1 mm" in told
    assert "difficulty 'hard', which is ours" in told
    assert "difficulty" not in " ".join(differences(configure("BncConnector", {})))


def test_who_does_not_learn_differs_in_no_setting_of_a_learner():
    config = configure("Pouring", {"difficulty": "hard"}, algorithm="tqc", preset="tqc_contact")
    without = differences(config, learns=False)
    assert set(without) < set(differences(config))
    assert not any("learning rate" in one or "hidden units" in one for one in without)
    assert any("difficulty" in one for one in without)
