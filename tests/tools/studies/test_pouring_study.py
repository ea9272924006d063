import pytest

from guiderail.diagrams.tasks.pouring_inputs import person
from guiderail.models.errors import InputError
from guiderail.tools.figures import reproduce
from guiderail.tools.files import write_atomically
from guiderail.tools.learning.run_folder import RunFolder, read_table, table_text
from guiderail.tools.studies import pouring_study as module
from guiderail.tools.studies.pouring_study import FIRST_SEED, METHODS, job, pouring_study, training_row, unseen_mugs
from guiderail.tools.tasks import make_environment

NUMBERS = ("return", "peak_force", "collisions", "worst_violation", "worst_measured_violation", "steps", "wall_time")
JERKS = ("jerk_commanded_linear", "jerk_measured_linear")


def episodes(endings):
    """Rows as training leaves them."""
    known = {"s": "success", "p": "spill", "c": "collision", "t": "time_limit"}
    return [
        {"episode": i, "success": int(e == "s"), "termination": known[e], **dict.fromkeys((*NUMBERS, *JERKS), 0.5)}
        for i, e in enumerate(endings)
    ]


def finished(out, method, algorithm, seed, endings):
    """A run that is there already."""
    one = job(out, method, algorithm, seed, len(endings))
    folder = RunFolder(one.folder)
    folder.create(one.config)
    folder.write_episodes(episodes(endings))
    write_atomically(one.folder / "policy.json", b"{}")
    return one


def test_ten_in_a_row_are_counted_with_the_ten():
    row = training_row(episodes("tpc" + "s" * 9 + "p" + "s" * 12))
    assert row == {"episodes": 25, "ten_in_a_row_at": 23, "successes": 21, "spills": 2, "collisions": 1}
    assert training_row(episodes("s" * 9 + "t"))["ten_in_a_row_at"] is None


def test_what_was_judged_already_is_used_again_and_every_seed_has_its_row(tmp_path):
    for seed, held_out in ((10, "ssss"), (11, "spsc")):
        one = finished(tmp_path, "rl_sct_shaped", "sac", seed, "t" + "s" * 11)
        write_atomically(one.folder / "held_out-4.csv", table_text(episodes(held_out)).encode())
        write_atomically(one.folder / "unseen_mugs-2.csv", table_text(episodes("sp")).encode())
    said = []
    result = pouring_study(tmp_path, seeds=[10, 11], episodes=12, evaluations=4, mugs=2, report=said.append)
    assert result["rl_sct_shaped, held out success of each seed"] == [1.0, 0.5]
    assert result["rl_sct_shaped, ten in a row at of each seed"] == [11, 11]
    assert [row["seed"] for row in said] == [10, 11]
    table = read_table(tmp_path / "pouring-sac-rl_sct_shaped.csv")
    assert [(row["held_out_spills"], row["held_out_collisions"]) for row in table] == [(0, 0), (1, 1)]
    assert [row["unseen_mugs_success"] for row in table] == [0.5, 0.5]


@pytest.mark.parametrize(
    "wrong",
    [{"methods": ["magic"]}, {"methods": []}, {"seeds": []}, {"evaluations": -1}, {"episodes": 0}, {"algorithm": "x"}],
)
def test_what_makes_no_sense_is_refused_before_anything_runs(tmp_path, wrong):
    with pytest.raises(InputError):
        pouring_study(tmp_path / "new", **wrong)
    assert not (tmp_path / "new").exists()


def test_a_person_pours_and_the_constraints_are_why(tmp_path):
    methods = ["person", "person_unconstrained"]
    result = pouring_study(tmp_path, methods=methods, seeds=[3, 4], evaluations=2)
    assert [result[f"{method}, held out success of each seed"] for method in methods] == [[1.0], [0.0]]
    bound, free = read_table(tmp_path / "pouring-sac-person-person_unconstrained.csv")
    assert bound["held_out_spills"] + bound["held_out_collisions"] == 0
    assert free["held_out_spills"] + free["held_out_collisions"] == 2
    assert bound["worst_violation"] <= 1e-9


@pytest.mark.parametrize("method", METHODS)
def test_every_method_is_an_environment_that_there_is(tmp_path, method):
    config = job(tmp_path, method, "sac", 0).config
    env = make_environment(config.task, config.environment)
    assert env.action_space.shape == ((3,) if method.startswith("rl_sct") else (6,))
    assert (config.learner.discount, config.learner.discount_of) == (0.95, "decision")


def test_unseen_mugs_are_within_their_bounds_and_every_few_episodes_another(tmp_path, monkeypatch):
    made = []
    monkeypatch.setattr(module, "EPISODES_A_MUG", 2)

    def environment(task, arguments):
        made.append(arguments)
        return make_environment(task, arguments)

    monkeypatch.setattr(module, "make_environment", environment)
    config = job(tmp_path, "rl_sct_shaped", "sac", 0).config
    rows = unseen_mugs(config, person, 3)
    assert [row["termination"] for row in rows] == ["success"] * 3
    assert len(made) == 2
    assert rows[0]["mug_depth"] == rows[1]["mug_depth"] != rows[2]["mug_depth"]
    for arguments in made:
        assert module.MUG_DIAMETERS[0] <= arguments["mug_inner_diameter"] <= module.MUG_DIAMETERS[1]
        assert module.MUG_DEPTHS[0] <= arguments["mug_depth"] <= module.MUG_DEPTHS[1]
        assert arguments["mug_offset"] == 0.04


def test_the_figures_are_drawn_from_the_studys_runs_and_from_every_seed_there_is(tmp_path):
    for algorithm in ("sac", "tqc"):
        for method in METHODS:
            ending = "s" if method.startswith("rl_sct") else "c"
            finished(tmp_path, method, algorithm, FIRST_SEED, "tp" + ending * 10)
        finished(tmp_path, "rl_sct_shaped", algorithm, FIRST_SEED + 3, "s" * 12)
    for figure in ("3.5", "3.6", "table 3.3"):
        result = reproduce(figure, seeds=1, episodes=12, out=tmp_path)
        assert result["RL-SCT-Shaped, ten in a row at episode"] == "12, 10"
        assert result["RL-Shaped, ten in a row at episode"] == "never"
        assert result["RL-Shaped, spills and collisions"] == "1 and 10 of 12"
        assert (tmp_path / f"{'table_3_3' if 'table' in figure else 'figure_' + figure.replace('.', '_')}.png").exists()
    assert reproduce("3.8", seeds=1, episodes=12, out=tmp_path)["tqc, RL-SCT-Sparse, ten in a row at episode"] == "12"
    table = (tmp_path / "table_3_3.md").read_text()
    assert all(word in table for word in ("translational", "tilt", "pour", "TiltTowards", "15 a metre"))
