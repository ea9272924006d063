"""Runs of a task folder: refused when the files of the folder changed since the start of the run."""

import shutil
from dataclasses import replace
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import yaml

import guiderail.models.objects.bnc_connector
from guiderail.diagrams.tasks.registry import TASKS, environment_id
from guiderail.models.common.errors import InputError
from guiderail.models.policy import Policy
from guiderail.tools.cli.main import main
from guiderail.tools.environments import task_content
from guiderail.tools.evaluation.evaluation import episodes_file
from guiderail.tools.evaluation.subject import find_subject
from guiderail.tools.imports import import_modules
from guiderail.tools.learning.run_folder import RunFolder, configure
from guiderail.tools.learning.train import train
from guiderail_lerobot.env_server import open_environment
from guiderail_studies.certify import certify_skill
from guiderail_studies.declaration import Study
from guiderail_studies.job import Job, digest, refuse_another

PART = {"visual": "part.obj", "mass": 0.1, "center": [0, 0, 0], "gyration": 0.01, "pieces": [{"file": "part.obj"}]}
TASK = {
    "format": "guiderail task 1",
    "name": "parts/pin",
    "plug": PART,
    "socket": PART,
    "motion": {"travel": 0.02, "first_contact": 0.01},
    "demonstrations": {"components": 1},
}
POLICY = {"observation_shape": [1], "action_low": [-1], "action_high": [1]}
# Program that finds the run of its first argument in the task of its second, and prints the task and its folder.
PRINT_TASK = """
import sys
from guiderail.diagrams.tasks.registry import TASKS
from guiderail.tools.cli.app import find_task
from guiderail.tools.evaluation.subject import find_subject
subject = find_subject(sys.argv[1], find_task(sys.argv[2])[0])
print(subject.config.task, TASKS.get(subject.config.task).folder)
"""
SHIPPED = Path(guiderail.models.objects.bnc_connector.__file__).parent


@pytest.fixture
def folder(tmp_path):
    path = tmp_path / "pin"
    path.mkdir()
    shutil.copy(SHIPPED / "bnc_connector.npz", path / "demonstrations.npz")
    (path / "part.obj").write_text("v 0 0 0\n")
    (path / "task.yaml").write_text(yaml.safe_dump(TASK))
    import_modules([path])
    yield path
    del TASKS._entries["parts/pin"]
    gymnasium.registry.pop(environment_id("parts/pin"))


@pytest.fixture
def run(folder, tmp_path):
    """Return the folder of a run of the task, with a policy."""
    run = RunFolder(tmp_path / "run")
    run.create(configure("parts/pin", {}, episodes=2, imports=[str(folder)]))
    Policy([(np.zeros((1, 1), np.float32), np.zeros(1, np.float32))], POLICY).save(run.path)
    return run


CHANGES = {
    "task.yaml": yaml.safe_dump(TASK | {"bounds": {"lower": [None] * 6, "upper": [None] * 6}}),
    "part.obj": "v 0 0 1\n",
}


@pytest.mark.parametrize("name", CHANGES)
def test_run_is_not_resumed_when_its_task_folder_changed(name, folder, run):
    config, before = run.config(), (folder / name).read_text()
    (folder / name).write_text(CHANGES[name])
    for resume in (
        lambda: train(out=run.path, resume=True),
        lambda: refuse_another(run, configure("parts/pin", {}, episodes=2)),
    ):
        with pytest.raises(InputError, match="the files of parts/pin are not those"):
            resume()
    (folder / name).write_text(before)
    refuse_another(run, config)
    run.write_config(replace(config, task_content=""))  # without the digest of the files
    (folder / name).write_text(CHANGES[name])
    refuse_another(run, config)


@pytest.mark.parametrize(
    "arguments",
    [["evaluate"], ["deploy", "--sim", "--episodes", "1"], ["robustness"], ["visualize"], ["deploy", "--sim"]],
    ids=" ".join,
)
def test_run_is_not_evaluated_when_its_task_folder_changed(arguments, folder, run, capsys):
    (folder / "part.obj").write_text(CHANGES["part.obj"])
    before = sorted(run.path.iterdir())
    with pytest.raises(SystemExit) as end:
        main([arguments[0], str(run.path), *arguments[1:]])
    message = capsys.readouterr().err
    assert end.value.code == 2
    assert "the files of parts/pin are not those that the run in" in message
    assert ("--task" in message) == ("--sim" not in arguments)  # a robot has no other task
    assert sorted(run.path.iterdir()) == before


