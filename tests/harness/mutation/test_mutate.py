"""Files and tests of the mutation testing exist, and only mutated files have explained survivors."""

import yaml
from mutation.mutate import ROOT, SURVIVORS, TARGETS


def test_mutated_files_and_their_tests_exist():
    paths = {*TARGETS, *(test for tests in TARGETS.values() for test in tests)}
    assert [path for path in sorted(paths) if not (ROOT / path).exists()] == []


def test_explained_survivors_are_of_mutated_files():
    assert set(yaml.safe_load(SURVIVORS.read_text())) <= set(TARGETS)
