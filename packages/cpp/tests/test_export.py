"""Exported folder: it builds, replays its recording, and runs as a controller and a node with a double of ROS 2."""

import json
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from guiderail.models.common.errors import InputError
from guiderail.models.laws.primitive import PrimitiveLaw
from guiderail.models.primitives import LcNsKmp, LinearConstraints, ReferenceTrajectory
from guiderail_cpp.arrays import primitive_arrays
from guiderail_cpp.project import export_cpp

needs_compiler = pytest.mark.skipif(shutil.which("g++") is None, reason="there is no C++ compiler (g++)")
HERE = Path(__file__).parent


def compile_program(folder, source, program, *options):
    command = ["g++", "-std=c++17", "-O2", "-Wall", "-Wextra", "-Werror", "-ffp-contract=off", *options]
    subprocess.run([*command, "-I", folder / "include", source, "-o", program], check=True)


@needs_compiler
@pytest.mark.parametrize("name", ["connector", "passage", "clamp", "pouring"])
def test_exported_skill_replays_the_commands_of_its_environment(name, tmp_path):
    folder = tmp_path / "skill"
    export_cpp(f"pretrained:{name}", folder)
    compile_program(folder, folder / "test/replay.cpp", tmp_path / "replay")
    command = [tmp_path / "replay", folder / "skill.safetensors", folder / "test/recording.safetensors"]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stdout + result.stderr


@needs_compiler
def test_controller_and_node_run_the_skill_with_a_double_of_ros2(tmp_path):
    folder = tmp_path / "skill"
    export_cpp("pretrained:connector", folder)
    includes = ["-I", HERE / "ros2_double", "-I", folder / "ros2/src"]
    compile_program(folder, HERE / "ros2_test.cpp", tmp_path / "ros2_test", *includes)
    command = [tmp_path / "ros2_test", folder / "skill.safetensors", folder / "test/recording.safetensors"]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stdout + result.stderr


@needs_compiler
def test_runner_survives_wrong_measurements_and_keeps_its_limits(tmp_path):
    folder = tmp_path / "skill"
    export_cpp("pretrained:connector", folder)
    sanitizers = ["-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
    compile_program(folder, HERE / "runner_test.cpp", tmp_path / "runner_test", *sanitizers)
    command = [tmp_path / "runner_test", folder / "skill.safetensors", folder / "test/recording.safetensors"]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stdout + result.stderr


@needs_compiler
def test_damaged_template_is_refused_when_it_is_read(tmp_path):
    folder = tmp_path / "skill"
    export_cpp("pretrained:pouring", folder)
    sanitizers = ["-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
    compile_program(folder, HERE / "runner_test.cpp", tmp_path / "runner_test", *sanitizers)
    command = [tmp_path / "runner_test", folder / "skill.safetensors"]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stdout + result.stderr


def test_description_lists_signals_and_action(tmp_path):
    export_cpp("pretrained:clamp", tmp_path / "skill")
    skill = json.loads((tmp_path / "skill/skill.json").read_text())
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
