"""Ctrl-C ends a command with exit code 130 and one line, which names how to resume if the command can be resumed."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from research.studies import study_path

TESTS = str(Path(__file__).parents[2])
# Program that runs a command and prints a line after every checkpoint.
TRAINING_PROGRAM = """
import signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)  # jobs in a shell's background ignore SIGINT
import bead
bead.register()
from guiderail.tools.cli.main import main
from guiderail.tools.learning.trainer import TrainingLoop

def save(loop, write=TrainingLoop.write_checkpoint):
    write(loop)
    print("saved", flush=True)

TrainingLoop.write_checkpoint = save
main(sys.argv[1:])
"""
# Program that runs a command in which the function of the first two arguments sends SIGINT to its own process.
INTERRUPTED_PROGRAM = """
import os, signal, sys
from importlib import import_module
signal.signal(signal.SIGINT, signal.default_int_handler)
from guiderail.tools.cli.main import main
module, name, *arguments = sys.argv[1:]
setattr(import_module(module), name, lambda *values, **options: os.kill(os.getpid(), signal.SIGINT))
main(arguments)
"""


def test_interrupted_training_names_resume(tmp_path):
    paths = os.pathsep.join([TESTS, f"{TESTS}/tools", *filter(None, sys.path)])
    arguments = ["train", "Bead", "--out", tmp_path / "run", "--episodes", "1000000", "--set", "net_arch=8"]
    with subprocess.Popen(
        [sys.executable, "-c", TRAINING_PROGRAM, *arguments],
        env=os.environ | {"PYTHONPATH": paths},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as training:
        assert training.stdout is not None
        next(line for line in training.stdout if "saved" in line)
        training.send_signal(signal.SIGINT)
        message = training.communicate(timeout=60)[1]
    assert training.returncode == 130
    assert message.splitlines()[-1] == "guiderail: stopped; resume with --resume"


@pytest.mark.parametrize(
    ("function", "arguments", "hint"),
    [
        ("guiderail_studies.study.study_command", ["study", study_path("connector")], "; the same command resumes it"),
        ("guiderail.tools.evaluation.evaluate.evaluate", ["evaluate", "NarrowPassage", "--policy", "zero"], ""),
        ("guiderail_parts.create_task.create_task", ["create-task", "a.stl", "b.stl", "--unit", "mm"], ""),
    ],
    ids=lambda value: value[0] if isinstance(value, list) else "",
)
def test_interrupted_command_ends_with_a_line(function, arguments, hint, forks, tmp_path):
    module, _, name = function.rpartition(".")
    out = [] if arguments[0] == "evaluate" else ["--out", tmp_path / "out"]
    result = forks.run("-c", INTERRUPTED_PROGRAM, module, name, *arguments, *out, folder=tmp_path)
    assert (result.returncode, result.stderr) == (130, f"guiderail: stopped{hint}\n")
