import json
import subprocess
import sys

import pytest

import guiderail
from guiderail.diagrams.stations.registry import STATIONS
from guiderail.models.objects.bnc_connector import geometry as bnc_connector
from guiderail.models.objects.grid_clamp import geometry as grid_clamp
from guiderail.tools.cli.main import app, main
from guiderail.tools.environments import as_value
from guiderail.tools.learning.run_folder import RunFolder
from research import benchmarks
from research.studies import study_path

CONNECTOR = str(study_path("connector"))


def call(capsys, *arguments):
    """Exit code, standard output and standard error of the command."""
    with pytest.raises(SystemExit) as end:
        main([str(argument) for argument in arguments])
    out, err = capsys.readouterr()
    return end.value.code, out, err


@pytest.fixture
def trained(bead_run):
    return bead_run


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ([], "choose one of"),
        (["trian"], "did you mean train?"),
        (["xyz"], "choose one of"),
        (["train"], "--out"),
        (["train", "--out", "new"], "name a task"),
        (["train", "Pooring", "--out", "new"], "did you mean Pouring?"),
        (["train", "Bead", "--out", "new", "--guidance", "magic"], "kmp or skgrl"),
        (["train", "NarrowPassage", "--out", "new", "--guidance", "magic"], "kmp, none, residual, safe_residual"),
        (["train", "Bead", "--out", "new", "--algorithm", "ppo"], "sac, tqc"),
        (["train", "Bead", "--out", "new", "--preset", "robst"], "did you mean robust?"),
        (["train", "Bead", "--out", "new", "--fixture-offset", "per_episode"], "no option 'uncertainty'"),
        (["train", "Bead", "--out", "new", "--episodes", "0"], "at least one episode"),
        (["train", "Bead", "--out", "new", "--episodes", "many"], "see guiderail train --help"),
        (["train", "Bead", "--out", "new", "--seed", "-1"], "a seed is a whole number"),
        (["train", "Bead", "--out", "new", "--set", "batch_size"], "name=value"),
        (["train", "Bead", "--out", "new", "--set", "batchsize=3"], "did you mean batch_size?"),
        (["train", "Bead", "--out", "new", "--set", "batch_size=0"], "greater than or equal to 1"),
        (["train", "Bead", "--out", "new", "--set", "learning_rate=fast"], "give a value such as"),
        (["train", "--resume", "--out", "new"], "not a run"),
        (["train", "Bead", "--fast"], "no option --fast"),
        (["train", "Bead", "--epsiodes", "3"], "did you mean --episodes?"),
        (["train", "Bead", "--out", "new", "--env", "action_repeat"], "--env takes name=value"),
        (["train", "Bead", "--out", "new", "--env", "hodl=2"], "did you mean hold?"),
        (["train", "Bead", "--out", "new", "--env", "hold=two"], "give a value such as 1"),
        (["train", "Bead", "--out", "new", "--env", "wall=[1, 2]"], "give a value such as 1.0"),
        (["train", "BncConnector", "--out", "new", "--robot", "panda"], "it is one of station='arm'"),
        (["train", "BncConnector", "--out", "new", "--lcm-url", "memq://"], "it is one of station='hardware'"),
        (["train", "BncConnector", "--out", "new", "--rate", "0.5"], "give --station hardware too"),
        (["train", "BncConnector", "--out", "new", "--scenario", "lab.yaml"], "give --station hardware too"),
        (["evaluate", "new"], "not a run"),
        (["replay", "new"], "not a run"),
        (["plot", "new"], "not a run"),
        (["record", "new", "--out", "demos.npz"], "not a run"),
        (["check", "new.npz"], "no file"),
        (["check", "."], "no file .npz or .csv"),
        (["reproduce", "1.1"], "no figure '1.1'"),
        (["reproduce", "5.66"], "did you mean 5.6?"),
        (["reproduce", "5.6", "--seeds", "0"], "at least one seed"),
        (["study", "connector.yaml", "--out", "new"], "there is no file connector.yaml"),
        (["study", CONNECTOR, "--out", "new", "--seeds", "1;2"], "whole numbers separated by commas"),
        (["study", CONNECTOR, "--out", "new", "--methods", "skgrll"], "did you mean skgrl?"),
        (["study", CONNECTOR, "--out", "new", "--engine", "rya"], "did you mean ray?"),
        (["study", CONNECTOR, "--out", "new", "--processes", "0"], "at least one process"),
        (["study", CONNECTOR, "--out", "new", "--address", "auto"], "give --engine ray too"),
        (["bench", "primitve"], "did you mean primitive?"),
        (["bench", "learner", "Pouring"], "of no task: leave task out"),
        (["bench", "training", "Puring"], "did you mean Pouring?"),
        (["bench", "training", "Bead", "--env", "wal=1"], "did you mean wall?"),
        (["stress", "BncConector"], "did you mean BncConnector?"),
        (["stress", "Pouring", "--episodes", "0"], "at least one episode"),
        (["drive", "Puring"], "did you mean Pouring?"),
        (["film", "new", "--out", "film.png"], "not a run"),
        (["film", "Bead", "--policy", "rul", "--out", "film.png"], "no policy 'rul'"),
        *(
            ([*words, "--import", "none.py"], "there is none for 'none.py'")
            for words in (
                ["stress", "lab/Own"],
                ["replay", "lab/Own"],
                ["certify", "lab/Own"],
                ["film", "lab/Own", "--out", "film.png"],
                ["drive", "lab/Own"],
                ["teach", "lab/Own", "--out", "taught.npz"],
                ["bench", "training", "lab/Own"],
            )
        ),
        (["train", "lab/Own", "--out", "new"], "or --import the file that registers it"),
        (["stress", "lab/Own"], "or --import the file that registers it"),
        (["check", "pourin"], "or one of end_effector_velocity, grid_clamp, pouring"),
        (["check", "pouring", "--fit"], "this is a template: leave it out"),
        (["serve-iiwa", "--seconds", "nan"], "seconds must be a positive number, not nan"),
        (["serve-iiwa", "--seconds", "-1"], "seconds must be a positive number, not -1"),
        (["serve-iiwa", "--command-timeout", "0"], "patience must be a positive number, not 0"),
        (["serve-iiwa", "--offset", "1.5,0"], "offset cannot be (1.5, 0.0): give x and y in metres"),
        (["serve-iiwa", "--rate", "0"], "a rate up to 1 of the wall's, not 0"),
        (["run", "new", "--sim", "--lcm-url", "udpm://239.255.76.67:7667"], "a bus of its own"),
        (["generate", "objects"], "nothing called 'objects'"),
        (["generate", "clamp-objects", "--out", "none"], "make it first"),
        (["list", "metrix"], "did you mean metrics?"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else None,
)
def test_what_makes_no_sense_is_one_sentence_and_touches_nothing(arguments, says, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code, out, err = call(capsys, *arguments)
    assert (code, out) == (2, "")
    assert err.startswith("guiderail: ")
    assert err.count("\n") == 1
    assert says in err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("policy", ["none", "white,rule", "whit"])
def test_in_a_robots_episodes_one_policy_acts_that_there_is(policy, capsys, trained):
    code, out, err = call(capsys, "run", trained, "--sim", "--episodes", 1, "--policy", policy)
    assert (code, out) == (2, "")
    assert f"Bead has no policy {policy!r}" in err
    assert err.count("\n") == 1
    assert not (trained / "hardware").exists()


def test_what_is_endless_is_null_for_a_program_however_deep_it_lies(capsys, monkeypatch):
    found = {"as it is": [{"part": "there and back", "worst_ms": float("inf"), "median_ms": 1.5, "number": 3}]}
    monkeypatch.setattr(benchmarks, "run_benchmark", lambda what, **told_of: (found, print))
    code, out, _ = call(capsys, "bench", "loop", "--json")
    assert code == 0
    (row,) = json.loads(out, parse_constant=pytest.fail)["as it is"]
    assert row == {"part": "there and back", "worst_ms": None, "median_ms": 1.5, "number": 3}


def test_an_existing_folder_is_left_alone(capsys, trained):
    before = {path: path.read_bytes() for path in trained.rglob("*") if path.is_file()}
    code, _, err = call(capsys, "train", "Bead", "--out", trained)
    assert code == 2
    assert "--resume" in err
    assert before == {path: path.read_bytes() for path in trained.rglob("*") if path.is_file()}


def test_a_demo_replaces_no_run_that_is_none_of_its_own(capsys, trained):
    code, _, err = call(capsys, "demo", "--out", trained)
    assert code == 2
    assert "already exists" in err
    assert (trained / "episodes.csv").exists()


def test_training_leaves_the_whole_folder(capsys, tmp_path):
    options = ["--episodes", 2, "--set", "net_arch=8", "--json"]
    code, out, err = call(capsys, "train", "Bead", "--out", tmp_path / "run", *options)
    assert code == 0
    assert json.loads(out)["episodes"] == 2
    assert "Bead 2/2" in err
    assert err.index("learned; now the learning curve and a replay page") > err.index("Bead 2/2")
    expected = {"config.yaml", "episodes.csv", "checkpoint", "policy.safetensors", "policy.json", "learning_curve.png"}
    assert expected <= {path.name for path in (tmp_path / "run").iterdir()}


def test_evaluation_can_be_read_by_a_program(capsys, trained):
    code, out, err = call(capsys, "evaluate", trained, "--episodes", 3, "--json")
    assert code == 0
    assert "series 1 of 4: the policy 3/3" in err
    result = json.loads(out)
    assert {
        "success_rate",
        "demonstration_success_rate",
        "episodes",
        "max_commanded_violation",
        "peak_force",
    } <= result.keys()
    assert result["episodes"] == 3
    assert 0 <= result["success_rate"] <= 1


def test_evaluation_is_the_same_every_time_and_differs_by_seed(capsys, trained):
    first, again = (call(capsys, "evaluate", trained, "--episodes", 3, "--json")[1] for _ in range(2))
    other = call(capsys, "evaluate", trained, "--episodes", 3, "--json", "--seed", 9)[1]
    assert first == again
    assert json.loads(first)["mean_return"] != json.loads(other)["mean_return"]


def test_a_damaged_policy_is_refused(capsys, trained):
    weights = trained / "policy.safetensors"
    weights.write_bytes(weights.read_bytes()[:-10])
    code, _, err = call(capsys, "evaluate", trained)
    assert code == 2
    assert "damaged" in err


COMMANDS = [info.name or info.callback.__name__ for info in app.registered_commands]


@pytest.mark.parametrize("command", COMMANDS)
def test_every_help_has_an_example_that_can_be_typed_and_starts_nothing(command, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code, out, err = call(capsys, command, "--help")
    assert (code, err) == (0, "")
    assert "{" not in out.partition("Arguments:")[2]
    example = " ".join(out.partition("Example: ")[2].split())
    assert example.startswith(f"guiderail {command}")
    options = {word for word in example.split() if word.startswith("--")}
    assert options <= set(out.partition("Example: ")[0].split())
    assert list(tmp_path.iterdir()) == []


def test_help_names_the_choices(capsys):
    for command, words in (
        ("train", ("NarrowPassage", "skgrl", "tqc", "tqc_contact")),
        ("reproduce", ("table 3.3", "5.10")),
        ("bench", ("primitive", "simulation", "learner", "training", "Pouring")),
        ("stress", ("BncConnector", "Pouring")),
        ("film", (".jpg",)),
        ("generate", ("clamp-objects",)),
    ):
        out = call(capsys, command, "--help")[1]
        assert all(word in out for word in words), command


def test_help_needs_neither_pytorch_nor_drake():
    code = """
import sys
from guiderail.tools.command import main
for words in ("--version", "--help", "train --help", "study --help", "list tasks"):
    try:
        main(words.split())
    except SystemExit:
        pass
    assert not {'torch', 'pydrake', 'stable_baselines3', 'matplotlib'} & set(sys.modules), words
"""
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert result.returncode == 0, result.stderr


def test_a_shell_completes_commands_and_choices(monkeypatch, capsys):
    for words, expected in (("guiderail tra", "train"), ("guiderail train Nar", "NarrowPassage")):
        monkeypatch.setenv("_GUIDERAIL_COMPLETE", "complete_bash")
        monkeypatch.setenv("COMP_WORDS", words)
        monkeypatch.setenv("COMP_CWORD", str(len(words.split()) - 1))
        assert call(capsys)[1].split() == [expected]


def test_the_version_is_the_packages(capsys):
    assert call(capsys, "--version")[1] == f"guiderail {guiderail.__version__}\n"


def test_any_option_of_an_environment_can_be_trained_with(capsys, tmp_path):
    options = ["--env", "hold=3", "--env", "wall=0.75", "--episodes", 1, "--set", "net_arch=8"]
    assert call(capsys, "train", "Bead", "--out", tmp_path / "run", *options)[0] == 0
    environment = RunFolder(tmp_path / "run").config().environment
    assert (environment["action_repeat"], environment["wall"]) == (3, 0.75)


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1e-8", 1e-8),
        ("[0, 1]", (0, 1)),
        ("[1e3, 2]", (1000.0, 2)),
        ("true", True),
        ("arm", "arm"),
        ("null", None),
        ("2001-99-99", "2001-99-99"),
        ("a: b: c", "a: b: c"),
        ("[" * 99, "[" * 99),
    ],
)
def test_values_are_read_as_what_they_are(text, value):
    read = as_value(text)
    assert (read, type(read)) == (value, type(value))


