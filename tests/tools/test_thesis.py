from dataclasses import replace

import pytest

from guiderail.diagrams.tasks.registry import TASKS
from guiderail.tools.learning.configure import configure, with_defaults
from guiderail.tools.thesis import THESIS, differences


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
    "guidance": "skgrl", "reward": "sparse", "hold": 1, "explored": None, "history_variance": 1e-8,
    "history_source": "measured", "uncertainty": "calibration", "station": "arm",
}  # fmt: skip


def test_the_connector_as_the_thesis_has_it_differs_only_in_what_cannot_be_had():
    words = told("BncConnector", AS_PRINTED, algorithm="tqc", preset="table_4_1_robot")
    assert all("thesis: " in one for one in words)
    assert not any(one.startswith(("control steps", "ρ", "learning rate", "discount", "station")) for one in words)
    assert any(one.startswith("simulated") for one in words)
    holding = [holds(configure("BncConnector", AS_PRINTED).environment) for _, holds in THESIS["BncConnector"].remarks]
    assert len(words) == sum(holding)


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"reward": "shaped"}, "reward shaped (thesis: sparse)"),
        ({"hold": 10}, "control steps of a decision 10 (thesis: 1)"),
        ({"explored": (0, 1)}, "explored outputs 0, 1 (thesis: all)"),
        ({"history_variance": 1e-11}, "ρ = 1e-11 (thesis: 1e-08)"),
        ({"history_source": "commanded"}, "history of poses that were commanded (thesis: measured)"),
        ({"uncertainty": "disc"}, "uncertainty disc (thesis: calibration)"),
        ({"station": "rails"}, "station rails (thesis: arm)"),
    ],
)
def test_each_option_that_differs_is_named_with_both_values(changed, words):
    before = told("BncConnector", AS_PRINTED, algorithm="tqc", preset="table_4_1_robot")
    after = told("BncConnector", AS_PRINTED | changed, algorithm="tqc", preset="table_4_1_robot")
    assert set(after) - set(before) == {words}


def test_kgrl_has_no_history_to_differ_in():
    assert not any("ρ" in one or "history" in one for one in told("BncConnector", {"guidance": "kgrl"}))


@pytest.mark.parametrize(
    ("setting", "words"),
    [
        ({"greedy_share": 0.8}, "80% of the episodes are greedy"),
        ({"symmetry": True}, "seen from other sides"),
        ({"selection_window": 8}, "checkpoint selection"),
        ({"learning_rate": 3e-4}, "learning rate 0.0003 (thesis: 0.001)"),
        ({"discount": 0.99}, "discount of a control step 0.99 (thesis: 0.995)"),
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
    words = told(task, {"guidance": guidance}, algorithm="tqc", preset="robust")
    assert sum("seen from other sides" in one for one in words) == sides


def test_a_discount_means_the_same_whatever_an_action_lasts():
    words = told("BncConnector", {**AS_PRINTED, "hold": 10}, algorithm="tqc", preset="table_4_1_robot")
    assert not any("discount" in one for one in words)


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
    config = configure("Pouring", {"difficulty": "hard"}, algorithm="tqc", preset="robust")
    without = differences(config, learns=False)
    assert set(without) < set(differences(config))
    assert not any("learning rate" in one or "hidden units" in one for one in without)
    assert any("difficulty" in one for one in without)
