"""Laws in C++: equal to Python's for random inputs, without allocations, and clean under sanitizers."""

import re
import shutil
import subprocess
from importlib.resources import files

import pytest
from random_laws import LAWS, TOLERANCE, TOLERANCES
from safetensors.numpy import load, save

needs_compiler = pytest.mark.skipif(shutil.which("g++") is None, reason="there is no C++ compiler (g++)")
STEPS = 800
FLAGS = {"optimized": ["-O2"], "sanitized": ["-O1", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"]}


@pytest.fixture(scope="module")
def programs(tmp_path_factory):
    """Return the path of the program `replay` for each set of flags."""
    source, built = files("guiderail_cpp"), {}
    for name, flags in FLAGS.items():
        built[name] = tmp_path_factory.mktemp(name) / "replay"
        command = ["g++", "-std=c++17", "-Wall", "-Wextra", "-Werror", "-ffp-contract=off", *flags]
        command += ["-I", source / "include", source / "files/test/replay.cpp", "-o", built[name]]
        subprocess.run(command, check=True)
    return built


@needs_compiler
@pytest.mark.parametrize("law", LAWS)
def test_law_equals_python_to_1e_12_without_allocations(law, programs, tmp_path):
    data, recording = (tmp_path / name for name in ("data.safetensors", "recording.safetensors"))
    for path, content in zip((data, recording), LAWS[law](STEPS), strict=True):
        path.write_bytes(content)
    for program in programs.values():
        command = [program, data, recording, str(TOLERANCES.get(law, TOLERANCE))]
        result = subprocess.run(command, capture_output=True, text=True, check=False)
        assert result.returncode == 0, f"{law}: {result.stdout}{result.stderr}"
        assert re.search(f"^{STEPS} steps, .* 0 allocations", result.stdout)


@needs_compiler
def test_replay_fails_when_a_command_differs(programs, tmp_path):
    data, recording = LAWS["governor"](50)
    (tmp_path / "data").write_bytes(data)
    arrays = load(recording)
    arrays["replay/reference"][-1, 0] += 2e-12
    (tmp_path / "recording").write_bytes(save(arrays))
    command = [programs["optimized"], tmp_path / "data", tmp_path / "recording"]
    assert subprocess.run(command, capture_output=True, check=False).returncode == 1
