"""Benchmark: rules of a protocol, runs of a method, submissions, verification and the page."""

import json
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml

import guiderail_studies.benchmark.protocol as protocol_module
from guiderail.models.common.errors import InputError
from guiderail.models.policy import Policy
from guiderail.tools.tables import read_table, table_text
from guiderail_studies.benchmark.page import write_page
from guiderail_studies.benchmark.protocol import (
    BenchmarkMethod,
    load_method,
    load_protocol,
    method_study,
    shipped_methods,
)
from guiderail_studies.benchmark.run import check_floors, estimate_hours, floor_failures, run_method, stored_method
from guiderail_studies.benchmark.submission import RUN_FILES, SUBMISSION, file_digest, submit, verify
from guiderail_studies.engines.engine import make_engine
from oracles.commands import call

DOCS = Path(__file__).parents[4] / "docs" / "benchmark.md"
SETTINGS = {"net_arch": "16", "batch_size": 16, "learning_starts": 10, "gradient_steps": 1}
SMALL = {
    "version": 99,
    "reference": "residual",
    "seeds": [3, 4],
    "episodes": 3,
    "first_seed": 1_000_000,
    "floor_episodes": 2,
    "max_random": 0.2,
    "min_scripted": 0.9,
    "choices": ["guidance", "reward", "history"],
    "tasks": {
        "clamp": {
            "task": "GridClamp",
            "description": "Five pegs.",
            "env": {"difficulty": "hard", "bounded_force": False, "seconds": 2.0},
            "episodes": 2,
            "core_seconds": 3600,
            "floor_env": {"guidance": "sct"},
            "scripted": "scripted_gentle_search",
            "reset": {"new_run": True},
        }
    },
}


@pytest.fixture(scope="module")
def protocol(tmp_path_factory):
    """Return a protocol with one short task, which `load_protocol` finds."""
    folder = tmp_path_factory.mktemp("protocols")
    shutil.copy(protocol_module.PROTOCOLS / "1.yaml", folder)
    (folder / "99.yaml").write_text(yaml.safe_dump(SMALL))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(protocol_module, "PROTOCOLS", folder)
        load_protocol.cache_clear()
        yield load_protocol(99)
    load_protocol.cache_clear()


def make_method(**changed):
    content = {"name": "own", "env": {"guidance": "residual"}, "learner": {"settings": SETTINGS}}
    return BenchmarkMethod.model_validate(content | changed)


@pytest.fixture(scope="module")
def runs(protocol, tmp_path_factory):
    """Return the folder of the runs of a method that chooses the fields of its environment and learner."""
    out = tmp_path_factory.mktemp("runs") / "own"
    printed = []
    run_method(protocol, make_method(), out, seeds=[3], engine=make_engine(processes=1), log=printed.append)
    assert printed == ["1 run of own, about 1 core-hours; finished runs are not repeated"]
    return out


@pytest.fixture
def submission(runs, tmp_path):
    submit(runs, tmp_path / "submissions" / "own")
    return tmp_path / "submissions" / "own"


def edit(folder, change):
    """Change the content of `submission.json`."""
    content = json.loads((folder / SUBMISSION).read_text())
    change(content)
    (folder / SUBMISSION).write_text(json.dumps(content))


def write_digests(folder):
    """Write the digests of changed files, as the author of a forged submission would."""
    edit(folder, lambda content: content.update(files={name: file_digest(folder / name) for name in content["files"]}))


def test_every_shipped_method_obeys_protocol_1():
    pytest.importorskip("guiderail_parts", reason="a task of the protocol is a part")
    protocol = load_protocol(1)
    for method in shipped_methods().values():
        tasks = [name for name in protocol.tasks if method.applies(name)]
        assert tasks
        for name in tasks:
            method_study(protocol, name, method, protocol.seeds)
        assert 0.1 < estimate_hours(protocol, method, tasks, len(protocol.seeds)) < 30


def test_measured_floors_of_protocol_1_are_within_its_bounds():
    protocol = load_protocol(1)
    for name, task in protocol.tasks.items():
        assert not floor_failures(protocol, name, task.floors)


