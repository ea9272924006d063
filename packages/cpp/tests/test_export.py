"""Exported skills in C++: laws equal to Python's, and a controller and a node with a double of ROS 2."""

import functools
import json
import re
import shutil
import subprocess
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest
from random_laws import LAWS, TOLERANCE, TOLERANCES
from safetensors.numpy import load, save

from guiderail.models.common.errors import InputError
from guiderail.models.laws.primitive import PrimitiveLaw
from guiderail.models.primitives import LcNsKmp, LinearConstraints, ReferenceTrajectory
from guiderail_cpp.arrays import primitive_arrays
from guiderail_cpp.project import export_cpp
from guiderail_cpp.recording import record_skill

needs_compiler = pytest.mark.skipif(shutil.which("g++") is None, reason="there is no C++ compiler (g++)")
HERE = Path(__file__).parent
SOURCE = Path(str(files("guiderail_cpp")))
REPLAY = SOURCE / "files/test/replay.cpp"
STEPS = 480  # more than the steps of an episode, so that a reset is replayed, too
# Sanitizers without optimization: a program is compiled three times as fast.
SANITIZED = ("-O0", "-fsanitize=address,undefined", "-fno-sanitize-recover=all", "-I", SOURCE / "files")
RUNNER_TEST = HERE / "runner_test.cpp"


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """Return a function that exports a pretrained skill once, with two recorded episodes, and returns its folder."""
    root = tmp_path_factory.mktemp("skills")

    @functools.cache
    def export(name):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(record_skill, "__defaults__", (2, 0))
            export_cpp(f"pretrained:{name}", root / name)
        return root / name

    return export


@pytest.fixture(scope="module")
def compiled(tmp_path_factory):
    """Return a function that compiles a program once and returns its path."""

    @functools.cache
    def compile_program(source, *options):
        command = ["g++", "-std=c++17", "-Wall", "-Wextra", "-Werror", "-ffp-contract=off", *options]
        program = tmp_path_factory.mktemp("programs") / source.stem
        subprocess.run([*command, "-I", SOURCE / "include", source, "-o", program], check=True)
        return program

    return compile_program


def run(program, *files):
    result = subprocess.run([program, *files], capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout


def replay(compiled, data, recording, tolerance=TOLERANCE):
    """Replay a recording by an optimized and by a sanitized program; return what they print."""
    files = data, recording, str(tolerance)
    return run(compiled(REPLAY, "-O1"), *files), run(compiled(RUNNER_TEST, *SANITIZED), "replay", *files)


@needs_compiler
@pytest.mark.parametrize("law", LAWS)
def test_law_equals_python_to_1e_12_without_allocations(law, compiled, tmp_path):
    data, recording = (tmp_path / name for name in ("data.safetensors", "recording.safetensors"))
    for path, content in zip((data, recording), LAWS[law](STEPS), strict=True):
        path.write_bytes(content)
    for printed in replay(compiled, data, recording, TOLERANCES.get(law, TOLERANCE)):
        assert re.search(r"^\d+ steps, .* 0 allocations", printed)


@needs_compiler
def test_replay_fails_when_a_command_differs(compiled, tmp_path):
    data, recording = LAWS["governor"](50)
    (tmp_path / "data").write_bytes(data)
    arrays = load(recording)
    arrays["replay/reference"][-1, 0] += 2e-12
    (tmp_path / "recording").write_bytes(save(arrays))
    command = [compiled(REPLAY, "-O1"), tmp_path / "data", tmp_path / "recording"]
    assert subprocess.run(command, capture_output=True, check=False).returncode == 1


@needs_compiler
@pytest.mark.parametrize("name", ["connector", "passage", "clamp", "pouring"])
def test_exported_skill_replays_the_commands_of_its_environment(name, exported, compiled):
    folder = exported(name)
    for file in [*(SOURCE / "include").rglob("*.hpp"), REPLAY]:  # compiled once for all skills
        copied = folder / ("test/replay.cpp" if file == REPLAY else file.relative_to(SOURCE))
        assert copied.read_bytes() == file.read_bytes()
    for printed in replay(compiled, folder / "skill.safetensors", folder / "test/recording.safetensors"):
        assert " 0 allocations" in printed


@needs_compiler
def test_controller_and_node_run_the_skill_with_a_double_of_ros2(exported, compiled):
    folder = exported("connector")
    program = compiled(HERE / "ros2_test.cpp", "-O0", "-I", HERE / "ros2_double", "-I", folder / "ros2/src")
    run(program, folder / "skill.safetensors", folder / "test/recording.safetensors")


@needs_compiler
def test_runner_survives_wrong_measurements_and_keeps_its_limits(exported, compiled):
    folder = exported("connector")
    program = compiled(RUNNER_TEST, *SANITIZED)
    run(program, folder / "skill.safetensors", folder / "test/recording.safetensors")
    run(program, exported("pouring") / "skill.safetensors")  # damages a template, too


def test_description_lists_signals_and_action(exported):
    skill = json.loads((exported("clamp") / "skill.json").read_text())
    assert skill["signals"] == {"pose": 3, "wrench": 3}
    assert skill["frames"] == ["hole"]
    assert [entry["name"] for entry in skill["action"]] == ["input 0", "input 1", "input 2"]


def test_export_refuses_equal_bounds_when_it_has_a_history():
    reference = ReferenceTrajectory(np.arange(4.0), np.zeros((4, 2)), np.tile(1e-4 * np.eye(2), (4, 1, 1)))
    constraints = LinearConstraints.box([0.0, -1.0], [0.0, 1.0])
    with pytest.raises(InputError, match="equal lower and upper bounds"):
        primitive_arrays(PrimitiveLaw(LcNsKmp(reference, constraints=constraints, history=2)))


def test_export_refuses_a_folder_that_exists(tmp_path):
    with pytest.raises(InputError, match="exists"):
        export_cpp("pretrained:connector", tmp_path)
