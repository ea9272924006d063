"""Command lines of the research programs."""

import json

import numpy as np
import pytest

from guiderail.models.primitives.mixture import STORED_PATH
from research.action_fuzzing.__main__ import main as action_fuzzing
from research.benchmarks import BENCHMARKS
from research.benchmarks.__main__ import main as benchmarks
from research.certificates import main as certificates
from research.command import print_result, run_program
from research.figures.__main__ import main as figures
from research.generate.__main__ import main as generate
from research.results.__main__ import main as results
from research.smoothness import main as smoothness

PROGRAMS = (action_fuzzing, benchmarks, certificates, figures, generate, results, smoothness)


def run(capsys, program, *arguments):
    """Run a program; return exit code, standard output and standard error of a program."""
    with pytest.raises(SystemExit) as ended:
        run_program(program, [str(argument) for argument in arguments])
    out, err = capsys.readouterr()
    return ended.value.code, out, err


@pytest.mark.parametrize("program", PROGRAMS)
def test_help_has_an_example(program, capsys):
    with pytest.raises(SystemExit) as ended:
        program(["--help"])
    assert ended.value.code == 0
    assert "Example: python -m research." in " ".join(capsys.readouterr().out.split())


@pytest.mark.parametrize(
    ("program", "arguments", "message"),
    [
        (figures, ["1.1"], "no figure '1.1'"),
        (figures, ["5.66"], "did you mean 5.6?"),
        (figures, ["5.6", "--seeds", "0"], "at least one seed"),
        (figures, ["5.6", "--seeds", "two"], "--seeds"),
        (figures, [], "FIGURE"),
        (benchmarks, ["primitve"], "did you mean primitive?"),
        (benchmarks, ["learner", "Pouring"], "has no task: leave task out"),
        (benchmarks, ["learner", "--picture", "learner.png"], "leave --picture out"),
        (benchmarks, ["training", "Puring"], "did you mean Pouring?"),
        (benchmarks, ["training", "Bead", "--env", "wal=1"], "did you mean wall?"),
        (benchmarks, ["training", "Bead", "--env", "wall"], "--env takes name=value"),
        (benchmarks, ["training", "lab/Own", "--import", "none.py"], "there is no module, file or task folder none.py"),
        (action_fuzzing, ["BncConector"], "did you mean BncConnector?"),
        (action_fuzzing, ["Pouring", "--episodes", "0"], "at least one episode"),
        (action_fuzzing, ["all"], "give --steps"),
        (generate, ["conector-objects"], "did you mean connector-objects?"),
        (generate, ["connector-objects", "--out", "nowhere"], "make it first"),
        (certificates, ["--out", "new", "--attack", "3"], "unrecognized arguments"),
        (certificates, ["none.yaml", "--out", "new"], "there is no file none.yaml"),
        (smoothness, ["--out", "new", "--episodes", "0"], "at least one episode"),
        (results, ["nowhere"], "holds no table of a study"),
    ],
)
def test_wrong_input_is_one_sentence_with_exit_code_2(program, arguments, message, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code, out, err = run(capsys, program, *arguments)
    assert (code, out) == (2, "")
    assert message in err
    assert err.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_generator_writes_into_the_given_folder(tmp_path, capsys):
    assert run(capsys, generate, "mixtures", "--out", tmp_path)[0] == 0
    with np.load(tmp_path / STORED_PATH.name) as written, np.load(STORED_PATH) as stored:
        assert set(written.files) == set(stored.files)
        for name in stored.files:
            np.testing.assert_allclose(written[name], stored[name], rtol=1e-6, atol=1e-9)
    assert run(capsys, generate, "clamp-objects", "--out", tmp_path)[0] == 0
    assert any(tmp_path.iterdir())


def test_benchmark_prints_one_json_object(capsys, monkeypatch):
    monkeypatch.setattr("research.benchmarks.simulation.measure", lambda: {"gantry": {"real_time_factor": 12.0}})
    assert "simulation" in BENCHMARKS
    code, out, _ = run(capsys, benchmarks, "simulation", "--json")
    assert code == 0
    assert json.loads(out) == {"gantry": {"real_time_factor": 12.0}}


def test_non_finite_numbers_are_null_in_json(capsys):
    print_result({"slack": float("-inf"), "rows": [float("nan"), 1.0]}, as_json=True)
    assert json.loads(capsys.readouterr().out) == {"slack": None, "rows": [None, 1.0]}


def test_fuzzing_prints_one_json_object_without_non_finite_numbers(capsys, monkeypatch):
    result = {"all": {"peak_force": float("nan"), "max_commanded_violation": float("-inf")}, "failures": ["one"]}
    monkeypatch.setattr("research.action_fuzzing.__main__.fuzz", lambda *_, **__: result)
    code, out, _ = run(capsys, action_fuzzing, "Pouring", "--json")
    assert code == 1
    assert json.loads(out, parse_constant=pytest.fail) == {
        "all": {"peak_force": None, "max_commanded_violation": None},
        "failures": ["one"],
    }


def test_interrupted_program_exits_with_130(capsys):
    def interrupted(arguments):
        raise KeyboardInterrupt

    assert run(capsys, interrupted)[::2] == (130, "research: interrupted\n")
