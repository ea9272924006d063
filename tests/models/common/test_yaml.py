"""The YAML reader returns plain values and refuses documents beyond its limits."""

import tracemalloc
import warnings

import pytest

from guiderail.models.common.errors import InputError
from guiderail.models.common.yaml import check_yaml, load_yaml, parse_yaml

# Aliases inside aliases, which expand to 9**10 entries.
BOMB = "a0: &a0 [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]\n" for i in range(1, 10)
)


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1e-3", 0.001),
        ("-.5", -0.5),
        ("2.", 2.0),
        ("+7", 7),
        ("010", "010"),
        ("1:30", "1:30"),
        ("1_000", "1_000"),
        ("0x10", "0x10"),
        ("'2001-99-99'", "2001-99-99"),
        ("yes", "yes"),
        ("on", "on"),
        ("true", True),
        ("~", None),
        ("", None),
        (".inf", float("inf")),
        ("'1'", "1"),
        ("1e", "1e"),
    ],
)
def test_plain_scalars_follow_the_core_schema(text, value):
    result = parse_yaml(f"entry: {text}")["entry"]
    assert result == value
    assert type(result) is type(value)


def test_aliases_and_merges_are_resolved():
    assert parse_yaml("a: &x {b: 1, c: 2}\nd: {<<: *x, c: 3}\ne: *x") == {
        "a": {"b": 1, "c": 2},
        "d": {"b": 1, "c": 3},
        "e": {"b": 1, "c": 2},
    }


def test_alias_of_a_text_is_accepted_as_a_key():
    assert parse_yaml("a: &x b\n*x : 2") == {"a": "b", "b": 2}


def test_alias_of_a_reused_anchor_is_its_last_node():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert parse_yaml("a: &x 1\nb: &x 2\nc: *x") == {"a": 1, "b": 2, "c": 2}


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (BOMB, "more than 10000 entries"),
        (
            "a: &x {k: 1}\n" + "".join(f"b{i}: {{<<: [{', '.join(['*x'] * 50)}]}}\n" for i in range(300)),
            "more than 10000",
        ),
        ("\n".join(["k0: &k0 [1]"] + [f"k{i}: &k{i} [*k{i - 1}]" for i in range(1, 500)]), "inside each other"),
        ("[" * 500, "inside each other"),
        ("- " * 5_000, "inside each other"),
        ("{a: " * 5_000, "inside each other"),
        ("? " * 5_000, "put it in quotes"),
        ("&a [*a]", "contains itself"),
        ("a: &a {b: *a}", "contains itself"),
        ("x" * 100_001, "longer than"),
        ("a: 1\na: 2", 'duplicate key "a"'),
        ("1: 2", "put it in quotes"),
        ("? [a]\n: b", "put it in quotes"),
        ("a: &x 1\n*x : 2", "line 2: the key '1' is not text: put it in quotes"),
        ("a: &x []\n*x : 2", "line 2: the key a list or a mapping is not text: put it in quotes"),
        ("a: &x b\nb: &x\nc: {*x : 2}", "line 3: the key '' is not text: put it in quotes"),
        ("*x : 2", "undefined alias"),
        ("a: !!python/object/apply:os.system [ls]", "tag"),
        ("a: !!timestamp 2001-99-99", "tag"),
        ("a: !!binary abc", "tag"),
        ("a: 2001-99-99", "is a date"),
        ("a: 2001-01-01 12:00:00", "is a date"),
        ("a: " + "9" * 5_000, "thousands of digits"),
        ("a: \x00", "character"),
        ("a: *b", "undefined alias"),
        ("a\n---\nb", "another document"),
        ("<<: 5", "merging"),
        ("a: 'x", "end of stream"),
    ],
)
def test_invalid_document_is_refused_in_one_line(text, reason):
    tracemalloc.start()
    with pytest.raises(InputError) as error:
        parse_yaml(text, "template.yaml")
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert reason in str(error.value)
    assert str(error.value).startswith("template.yaml")
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < 300
    assert peak < 30e6


def test_list_of_too_many_entries_is_refused(monkeypatch):
    monkeypatch.setattr("guiderail.models.common.yaml.MAX_ENTRIES", 100)
    with pytest.raises(InputError, match="more than 100 entries"):
        parse_yaml("- x\n" * 101)


@pytest.mark.parametrize(
    "text", ["a: 1\nb: 2\na: 3", "- {a: 1, 'a': 2}", "x: &k a\ny: {a: 1, *k : 2}", "a: 1\n---\nb: {c: 1, c: 1}"]
)
def test_check_yaml_refuses_a_duplicate_key(text):
    with pytest.raises(InputError, match=r'duplicate key "[ac]": leave one of the two out'):
        check_yaml(text, "scenario.yaml", ())
    check_yaml("a: {b: &x {d: 1}}\nc: {<<: *x, d: 2}", "scenario.yaml", ())


def test_file_with_a_byte_order_mark_is_read(tmp_path):
    (tmp_path / "a.yaml").write_bytes(b"\xef\xbb\xbfname: \xcf\x88")
    assert load_yaml(tmp_path / "a.yaml") == {"name": "ψ"}


def test_load_refuses_files_that_are_not_text_or_too_large(tmp_path):
    (tmp_path / "latin.yaml").write_bytes(b"name: \xe9")
    (tmp_path / "large.yaml").write_bytes(b"#" * 100_001)
    for name, reason in [
        ("latin", "UTF-8"),
        ("large", "larger"),
        ("missing", "there is no study"),
        ("x" * 300, "study"),
    ]:
        with pytest.raises(InputError, match=reason):
            load_yaml(tmp_path / f"{name}.yaml", "study")
    with pytest.raises(InputError, match="there is no study"):
        load_yaml("/dev/zero", "study")