def test_lists_can_be_read_by_a_program(capsys):
    listed = json.loads(call(capsys, "list", "--json")[1])
    assert {"tasks", "guidance", "learners", "presets"} <= listed.keys()
    assert {"NarrowPassage", "Pouring"} <= set(listed["tasks"])
    assert "1" in json.loads(call(capsys, "list", "Bead", "--json")[1])["action_repeat"]
    assert "ten in a row" in call(capsys, "list", "metrics")[1]
    # What `hard` stands for can be given option by option.
    assert "offset_range=[0.0026,0.003]" in call(capsys, "list", "BncConnector")[1]
    assert json.loads(call(capsys, "list", "GridClamp", "--json")[1])["difficulties"]["hard"]["force_limit"] == 10.0


def test_what_learned_nothing_stands_beside_the_policy(capsys, trained):
    out = call(capsys, "evaluate", trained, "--episodes", 2)[1]
    differences, header, table = out.partition(
        "policy               demonstration alone  white                constant\n"
    )
    assert "differs from the thesis in" in differences
    assert header
    for name in ("mean return", "collisions", "mean force [N]", "peak force [N]"):
        (line,) = (line for line in table.splitlines() if line.startswith(name + " "))
        assert len(line.removeprefix(name).split()) == 4


def test_stress_ends_with_what_it_found(capsys, tmp_path):
    code, out, err = call(capsys, "stress", "NarrowPassage", "--episodes", 2, "--out", tmp_path / "table.csv")
    assert code == 0
    assert json.loads(out)["all"]["episodes"] == 2
    assert "2 episodes" in err
    assert (tmp_path / "table.csv").exists()


