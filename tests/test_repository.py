"""Consistency of versions, extras, make targets and workflows between the files of the repository."""

import re
import subprocess
import tomllib
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def test_version_is_the_same_in_every_file():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert citation["version"] == PROJECT["version"]
    assert {"cff-version", "message", "title", "authors"} <= set(citation)
    assert re.search(r"^## (\d+\.\d+\.\d+)", (ROOT / "CHANGELOG.md").read_text(), re.M)[1] == PROJECT["version"]


def test_all_extra_has_every_extra_of_users():
    extras = PROJECT["optional-dependencies"]
    listed = {name for requirement in extras["all"] for name in re.search(r"\[(.*)\]", requirement)[1].split(",")}
    assert listed == extras.keys() - {"all", "docs", "dev"}


def test_bare_make_prints_every_documented_target():
    command = ["make", "--no-print-directory"]  # inside `make test`, make would also print the folder that it enters
    output = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    phony = re.search(r"^\.PHONY: (.*)$", (ROOT / "Makefile").read_text(), re.M)[1].split()
    assert [line.split()[1] for line in output.splitlines()] == phony


@pytest.mark.parametrize("path", [*ROOT.glob(".github/**/*.yml"), *ROOT.glob(".*.yaml")], ids=lambda path: path.name)
def test_yaml_files_are_valid(path):
    assert yaml.safe_load(path.read_text())


def test_ci_runs_every_supported_python():
    job = yaml.safe_load((ROOT / ".github/workflows/ci.yml").read_text())["jobs"]["test"]
    assert min(job["strategy"]["matrix"]["python"]) == PROJECT["requires-python"].removeprefix(">=")
    assert job["steps"][-1]["run"] == ".ci/run"
