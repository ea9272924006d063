import pytest

from guiderail.models.errors import InputError
from guiderail.tools.figures.grid_clamp import METHODS
from guiderail.tools.files import write_atomically
from guiderail.tools.learning.run_folder import RunFolder, read_table, table_text
from guiderail.tools.studies.clamp_study import Cell, clamp_study

KEYS = ("return", "mean_squared_force", "peak_force", "steps", "worst_violation", "wall_time")


def episodes(success, collisions=0, **values):
    """Rows as training and an evaluation leave them."""
    rest = dict.fromkeys(KEYS, 0.0) | {"collisions": collisions} | values
    return [{"episode": i, "success": s, "termination": "", **rest} for i, s in enumerate(success)]


def leave(out, method, seed, success, **values):
    """A finished run of as many episodes, already judged on four."""
    cell = Cell(method, "calibration", seed, len(success), 4)
    folder = RunFolder(out / f"{method}-calibration-{seed}")
    folder.create(cell.config())
    folder.write_episodes(episodes(success, **values))
    write_atomically(folder.path / "policy.json", b"{}")
    write_atomically(folder.path / "held_out-4.csv", table_text(episodes([1, 1, 1, 0])).encode())


def test_finished_runs_are_used_again_and_every_seed_has_its_row(tmp_path):
    for seed in (10, 11):
        leave(tmp_path, "sct", seed, [0] + [1] * 11, mean_squared_force=4.0)
        leave(tmp_path, "sct_no_force", seed, [1] * 12, mean_squared_force=16.0)
    result = clamp_study(tmp_path, methods=["sct", "sct_no_force"], seeds=[10, 11], episodes=12, evaluations=4)
    assert result["sct, held-out success of each seed"] == "75%, 75%"
    assert result["squared force in training, with its cost as a part of without, each seed"] == "0.25, 0.25"
    table = read_table(tmp_path / "clamp-calibration.csv")
    assert [row["converged_after"] for row in table] == [1, 0, 1, 0]
    assert [row["squared_force_since_converged"] for row in table] == [4.0, 16.0, 4.0, 16.0]


def test_what_was_outside_and_what_collided_is_counted(tmp_path):
    leave(tmp_path, "sct", 10, [1, 1], collisions=2, worst_violation=1e-6)
    clamp_study(tmp_path, methods=["sct"], seeds=[10], episodes=2, evaluations=4)
    (row,) = read_table(tmp_path / "clamp-calibration.csv")
    assert row["episodes_commanded_outside"] == 2
    assert row["collisions"] == 4


def test_a_run_with_other_settings_is_refused(tmp_path):
    leave(tmp_path, "sct", 10, [1, 1])
    with pytest.raises(InputError, match="episodes"):
        clamp_study(tmp_path, methods=["sct"], seeds=[10], episodes=3, evaluations=4)


@pytest.mark.parametrize("wrong", [{"methods": ["magic"]}, {"methods": []}, {"episodes": 0}, {"seeds": []}])
def test_what_makes_no_sense_is_refused_before_anything_runs(tmp_path, wrong):
    with pytest.raises(InputError):
        clamp_study(tmp_path / "new", **wrong)
    assert not (tmp_path / "new").exists()


def test_the_figures_methods_are_the_studys():
    for method in METHODS:
        assert Cell(method, "calibration", 0, 1, 1).config().environment["guidance"] == "sct"
