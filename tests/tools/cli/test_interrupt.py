"""Ctrl-C: every command ends with exit code 130 and one line, which says how to resume if that is possible."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from research.studies import study_path

TESTS = str(Path(__file__).parents[2])
TRAINS = """
import signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore it
import bead
bead.register()
from guiderail.tools.cli.main import main
from guiderail.tools.learning import trainer

def save(*arguments, write=trainer.write_checkpoint):
    write(*arguments)
    print("saved", flush=True)

trainer.write_checkpoint = save
main(sys.argv[1:])
"""
# The function that the command calls sends the signal to its own process.
STOPS = """
import os, signal, sys
from importlib import import_module
signal.signal(signal.SIGINT, signal.default_int_handler)
from guiderail.tools.cli.main import main
module, name, *words = sys.argv[1:]
setattr(import_module(module), name, lambda *given, **named: os.kill(os.getpid(), signal.SIGINT))
main(words)
"""


def test_interrupted_training_names_resume(tmp_path):
    paths = os.pathsep.join([TESTS, f"{TESTS}/tools", *filter(None, sys.path)])
    words = ["train", "Bead", "--out", tmp_path / "run", "--episodes", "1000000", "--set", "net_arch=8"]
    with subprocess.Popen(
        [sys.executable, "-c", TRAINS, *words],
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
    ("place", "words", "expected"),
    [
        ("experiments.study.study_command", ["study", study_path("connector")], "; the same command resumes it"),
        ("evaluation.evaluate.evaluate", ["evaluate", "NarrowPassage", "--policy", "zero"], ""),
        ("parts.create_task.create_task", ["create-task", "a.stl", "b.stl", "--unit", "mm"], ""),
    ],
    ids=lambda value: value[0] if isinstance(value, list) else "",
)
def test_interrupted_command_ends_with_a_line(place, words, expected, forks, tmp_path):
    module, _, name = f"guiderail.tools.{place}".rpartition(".")
    out = [] if words[0] == "evaluate" else ["--out", tmp_path / "out"]
    result = forks.run("-c", STOPS, module, name, *words, *out, folder=tmp_path)
    assert (result.returncode, result.stderr) == (130, f"guiderail: stopped{expected}\n")