def test_shipped_files_are_generated_as_they_are(capsys, tmp_path):
    for what, folder in (("connector-objects", bnc_connector.FOLDER), ("clamp-objects", grid_clamp.FOLDER)):
        assert call(capsys, "generate", what, "--out", tmp_path)[0] == 0
        for path in tmp_path.iterdir():
            assert path.read_bytes() == (folder / path.name).read_bytes(), path.name


STATION = """
from guiderail.diagrams.stations.registry import register_station


@register_station("desk", world="workcell", is_simulated=False)
def desk(world):
    raise NotImplementedError
"""


@pytest.mark.parametrize(
    ("typed", "robot"),
    [([], "iiwa14"), (["--robot", "panda"], "panda"), (["--env", "robot=panda"], "panda")],
)
def test_a_robot_and_what_is_imported_reach_whoever_learns_on_it(typed, robot, capsys, tmp_path, monkeypatch):
    asked = {}

    def learn(task, out, other, **more):
        asked.update(more, other=other)
        return {"run": str(out)}

    monkeypatch.setattr("guiderail.tools.hardware.train.train_on_robot", learn)
    monkeypatch.setattr(STATIONS, "_entries", {**STATIONS._entries})  # no other test has this one
    file = tmp_path / "desk.py"
    file.write_text(STATION)
    typed = ["train", "BncConnector", "--station", "desk", "--import", file, "--out", "new", "--rate", "0.5", *typed]
    assert call(capsys, *typed)[0] == 0
    assert (asked["other"].robot, asked["other"].rate) == (robot, 0.5)
    assert asked["given"]["imports"] == (str(file),)


@pytest.mark.parametrize(
    ("typed", "checkpoint", "words"),
    [
        (["train", "BncConnector", "--out"], True, "stopped; go on with --resume"),
        (["train", "BncConnector", "--out"], False, "stopped"),  # as of a robot, which goes on with nothing
        (["study", "connector", "--out"], False, "stopped; the same command goes on where it was"),
        (["evaluate"], False, "stopped"),
    ],
)
def test_whoever_stops_a_command_is_told_how_it_goes_on(typed, checkpoint, words, capsys, tmp_path, monkeypatch):
    def stop(**given):
        raise KeyboardInterrupt

    monkeypatch.setattr("guiderail.tools.cli.main.app", stop)
    if checkpoint:
        (tmp_path / "checkpoint").mkdir()
    for last in ([*typed, str(tmp_path)], [*typed[:-1], f"{typed[-1]}={tmp_path}"]):
        with pytest.raises(SystemExit) as end:
            main(last)
        assert end.value.code == 130
        assert capsys.readouterr().err.strip().removeprefix("guiderail: ") == words
