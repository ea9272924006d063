import json
import re
import subprocess
import sys
from pathlib import Path

import gymnasium
import numpy as np
import pandas as pd
import pytest
import typer

import guiderail
from guiderail.diagrams.tasks.registry import environment_id
from guiderail.models.common.errors import InputError
from guiderail.models.common.registry import SIBLINGS
from guiderail.models.primitives.kernels import KERNELS
from guiderail.tools.cli import main as main_module
from guiderail.tools.cli.app import to_json
from guiderail.tools.cli.main import COMMANDS, load_commands
from guiderail.tools.environments import as_value
from guiderail.tools.learning.run_folder import RunFolder
from oracles.commands import call
from research.studies import study_path

CONNECTOR = str(study_path("connector"))
OF_SIBLINGS = [(name, sibling) for sibling, names in SIBLINGS.items() for name in names]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["trian"], "did you mean train?"),
        (["xyz"], "choose one of"),
        (["train"], "--out"),
        (["train", "--out", "new"], "name a task"),
        (["train", "Pooring", "--out", "new"], "did you mean Pouring?"),
        (["train", "Bead", "--out", "new", "--guidance", "magic"], "kmp or skgrl"),
        (["train", "Bead", "--out", "new", "--algorithm", "dqn"], "sac, td3, tqc"),
        (["train", "Bead", "--out", "new", "--preset", "tqc_contct"], "did you mean tqc_contact?"),
        (["train", "Bead", "--out", "new", "--fixture-offset", "per_episode"], "no option 'fixture_offset'"),
        (["train", "Bead", "--out", "new", "--episodes", "0"], "the number of episodes must be a whole number"),
        (["train", "Bead", "--out", "new", "--episodes", "many"], "see guiderail train --help"),
        (["train", "Bead", "--out", "new", "--evaluate", "0"], "give at least 1, not 0"),
        (["train", "Bead", "--out", "new", "--station", "hardware"], "use guiderail train-on-robot TASK --out RUN"),
        (["train", "Bead", "--out", "new", "--seed", "-1"], "a seed must be a whole number"),
        (["train", "Bead", "--out", "new", "--set", "batch_size"], "name=value"),
        (["train", "Bead", "--out", "new", "--set", "batchsize=3"], "did you mean batch_size?"),
        (["train", "Bead", "--out", "new", "--set", "batch_size=0"], "greater than or equal to 1"),
        (["train", "--resume", "--out", "new"], "not a run"),
        (["train", "Bead", "--epsiodes", "3"], "did you mean --episodes?"),
        (["train", "Bead", "--out", "new", "--env", "action_repeat"], "--env takes name=value"),
        (["train", "Bead", "--out", "new", "--env", "action_repaet=2"], "did you mean action_repeat?"),
        (
            ["train", "Bead", "--out", "new", "--guidance", "kmp", "--env", "guidance=skgrl"],
            "given as kmp and as skgrl",
        ),
        (
            ["train", "Bead", "--out", "new", "--num-envs", "2", "--set", "num_envs=1"],
            "num_envs is given as 1 and as 2",
        ),
        (["train", "BncConnector", "--out", "new", "--robot", "panda"], "give --env robot=panda"),
        (["evaluate", "new"], "not a run"),
        (["visualize", "new", "--guidance", "kgrl"], "there is no option --guidance here: give --env guidance=kgrl"),
        (["evaluate", "new", "--station", "hardware"], "use guiderail deploy RUN --episodes N"),
        (["evaluate", "mypol.py", "--task", "Bead"], "mypol.py:FUNCTION"),
        (["evaluate", "nomod:zero", "--task", "Bead"], "to import for nomod:zero: give MODULE:FUNCTION or FILE.py"),
        (["evaluate", "Bead"], "Bead is a task: name the policy that acts in it"),
        (["evaluate", "NarrowPassage", "--policy", "scripted"], "'scripted' does not fit the observations"),
        (["visualize", "NarrowPassage"], "'scripted' does not fit the observations"),
        (["evaluate", ".", "--policy", "zero"], "name the task instead of a folder"),
        (["evaluate", "new", "--save", "x.yaml"], "demonstrations are .npz or .csv"),
        (["visualize", "Bead", "--policy", "scripte", "--image", "picture.png"], "no policy 'scripte'"),
        (["visualize", "Bead", "--policy", "zero", "--image", "picture.gif"], "a picture is .png"),
        (["visualize", "Bead", "--policy", "zero", "--image", "picture.png", "--episodes", "2"], "add --html"),
        (["visualize", "Bead", "--policy", "zero", "--video", "video.png"], "a video is .webp, .gif"),
        (["replay", "new"], "there is no command replay"),
        (["dataset"], "guiderail dataset needs a command: choose one of"),
        (["dataset", "validate", "new.npz"], "no file"),
        (["dataset", "fit-bounds", "new.npz", "--outputs", "x"], "whole numbers separated by commas"),
        (["dataset", "import", "new.csv", "--out", "new.npz", "--target", "1_0,0,0,0,0,0"], "takes 6 numbers"),
        (["template", "validate", "pouring", "--import", "new.py"], "no module, file or task folder new.py to import"),
        (["deploy", "new", "--import", "new.py"], "no module, file or task folder new.py to import"),
        (["template", "validate", "pourin"], "or one of end_effector_velocity, grid_clamp, pouring"),
        (["study", "connector.yaml", "--out", "new"], "there is no file connector.yaml"),
        (["study", CONNECTOR, "--out", "new", "--seeds", "1;2"], "whole numbers separated by commas"),
        (["teleoperate", "Puring"], "did you mean Pouring?"),
        (["teleoperate", "Pouring", "--json"], "give --record too"),
        *(
            ([*command, "--import", "none.py"], "there is no module, file or task folder none.py")
            for command in (
                ["visualize", "lab/Own"],
                ["certify", "lab/Own"],
                ["teleoperate", "lab/Own"],
                ["teleoperate", "lab/Own", "--record", "demonstrations.npz"],
            )
        ),
        (["train", "./peg", "--out", "new"], "there is no task.yaml in ./peg"),
        (["train", "BncConnector", "--out", "new", "--env", "offset_range=a,b"], "offset_range must be 2 numbers"),
        (["train", "BncConnector", "--out", "new", "--env", "bound=a"], "bound must be a number, not 'a'"),
        (["train", "lab/Own", "--out", "new"], "or --import the file that registers it"),
        (["sim-driver", "--seconds", "nan"], "seconds must be a positive number, not nan"),
        (["sim-driver", "--offset", "1.5"], "--offset takes 2 numbers"),
        (["demo", "--episodes", "0", "--out", "new"], "the number of episodes must be a whole number from 1 to"),
        (["deploy", "new", "--sim", "--robot-url", "udpm://239.255.76.67:7667"], "a bus of its own"),
        (["list", "metrix"], "did you mean metrics?"),
        *(
            ([*command, ""], f"{command[-1]} is empty: give a value, or leave it out")
            for command in (
                ["train", "NarrowPassage", "--out"],
                ["evaluate", "new", "--save"],
                ["create-task", "plug.stl", "socket.stl", "--out"],
                ["study", CONNECTOR, "--out"],
                ["demo", "--out"],
            )
        ),
        (["report", "run", "", "--out", "page.html"], "an argument is empty: give a value"),
        (["train", "NarrowPassage", "--out="], "--out is empty: give a value, or leave it out"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else None,
)
def test_command_prints_one_sentence_when_input_is_wrong(arguments, message, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code, out, err = call(capsys, *arguments)
    assert (code, out) == (2, "")
    assert err.startswith("guiderail: ")
    assert err.count("\n") == 1
    assert message in err
    assert list(tmp_path.iterdir()) == []


def test_visualize_refuses_a_baseline_for_a_run(capsys, bead_run):
    code, _, err = call(capsys, "visualize", bead_run, "--policy", "zero", "--image", "picture.png")
    assert code == 2
    assert err == "guiderail: --policy acts in a task: name the task instead of a folder, or leave --policy out\n"


def test_json_has_null_for_nan_and_infinity_at_any_depth():
    rows = [{"part": "round trip", "worst_ms": float("inf"), "median_ms": 1.5, "number": np.int64(3)}]
    (row,) = json.loads(to_json({"rows": rows}), parse_constant=pytest.fail)["rows"]
    assert row == {"part": "round trip", "worst_ms": None, "median_ms": 1.5, "number": 3}


@pytest.mark.parametrize("command", ["list", "evaluate", "visualize", "train", "report", "study"])
def test_command_refuses_a_path_that_is_too_long(command, capsys):
    options = ["--out", "out"] if command in ("train", "study") else []
    code, out, err = call(capsys, command, 5000 * "x", *options)
    assert (code, out) == (2, "")
    assert err.count("\n") == 1
    assert "(File name too long): name another path" in err


def test_train_refuses_an_existing_folder(capsys, bead_run):
    before = {path: path.read_bytes() for path in bead_run.rglob("*") if path.is_file()}
    code, _, err = call(capsys, "train", "Bead", "--out", bead_run)
    assert code == 2
    assert "--resume" in err
    assert before == {path: path.read_bytes() for path in bead_run.rglob("*") if path.is_file()}


def test_demo_refuses_the_folder_of_another_run(capsys, bead_run):
    code, _, err = call(capsys, "demo", "--out", bead_run)
    assert code == 2
    assert "already exists" in err
    assert (bead_run / "episodes.csv").exists()


def test_train_writes_all_files_of_a_run(capsys, tmp_path):
    options = ["--episodes", 2, "--set", "net_arch=8", "--json"]
    code, out, err = call(capsys, "train", "Bead", "--out", tmp_path / "run", *options)
    assert code == 0
    assert json.loads(out)["episodes"] == 2
    assert "Bead 2/2" in err
    assert err.index("training is complete; drawing the learning curve") > err.index("Bead 2/2")
    expected = {"config.yaml", "episodes.csv", "checkpoint", "policy.safetensors", "policy.json", "learning_curve.png"}
    assert expected <= {path.name for path in (tmp_path / "run").iterdir()}


def test_train_evaluates_the_policy_when_requested(capsys, tmp_path):
    options = ["--episodes", 1, "--set", "net_arch=8", "--no-pictures", "--json"]
    code, out, _ = call(capsys, "train", "Bead", "--out", tmp_path / "run", "--evaluate", 3, *options)
    assert code == 0
    result = json.loads(out)
    assert result["held_out_episodes"] == 3
    (stored,) = (tmp_path / "run" / "held_out").glob("policy-*.csv")
    assert result["held_out_success_rate"] == pd.read_csv(stored)["success"].mean()
    evaluated = json.loads(call(capsys, "evaluate", tmp_path / "run", "--episodes", 3, "--json")[1])
    assert result["held_out_mean_return"] == evaluated["mean_return"]


def test_evaluate_prints_one_json_object(capsys, bead_run):
    code, out, err = call(capsys, "evaluate", bead_run, "--episodes", 3, "--json")
    assert code == 0
    assert "series 1 of 4: policy 3/3" in err
    result = json.loads(out)
    statistics = {"success_rate", "demonstration_success_rate", "episodes", "max_commanded_violation", "peak_force"}
    assert statistics <= result.keys()
    assert result["episodes"] == 3
    assert 0 <= result["success_rate"] <= 1


def test_evaluate_refuses_a_damaged_policy(capsys, bead_run):
    weights = bead_run / "policy.safetensors"
    weights.write_bytes(weights.read_bytes()[:-10])
    code, _, err = call(capsys, "evaluate", bead_run)
    assert code == 2
    assert "damaged" in err


def commands():
    """Yield the name of every command, after the name of its group if it has one, as a tuple."""
    for name, command in typer.main.get_command(load_commands()).commands.items():
        yield from ((name, part) for part in command.commands) if hasattr(command, "commands") else [(name,)]


@pytest.mark.parametrize("command", [*commands()], ids=" ".join)
def test_help_has_a_valid_example_and_writes_nothing(command, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code, out, err = call(capsys, *command, "--help")
    assert (code, err) == (0, "")
    assert "{" not in out.partition("Arguments:")[2]
    example = " ".join(out.partition("Example: ")[2].split())
    assert example.startswith(f"guiderail {' '.join(command)}")
    options = {word for word in example.split() if word.startswith("--")}
    assert options <= set(out.partition("Example: ")[0].split())
    assert list(tmp_path.iterdir()) == []


def test_every_command_is_listed_with_its_module():
    listed = dict.fromkeys(COMMANDS, "guiderail.tools.cli.commands")
    listed |= {name: f"guiderail_{sibling}.cli" for name, sibling in OF_SIBLINGS if ":" not in name}
    for name, command in typer.main.get_command(load_commands()).commands.items():
        callbacks = [part.callback for part in getattr(command, "commands", {"": command}).values()]
        assert {callback.__module__ for callback in callbacks} == {listed.pop(name)}
    assert not listed


@pytest.mark.parametrize(("name", "sibling"), [(name, key) for name, key in OF_SIBLINGS if ":" not in name])
def test_command_of_missing_sibling_names_the_line_that_installs_it(name, sibling, capsys, monkeypatch):
    monkeypatch.setattr(main_module, "find_plugins", lambda kind: iter(()))
    code, _, err = call(capsys, name)
    line = f'guiderail {name} needs guiderail-{sibling}, which is not installed: pip install "guiderail[{sibling}]"'
    assert (code, err) == (2, f"guiderail: {line}\n")


def test_missing_library_of_the_system_is_named_with_its_package(capsys, monkeypatch):
    def fail(name=""):
        raise ImportError("libglib-2.0.so.0: cannot open shared object file: No such file", name="pydrake.common")

    monkeypatch.setattr(main_module, "load_commands", fail)
    message = (
        "Drake needs libglib-2.0.so.0, which this machine lacks: install it (Debian, Ubuntu: apt install libglib2.0-0)"
    )
    assert call(capsys, "list") == (2, "", f"guiderail: {message}\n")


def test_import_that_fails_inside_a_dependency_is_a_bug(capsys, monkeypatch):
    def fail(name=""):
        raise ImportError("cannot import name 'a' from 'pydrake'", name="pydrake")

    monkeypatch.setattr(main_module, "load_commands", fail)
    with pytest.raises(ImportError, match="cannot import name"):
        call(capsys, "list")


def test_help_lists_the_choices(capsys):
    for command, choices in (
        (["train"], ("NarrowPassage", "skgrl", "tqc", "tqc_contact", "aligned", "center_of_pressure", "hand_shaped")),
        (["visualize"], (".jpg", ".webp")),
        (["template", "validate"], ("pouring",)),
        (["evaluate"], ("uniform_random", "bang_bang")),
    ):
        out = call(capsys, *command, "--help")[1]
        assert all(choice in out for choice in choices), command


@pytest.mark.parametrize(
    "text",
    [
        "0", "-7", "007", "1.50", "-0.0", "word", "nan", "inf", "true", "null", "no", "a-b", "1e-3", "1_0", "1_0.5",
        "\u0661",
    ],
)  # fmt: skip
def test_as_value_reads_plain_text_as_yaml_does(text):
    (expected,) = as_value(f"[{text}]")
    assert repr(as_value(text)) == repr(expected)


@pytest.mark.parametrize(
    "arguments",
    [
        ["visualize", "Foreign", "--policy", "zero", "--html", "new.html"],
        ["visualize", "Foreign", "--policy", "zero", "--image", "new.png"],
        ["teleoperate", "Foreign"],
    ],
)
def test_environment_without_a_task_is_refused(arguments, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    entry = "gymnasium.envs.classic_control.pendulum:PendulumEnv"
    gymnasium.register(environment_id("Foreign"), entry_point=entry)
    code, _, err = call(capsys, *arguments)
    gymnasium.registry.pop(environment_id("Foreign"))
    assert (code, err.count("\n")) == (2, 1)
    assert "Foreign has no task of guiderail" in err
    assert not list(tmp_path.iterdir())


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="this machine has no /dev/full")
def test_error_of_writing_standard_output_is_named():
    with open("/dev/full", "w") as full:
        command = [sys.executable, "-m", "guiderail", "list", "tasks"]
        result = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True)
    assert result.returncode == 2
    assert result.stderr.startswith("guiderail: the output cannot be written (No space left on device): ")
    assert result.stderr.count("\n") == 1


def test_help_and_mistakes_of_train_need_no_slow_imports(tmp_path):
    (tmp_path / "notes.txt").write_text("")  # `--out .` is refused, because the folder is not empty
    code = """
import sys
from guiderail.tools.cli.main import main
NAMES = (
    "", "--guidance nope", "--env guidance=nope", "--station nope", "--algorithm nope", "--preset nope", "--log nope",
    "--out .",
)
VALUES = (
    "--set nope=1", "--preset tqc_fast --set batch_size=0", "--episodes 0", "--seed -1",
    "--env nope=1", "--env friction=9", "--env time_step=-1", "--env action_scale=-1", "--env offset_range=1",
)
HELP = ("--version", "--help", "study --help", "evaluate --help", "list tasks", "train --help")

def run(slow, code, *arguments):
    try:
        main(arguments)
    except SystemExit as end:
        assert end.code == code, arguments
    assert not slow & set(sys.modules), arguments

for line in NAMES:
    out = ["--out", "run"] if line else []
    run({"pydrake", "pandas", "torch", "scipy"}, 2, "train", "BncConnector", *out, *line.split())
for line in HELP:
    run({"torch", "stable_baselines3", "matplotlib", "pydrake"}, 0, *line.split())
for line in VALUES:
    run({"torch", "stable_baselines3"}, 2, "train", "BncConnector", "--out", "run", *line.split())
"""
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    assert len(result.stderr.splitlines()) == 17, result.stderr
    assert not (tmp_path / "run").exists()


def test_train_draws_no_pictures_when_none_are_wanted(capsys, tmp_path):
    options = ["--no-pictures", "--episodes", 1, "--set", "net_arch=8"]
    assert call(capsys, "train", "Bead", "--out", tmp_path / "run", *options)[0] == 0
    assert not {"replay.html", "learning_curve.png"} & {path.name for path in (tmp_path / "run").iterdir()}


def test_completion_offers_commands_and_choices(monkeypatch, capsys):
    for line, expected in (("guiderail eva", "evaluate"), ("guiderail train Nar", "NarrowPassage")):
        monkeypatch.setenv("_GUIDERAIL_COMPLETE", "complete_bash")
        monkeypatch.setenv("COMP_WORDS", line)
        monkeypatch.setenv("COMP_CWORD", str(len(line.split()) - 1))
        assert call(capsys)[1].split() == [expected]


def test_version_is_the_version_of_the_package(capsys):
    assert call(capsys, "--version")[1] == f"guiderail {guiderail.__version__}\n"


def test_train_accepts_any_option_of_an_environment(capsys, tmp_path):
    options = ["--env", "action_repeat=3", "--env", "wall=0.75", "--episodes", 1, "--set", "net_arch=8"]
    assert call(capsys, "train", "Bead", "--out", tmp_path / "run", *options)[0] == 0
    environment = RunFolder(tmp_path / "run").config().environment
    assert (environment["action_repeat"], environment["wall"]) == (3, 0.75)


def test_list_names_and_omits_broken_entry_points(capsys, tmp_path, monkeypatch):
    information = tmp_path / "lab_broken-1.0.dist-info"
    information.mkdir()
    (information / "METADATA").write_text("Metadata-Version: 2.1\nName: lab_broken\nVersion: 1.0\n")
    (information / "entry_points.txt").write_text("[guiderail]\nkernel:lab = lab_broken:Kernel\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    for name in ("_plugins", "_packaged", "_points", "broken"):
        monkeypatch.delitem(vars(KERNELS), name, raising=False)
    sentence = "the kernel 'lab' of the installed package lab_broken cannot be used: importing lab_broken:Kernel failed"
    try:
        code, out, _ = call(capsys, "list", "kernels")
        kernels, broken = out.splitlines()
        assert code == 0
        assert "lab" not in re.findall(r"\w+", kernels)
        assert "matern52" in kernels
        assert broken.startswith(f"broken: {sentence}")
        listed = json.loads(call(capsys, "list", "--json")[1])
        assert "lab" not in listed["kernels"]
        assert listed["broken"]["kernels"]["lab"].startswith(sentence)
        code, _, err = call(capsys, "visualize", "NarrowPassage", "--policy", "zero", "--env", "kernel=lab")
        assert code == 2
        assert sentence in err
    finally:
        for name in ("_plugins", "_packaged", "_points", "broken"):
            vars(KERNELS).pop(name, None)


def test_list_prints_json_options_and_metrics(capsys):
    listed = json.loads(call(capsys, "list", "--json")[1])
    assert {"tasks", "guidance", "learners", "presets", "drivers", "kernels", "engines"} <= listed.keys()
    assert {"fci"} <= listed["drivers"].keys()
    assert {"matern52", "squared_exponential"} <= listed["kernels"].keys()
    assert {"process"} <= listed["engines"].keys()
    text = call(capsys, "list")[1].splitlines()
    assert {line.split()[0] for line in text} >= {"drivers", "kernels", "engines"}
    assert {"NarrowPassage", "Pouring"} <= set(listed["tasks"])
    assert "1" in json.loads(call(capsys, "list", "Bead", "--json")[1])["action_repeat"]
    assert "first ten consecutive successes" in call(capsys, "list", "metrics")[1]
    # The options that `difficulty=hard` sets are listed.
    connector = call(capsys, "list", "BncConnector")[1]
    assert "offset_range=[0.0026,0.003]" in connector
    assert "with station=arm or hardware: " in connector
    assert json.loads(call(capsys, "list", "GridClamp", "--json")[1])["difficulties"]["hard"]["force_limit"] == 10.0


def test_evaluate_prints_a_column_for_each_baseline(capsys, bead_run):
    out = call(capsys, "evaluate", bead_run, "--episodes", 2)[1]
    before, header, table = out.partition("policy               demonstration alone  uniform_random       constant\n")
    assert header
    assert before.strip() == ""
    for name in ("mean return", "collisions", "mean force [N]", "peak force [N]"):
        (line,) = (line for line in table.splitlines() if line.startswith(name + " "))
        assert len(line.removeprefix(name).split()) == 4


def test_policy_file_without_its_ending_is_named(capsys, tmp_path):
    (tmp_path / "sac.zip").touch()
    code, _, err = call(capsys, "evaluate", tmp_path / "sac", "--task", "Bead")
    assert code == 2
    assert f"to evaluate the file {tmp_path / 'sac.zip'}, give its whole name" in err


def test_visualize_prints_a_line_before_the_simulation(capsys, tmp_path, monkeypatch):
    def simulate(*arguments, **options):
        raise InputError("stopped")

    monkeypatch.setattr("guiderail.tools.visualization.replay.rollout", simulate)
    arguments = ["visualize", "NarrowPassage", "--policy", "zero", "--html", tmp_path / "replay.html"]
    code, _, err = call(capsys, *arguments)
    assert code == 2
    assert err.startswith("guiderail: simulating held-out episodes (1) before and after learning, then writing ")
    assert err.endswith("\nguiderail: stopped\n")
