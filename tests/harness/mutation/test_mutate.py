"""Files and tests of the mutation testing exist, and only mutated files have explained survivors."""

import ast

import yaml
from mutation.mutate import ROOT, SURVIVORS, TARGETS, graft

from guiderail_hardware.models import round_trip


def test_mutated_files_and_their_tests_exist():
    paths = {*TARGETS, *(test for tests in TARGETS.values() for test in tests)}
    assert [path for path in sorted(paths) if not (ROOT / path).exists()] == []


def test_explained_survivors_are_of_mutated_files():
    assert set(yaml.safe_load(SURVIVORS.read_text())) <= set(TARGETS)


def test_constant_of_a_sibling_is_replaced(monkeypatch):
    """Its package has another name than the core's."""
    file = "packages/hardware/src/guiderail_hardware/models/round_trip.py"
    monkeypatch.setattr(round_trip, "WINDOW", 4)
    graft(file, ast.parse((ROOT / file).read_text().replace("WINDOW = 4", "WINDOW = 5")))
    assert round_trip.WINDOW == 5
