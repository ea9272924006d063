import json

import pytest

from guiderail.tools.command import main
from guiderail.tools.figures import FIGURES
from guiderail.tools.learning.run_folder import RunFolder
from guiderail.tools.learning.train import train


def call(capsys, *arguments):
    """Exit code, standard output and standard error of the command."""
    with pytest.raises(SystemExit) as end:
        main([str(argument) for argument in arguments])
    out, err = capsys.readouterr()
    return end.value.code, out, err


@pytest.fixture
def trained(bead_config, tmp_path):
    train(RunFolder(tmp_path / "run"), bead_config)
    return tmp_path / "run"


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ([], "choose one of train, evaluate"),
        (["trian"], "choose one of train, evaluate"),
        (["train"], "--out"),
        (["train", "--out", "new"], "name a task"),
        (["train", "Pooring", "--out", "new"], "NarrowPassage"),
        (["train", "Bead", "--out", "new", "--guidance", "magic"], "kmp or skgrl"),
        (["train", "NarrowPassage", "--out", "new", "--guidance", "magic"], "safe_residual, kgrl, skgrl"),
        (["train", "Bead", "--out", "new", "--algorithm", "ppo"], "sac, tqc"),
        (["train", "Bead", "--out", "new", "--preset", "best"], "robust"),
        (["train", "Bead", "--out", "new", "--uncertainty", "disc"], "takes guidance"),
        (["train", "Bead", "--out", "new", "--episodes", "0"], "at least one episode"),
        (["train", "Bead", "--out", "new", "--episodes", "many"], "see guiderail train --help"),
        (["train", "Bead", "--out", "new", "--seed", "-1"], "a seed is a whole number"),
        (["train", "Bead", "--out", "new", "--set", "batch_size"], "name=value"),
        (["train", "Bead", "--out", "new", "--set", "batchsize=3"], "batch_size"),
        (["train", "Bead", "--out", "new", "--set", "batch_size=0"], "at least 1"),
        (["train", "Bead", "--out", "new", "--set", "learning_rate=fast"], "give a value such as"),
        (["train", "--resume", "--out", "new"], "not a run"),
        (["train", "Bead", "--fast"], "--fast"),
        (["evaluate", "new"], "not a run"),
        (["replay", "new"], "not a run"),
        (["plot", "new"], "not a run"),
        (["record", "new", "--out", "demos.npz"], "not a run"),
        (["check", "new.npz"], "no file"),
        (["reproduce", "1.1"], ", ".join(FIGURES)),
        (["reproduce", "5.6", "--seeds", "0"], "at least one seed"),
        (["study", "Bead", "--out", "new", "--seeds", "0"], "at least one seed"),
        (["bench", "everything"], "primitive or simulation"),
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
    options = ["--episodes", 2, "--set", "units=8", "--json"]
    code, out, err = call(capsys, "train", "Bead", "--out", tmp_path / "run", *options)
    assert code == 0
    assert json.loads(out)["episodes"] == 2
    assert "Bead 2/2" in err
    expected = {"config.yaml", "episodes.csv", "checkpoint", "policy.safetensors", "policy.json", "learning_curve.png"}
    assert expected <= {path.name for path in (tmp_path / "run").iterdir()}


def test_evaluation_can_be_read_by_a_program(capsys, trained):
    code, out, err = call(capsys, "evaluate", trained, "--episodes", 3, "--json")
    assert (code, err) == (0, "")
    result = json.loads(out)
    assert {"success_rate", "demonstration_success_rate", "episodes", "worst_violation", "peak_force"} <= result.keys()
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


def test_help_needs_neither_pytorch_nor_drake():
    import subprocess
    import sys

    code = "import sys; from guiderail.tools.command import main\ntry: main(['--help'])\nexcept SystemExit: pass\n"
    check = code + "assert not {'torch', 'pydrake', 'stable_baselines3', 'matplotlib'} & set(sys.modules)"
    result = subprocess.run([sys.executable, "-c", check], capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