@pytest.mark.parametrize(
    ("env", "message"),
    [
        ({"guidance": "residual", "force_limit": 30}, "does not let a method choose 'force_limit'"),
        ({"guidance": "residual", "seconds": 3.0}, "fixes the option seconds of clamp"),
        ({"guidance": "code.py"}, "is a name, a number"),
        ({"guidance": "folder/guidance"}, "is a name, a number"),
    ],
)
def test_method_is_refused_when_it_chooses_what_is_fixed(env, message, protocol):
    with pytest.raises(InputError, match=message):
        method_study(protocol, "clamp", make_method(env=env), [3])


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("learner: {episodes: 500}", "fixes the number of training episodes"),
        ("learner: {settings: {init_from: other}}", "starts from no other run"),
        ("learners: {}", "a method has no key learners"),
        ("tasks: {clamp: {envs: {}}}", r"a method has no key tasks.clamp.envs: did you mean env\?"),
        ("tasks: {clmap: null}", r"no protocol has a task 'clmap': did you mean clamp\?"),
        ("name: residual", "the method residual of this package has other choices: give another name"),
        ("[]", "it needs at least name"),
    ],
)
def test_method_file_is_refused_when_invalid(content, message, tmp_path):
    (tmp_path / "own.yaml").write_text(content)
    with pytest.raises(InputError, match=message):
        load_method(str(tmp_path / "own.yaml"))


def test_unknown_names_are_refused_with_a_suggestion(protocol):
    with pytest.raises(InputError, match="residual"):
        load_method("residuel")
    with pytest.raises(InputError, match="the versions are 1"):
        load_protocol(7)
    with pytest.raises(InputError, match="clamp"):
        protocol.select(["clmp"])


def test_folder_of_runs_is_refused_for_another_method(protocol, runs):
    with pytest.raises(InputError, match="runs of another method"):
        run_method(protocol, make_method(name="other"), runs, seeds=[3], log=str)
    with pytest.raises(InputError, match="has no seed 5: its seeds are 3, 4"):
        run_method(protocol, make_method(), runs, seeds=[5], log=str)


def test_runs_are_refused_when_the_rules_have_changed(protocol, runs, tmp_path):
    changed = shutil.copytree(runs, tmp_path / "changed")
    content = json.loads((changed / "method.json").read_text())
    content["digests"]["clamp"] = "0"
    (changed / "method.json").write_text(json.dumps(content))
    with pytest.raises(InputError, match="with other rules"):
        stored_method(changed)


def test_submission_is_verified_bit_for_bit(submission):
    assert verify(submission, episodes=3, log=str) == {"verified": 3, "runs": 1}


def test_submission_is_refused_when_a_file_was_changed(submission):
    file = submission / "clamp" / "3" / "evaluated.csv"
    file.write_text(file.read_text().replace("0", "1", 1))
    with pytest.raises(InputError, match="was changed after"):
        verify(submission, log=str)


def test_submission_is_refused_when_its_episodes_are_forged(submission):
    folder = submission / "clamp" / "3"
    rows = read_table(folder / "evaluated.csv")
    rows["return"] += 1.0  # no column of the table depends on it
    (folder / "evaluated.csv").write_text(table_text(rows))
    write_digests(submission)
    with pytest.raises(InputError, match=r"has return [-.\d]+, and the submission states [-.\d]+: it is refused$"):
        verify(submission, episodes=1, log=str)


def test_refusal_names_what_differs_when_run_elsewhere(submission):
    folder = submission / "clamp" / "3"
    rows = read_table(folder / "evaluated.csv")
    rows["return"] += 1.0
    write_digests(submission)
    edit(submission, lambda content: content["versions"].update(python="3.11.0"))
    assert verify(submission, episodes=1, log=str)["verified"] == 1  # equal episodes are what counts
    (folder / "evaluated.csv").write_text(table_text(rows))
    write_digests(submission)
    with pytest.raises(InputError, match=r"is refused; it was run with python '3\.11\.0', unlike here$"):
        verify(submission, episodes=1, log=str)


def test_submission_is_refused_with_a_name_of_another_method(submission):
    edit(submission, lambda content: content["method"].update(name="residual"))
    with pytest.raises(InputError, match="the method residual of this package has other choices"):
        verify(submission, log=str)


def test_submission_is_refused_when_a_run_is_copied_to_a_seed(submission):
    shutil.copytree(submission / "clamp" / "3", submission / "clamp" / "4")
    table = read_table(submission / "table.csv")
    (submission / "table.csv").write_text(table_text(pd.concat([table, table.assign(seed=4)])))
    edit(submission, lambda content: content["files"].update({f"clamp/4/{name}": "" for name in RUN_FILES}))
    write_digests(submission)
    with pytest.raises(InputError, match="the same policy of clamp for seeds 3 and 4"):
        verify(submission, log=str)


