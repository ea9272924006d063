import pytest

from guiderail.models.errors import InputError
from guiderail.tools.files import write_atomically
from guiderail.tools.learning.run_folder import read_table, table_text
from guiderail.tools.studies.connector_study import Cell, connector_study
from guiderail.tools.studies.smoothness import measure, methods, quiet_commands, smoothness


def judged(success):
    """Rows as an evaluation leaves them."""
    keys = ("return", "mean_force", "peak_force", "steps", "worst_violation")
    return [{"episode": i, "success": s, "termination": "", **dict.fromkeys(keys, 1.5)} for i, s in enumerate(success)]


def test_what_was_judged_already_is_used_again_and_every_seed_has_its_row(tmp_path):
    for seed, success in ((10, [1, 1, 1, 1]), (11, [1, 0, 0, 0])):
        folder = tmp_path / f"demonstration-disc-{seed}"
        write_atomically(folder / "held_out-rails-0-4.csv", table_text(judged(success)).encode())
    said = []
    result = connector_study(
        tmp_path, methods=["demonstration"], uncertainty="disc", seeds=[10, 11], evaluations=4, report=said.append
    )
    assert result["demonstration, held-out success of each seed"] == "100%, 25%"
    table = read_table(tmp_path / "connector-disc-rails.csv")
    assert [row["held_out_success"] for row in table] == [1.0, 0.25]
    assert [row["seed"] for row in said] == [10, 11]
    assert said[0]["training_collisions"] is None


def test_a_policy_learns_on_rails_wherever_it_is_judged():
    cell = Cell("skgrl_adaptive", "disc", 3, (40,), 100, station="arm")
    assert cell.config(40).environment["station"] == "rails"
    assert cell.config(40, cell.station).environment["station"] == "arm"
    assert cell.config(40).environment["guidance"] == "skgrl"
    assert cell.config(40).environment["adaptive_history"]


@pytest.mark.parametrize(
    "wrong", [{"methods": ["magic"]}, {"marks": []}, {"marks": [0]}, {"evaluations": 0}, {"seeds": []}]
)
def test_what_makes_no_sense_is_refused_before_anything_runs(tmp_path, wrong):
    with pytest.raises(InputError):
        connector_study(tmp_path / "new", **wrong)
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize("wrong", [{"episodes": 0}, {"kappa": 0.0}, {"outputs": "some"}])
def test_the_benchmark_of_smoothness_refuses_too(tmp_path, wrong):
    with pytest.raises(InputError):
        smoothness(tmp_path / "new", **wrong)
    assert not (tmp_path / "new").exists()


def test_every_way_to_explore_has_a_name_of_its_own():
    names = [method.name for method in methods()]
    assert len(set(names)) == len(names)
    for kind in ("KGRL", "adaptive", "white", "gSDE", "pink", "OU", "low-pass", "repeat"):
        assert any(kind in name for name in names), kind


@pytest.mark.parametrize("name", ["KGRL", "residual white"])
def test_every_way_to_explore_has_the_same_rms(name):
    (method,) = [method for method in methods() if method.name == name]
    free, contact = measure(method, (0, 1, 2, 3, 4, 5), quiet_commands(), episodes=1, kappa=0.5, seed=0)
    assert (free["place"], contact["place"]) == ("free", "connector")
    assert free["rms_in_deviations"] == pytest.approx(0.5, rel=0.05)
