import json

import pytest

from guiderail.models.errors import InputError
from guiderail.tools.certify import certify_skill


def test_a_tasks_certificate_is_written_and_accepted_and_an_attack_says_how_tight_it_is(tmp_path):
    found = certify_skill("NarrowPassage", {"guidance": "kgrl"}, out=tmp_path, attack=2000)
    assert found["checker"] == "yes"
    assert found["always_upper"][0] <= found["while_free_upper"][0]
    assert found["steps"] >= found["steps_that_constraints_can_touch"]
    assert json.loads((tmp_path / "certificate.json").read_text())["assumes"]
    rows = found["attack"]
    assert found["attack_steps"] >= 2000
    assert {row["quantity"] for row in rows} == {"pose", "speed", "acceleration"}
    assert all(row["left"] == 0 for row in rows)
    assert all(row["ratio"] < 1.2 for row in rows if row["constraint"] == "never active")
    assert (tmp_path / "attack.csv").exists()


def test_demonstrations_alone_are_certified_too(tmp_path):
    found = certify_skill("NarrowPassage", {"guidance": "kmp"}, out=tmp_path)
    assert found["checker"] == "yes"
    assert found["steps_that_constraints_can_touch"] == 0


@pytest.mark.parametrize(
    ("of", "environment", "words"),
    [
        ("NarrowPassage", {"guidance": "residual"}, "no law that is certified"),
        ("NarrowPassage", {"guidance": "skgrl", "adaptive_history": True}, "of one length"),
        ("Pouring", {}, "no law that is certified"),
        ("nowhere", {}, "no task"),
    ],
)
def test_what_follows_no_such_law_is_refused(tmp_path, of, environment, words):
    with pytest.raises(InputError, match=words):
        certify_skill(of, environment, out=tmp_path)


def test_a_start_that_is_no_distance_is_refused(tmp_path):
    with pytest.raises(InputError, match="not negative"):
        certify_skill("NarrowPassage", {"guidance": "kgrl"}, out=tmp_path, start_within=-1.0)


def test_an_attack_of_a_negative_number_of_steps_is_refused(tmp_path):
    with pytest.raises(InputError, match="number of steps"):
        certify_skill("NarrowPassage", {"guidance": "kgrl"}, out=tmp_path, attack=-1)


def test_a_task_needs_a_folder_to_write_to():
    with pytest.raises(InputError, match="--out"):
        certify_skill("NarrowPassage", {"guidance": "kgrl"})