def test_submission_is_refused_when_a_file_of_a_run_is_missing(submission):
    (submission / "clamp" / "3" / "evaluated.csv").unlink()
    for _ in range(2):  # also with a list of files that fits
        with pytest.raises(InputError, match=r"lacks the file 'clamp/3/evaluated.csv'"):
            verify(submission, log=str)
        edit(submission, lambda content: content["files"].pop("clamp/3/evaluated.csv", None))


def test_submission_is_refused_when_its_table_is_forged(submission):
    table = read_table(submission / "table.csv")
    table["success_rate"] = 1.0 - table["success_rate"]
    (submission / "table.csv").write_text(table_text(table))
    write_digests(submission)
    with pytest.raises(InputError, match="other values of success_rate"):
        verify(submission, log=str)


def test_submission_is_refused_with_another_policy(submission):
    folder = submission / "clamp" / "3"
    policy = Policy.load(folder)
    weights = [(weight + np.float32(0.5), bias) for weight, bias in policy.layers]
    Policy(weights, {k: v for k, v in policy.description.items() if k not in ("digest", "format")}).save(folder)
    write_digests(submission)
    with pytest.raises(InputError, match="it is refused"):
        verify(submission, episodes=3, log=str)


def test_submission_is_refused_with_links_or_further_files(submission, tmp_path):
    extra = submission / "setup.py"
    extra.write_text("raise SystemExit")
    with pytest.raises(InputError, match=r"a file that is not part of it, 'setup.py'"):
        verify(submission, log=str)
    extra.unlink()
    extra.symlink_to(tmp_path)
    with pytest.raises(InputError, match="is a link"):
        verify(submission, log=str)


def test_submission_without_a_run_is_refused(submission):
    shutil.rmtree(submission / "clamp")
    table = submission / "table.csv"
    table.write_text(table.read_text().splitlines()[0])
    edit(submission, lambda content: content.update(digests={}, files={"table.csv": file_digest(table)}))
    with pytest.raises(InputError, match="names no run of protocol 99"):
        verify(submission, log=str)


def test_page_escapes_the_text_of_a_submission(submission):
    content = json.loads((submission / SUBMISSION).read_text())
    content["method"]["description"] = "<script>alert(1)</script> | a"
    (submission / SUBMISSION).write_text(json.dumps(content))
    result = write_page(submission.parent)
    page, markdown = (Path(result[name]).read_text() for name in ("page", "markdown"))
    assert "<script>" not in page + markdown
    assert "| core seconds | s | CPU time" in markdown
    assert "| own | \\<script\\>alert(1)\\</script\\> \\| a |" in markdown
    assert result["submissions"] == 1


def test_floors_are_checked(protocol, tmp_path):
    rows, failures = check_floors(protocol, tmp_path, engine=make_engine(processes=1))
    assert [row["policy"] for row in rows] == ["scripted", "uniform_random", "constant", "demonstration"]
    assert failures == ["clamp: the scripted policy must succeed in at least 90%"]  # two seconds do not suffice


def test_floors_print_the_number_of_bounds_that_are_not_met(protocol, tmp_path, monkeypatch, capsys):
    row = {"task": "clamp", "policy": "scripted", "success_rate": 1.0}
    for failures in ([], ["clamp: too easy"]):
        monkeypatch.setattr(
            "guiderail_studies.benchmark.run.check_floors", lambda *a, found=failures, **k: ([row], found)
        )
        code, out, err = call(capsys, "benchmark", "floors", "--protocol", "99", "--out", str(tmp_path))
        assert code == len(failures)
        assert out.split("\n")[1] == f"bounds not met   {len(failures)}"
        assert err == "".join(f"guiderail: {sentence}\n" for sentence in failures)


def test_ddpg_of_the_documentation_trains_and_is_submitted(protocol, tmp_path, monkeypatch):
    blocks = [block for block in DOCS.read_text().split("```") if "# file: " in block]
    lines = 0
    for block in blocks:
        name, _, content = block.partition("# file: ")[2].partition("\n")
        (tmp_path / name.strip()).write_text(content)
        lines += len(content.splitlines())
    assert 0 < lines <= 60
    monkeypatch.chdir(tmp_path)
    method = load_method("ddpg.yaml")
    small = method.model_copy(
        update={"learner": method.learner.model_copy(update={"settings": {"batch_size": 8, "learning_starts": 5}})}
    )
    run_method(protocol, small, tmp_path / "runs", seeds=[4], engine=make_engine(processes=1), log=str)
    submit(tmp_path / "runs", tmp_path / "submission")
    assert verify(tmp_path / "submission", episodes=1, log=str)["runs"] == 1