def test_run_is_not_certified_or_served_when_its_task_changed(folder, run):
    (folder / "part.obj").write_text(CHANGES["part.obj"])
    for use_run in (certify_skill, open_environment):
        with pytest.raises(InputError, match="the files of parts/pin are not those that the run in"):
            use_run(str(run.path), {})


def test_policy_of_a_run_acts_in_changed_files_of_a_named_task(folder, run):
    (folder / "part.obj").write_text(CHANGES["part.obj"])
    assert find_subject(run.path, "parts/pin").folder is None
    run.write_config(replace(run.config(), task_content=""))  # without the digest of the files
    assert find_subject(run.path, None).folder is not None


def test_moved_task_folder_is_named_with_its_remedy(folder, run, tmp_path, capsys, forks):
    moved = tmp_path / "moved pin"
    folder.rename(moved)
    with pytest.raises(SystemExit) as end:
        main(["evaluate", str(run.path)])
    message = capsys.readouterr().err
    assert end.value.code == 2
    assert f"there is no file or task folder {folder} to import, which {run.path / 'config.yaml'} names" in message
    assert "--task NEW_FOLDER" in message
    assert "--import" not in message
    # In another process, because the task's name is registered with the old folder in this process.
    result = forks.run("-c", PRINT_TASK, run.path, moved)
    assert (result.returncode, result.stdout) == (0, f"parts/pin {moved}\n"), result.stderr


def test_stored_episodes_depend_on_the_files_of_the_task(folder, tmp_path):
    config = configure("parts/pin", {}, episodes=2)
    declaration = {"name": "pins", "task": "parts/pin", "methods": {"zero": {"policy": "zero"}}, "seeds": [0]}
    job = Job(Study.model_validate(declaration), "zero", 0, tmp_path)

    def names():
        stored = episodes_file(tmp_path, "uniform_random", config, config.environment, episodes=2)
        return stored, digest(job), digest(job, job.study.eval_sets[0])

    before = names()
    changed = replace(config, task="NarrowPassage")
    assert episodes_file(tmp_path, "uniform_random", changed, config.environment, episodes=2).name != before[0].name
    (folder / "task.yaml").write_text(yaml.safe_dump(TASK | {"measured": {"clearance": 1}}))
    assert names() == before, "the entry `measured` has an effect"
    (folder / "part.obj").write_text(CHANGES["part.obj"])
    assert all(name != previous for name, previous in zip(names(), before, strict=True))


def test_stored_episodes_depend_on_the_base_policy(tmp_path):
    def save_policy(bias):
        layers = [(np.zeros((8, 5), np.float32), np.full(8, bias, np.float32))]
        description = {"observation_shape": [5], "action_low": [-1] * 8, "action_high": [1] * 8, "chunk": [1, 4, 2]}
        Policy(layers, description).save(tmp_path)

    save_policy(0.0)
    environment = {"guidance": "kgrl_base_policy", "base_policy": str(tmp_path)}
    config = configure("NarrowPassage", environment, episodes=2)
    declaration = {"name": "chunks", "task": "NarrowPassage", "methods": {"zero": {"policy": "zero"}}, "seeds": [0]}
    declaration["env"] = environment
    job = Job(Study.model_validate(declaration), "zero", 0, tmp_path)

    def names():
        return episodes_file(tmp_path, "zero", config, config.environment, episodes=2), digest(job)

    before = names()
    (tmp_path / "episodes.csv").write_text("")
    assert names() == before, "another file than the policy has an effect"
    save_policy(0.5)
    assert all(name != previous for name, previous in zip(names(), before, strict=True))


def test_task_without_a_folder_has_no_content_digest():
    assert task_content("NarrowPassage", {}, ()) == task_content("Bead", {}, ()) == ""
