import multiprocessing
import signal
from dataclasses import replace

import gymnasium
import numpy as np
import pandas as pd
import pytest

from guiderail.diagrams.tasks.registry import TASKS, environment_id
from guiderail.models.common.errors import InputError
from guiderail.models.policy import Policy
from guiderail.tools.evaluation.baselines import zero_policy
from guiderail.tools.evaluation.evaluation import episodes_file
from guiderail.tools.learning import episodes, trainer
from guiderail.tools.learning.learner import LEARNERS
from guiderail.tools.learning.off_policy import SacLearner
from guiderail.tools.learning.run_folder import RunFolder, configure, resumed_config
from guiderail.tools.learning.train import Training, train
from guiderail.tools.learning.trainer import Observers, run_training
from oracles.same_runs import differences

FORKS = multiprocessing.get_context("forkserver")


def train_and_report(path, config, sender):
    """Train a run, and send the number of each finished episode."""
    run_training(RunFolder(path), config, observers=Observers(lambda row: sender.send(row["episode"])))


def hold_lock(path, sender):
    """Lock a run, and wait until the process is killed."""
    with RunFolder(path).locked():
        sender.send("locked")
        signal.pause()


def without_clock(rows):
    return pd.DataFrame(rows).drop(columns="wall_time").to_dict("records")


def assert_same_run(first, second):
    assert differences(first.path, second.path) == []


def with_demonstrations(config, number):
    return replace(config, learner=replace(config.learner, demonstration_episodes=number))


def lowest_action(env):
    return lambda observation: env.action_space.low


def interrupt_in(episode):
    """Return a report function that interrupts the training after an episode."""

    def report(row):
        if row["episode"] == episode:
            raise KeyboardInterrupt

    return report


def test_demonstrator_acts_in_the_first_episodes(bead_config, tmp_path):
    num_actions = []

    def demonstrator(env):
        num_actions.append(0)

        def act(observation):
            num_actions[-1] += 1
            return env.action_space.low

        return act

    rows = run_training(RunFolder(tmp_path / "run"), with_demonstrations(bead_config, 2), demonstrator=demonstrator)
    assert num_actions[1:] == [row["steps"] for row in rows[:2]]  # the first call checks the compatibility
    assert [row["is_demonstration"] for row in rows[:3]] == [1, 1, 0]


def test_demonstrated_run_resumes_bit_for_bit(bead_config, tmp_path):
    config = with_demonstrations(bead_config, 2)
    undisturbed, stopped = RunFolder(tmp_path / "undisturbed"), RunFolder(tmp_path / "stopped")
    run_training(undisturbed, config, demonstrator=lowest_action)
    run_training(stopped, replace(config, episodes=1), demonstrator=lowest_action)
    run_training(stopped, config, demonstrator=lowest_action, resume=True)
    assert_same_run(undisturbed, stopped)


def test_run_is_refused_when_a_demonstrator_is_missing(bead_config, tmp_path):
    with pytest.raises(InputError, match="demonstration_episodes"):
        run_training(RunFolder(tmp_path / "run"), with_demonstrations(bead_config, 1))
    assert not (tmp_path / "run").exists()


def test_demonstrator_of_other_actions_is_refused(bead_config, tmp_path):
    config = with_demonstrations(bead_config, 1)
    with pytest.raises(InputError, match="actions of Bead's scripted policy differ"):
        run_training(RunFolder(tmp_path / "run"), config, demonstrator=lambda env: lambda observation: np.zeros(7))
    assert not (tmp_path / "run").exists()


def test_policy_of_a_run_demonstrates(bead_config, bead_run, tmp_path):
    config = with_demonstrations(bead_config, 2)
    config = replace(config, learner=replace(config.learner, demonstrator=str(bead_run)))
    env, policy = trainer.make_run_environment(config), Policy.load(bead_run)
    observation, _ = env.reset(seed=0)
    demonstrator = episodes.make_demonstrator(config)
    np.testing.assert_array_equal(demonstrator(env)(observation), policy(observation))
    rows = run_training(RunFolder(tmp_path / "demonstrated"), config, demonstrator=demonstrator)
    assert [row["is_demonstration"] for row in rows[:3]] == [1, 1, 0]


def test_demonstrating_run_of_another_environment_is_refused_by_the_difference(bead_config, bead_run, tmp_path):
    config = with_demonstrations(bead_config, 1)
    config = replace(config, learner=replace(config.learner, demonstrator="pretrained:passage"))
    with pytest.raises(InputError, match=r"the policy takes observations .* and this environment has observations"):
        run_training(RunFolder(tmp_path / "demonstrated"), config, demonstrator=episodes.make_demonstrator(config))
    assert not (tmp_path / "demonstrated").exists()


def test_killed_run_resumes_bit_for_bit(bead_config, bead_run, forkserver, tmp_path):
    killed = RunFolder(tmp_path / "killed")
    receiver, sender = FORKS.Pipe(duplex=False)
    child = FORKS.Process(target=train_and_report, args=(killed.path, bead_config, sender))
    child.start()
    while receiver.recv() < 4:
        pass
    child.kill()
    child.join()
    assert child.exitcode == -signal.SIGKILL
    assert not (killed.path / "policy.safetensors").exists()
    run_training(killed, bead_config, resume=True)
    assert_same_run(RunFolder(bead_run), killed)


def test_seed_determines_the_run(bead_config, bead_run, tmp_path):
    first, second, third = RunFolder(bead_run), RunFolder(tmp_path / "second"), RunFolder(tmp_path / "third")
    run_training(second, bead_config)
    run_training(third, replace(bead_config, seed=6))
    assert_same_run(first, second)
    assert without_clock(first.episodes()) != without_clock(third.episodes())


def test_finished_run_continues_with_more_episodes(bead_config, bead_run, tmp_path):
    extended = RunFolder(tmp_path / "extended")
    run_training(extended, replace(bead_config, episodes=3))
    run_training(extended, bead_config, resume=True)
    assert_same_run(RunFolder(bead_run), extended)
    assert extended.config() == bead_config


@pytest.mark.parametrize(("episodes", "changes"), [(4, {}), (6, {}), (6, {"num_envs": 2})], ids=str)
def test_interrupted_run_can_end_with_fewer_episodes(episodes, changes, bead_config, tmp_path, monkeypatch):
    monkeypatch.setattr("guiderail.tools.learning.trainer.MAX_SAVING_FRACTION", np.inf)  # a checkpoint per episode
    config = replace(bead_config, learner=replace(bead_config.learner, **changes))
    short, stopped = RunFolder(tmp_path / "short"), RunFolder(tmp_path / "stopped")
    run_training(short, replace(config, episodes=episodes))
    with pytest.raises(KeyboardInterrupt):
        run_training(
            stopped, config, observers=Observers(interrupt_in(4))
        )  # the checkpoint has the four episodes before
    with pytest.raises(InputError, match="has done 4 episodes: give at least as many"):
        resumed_config(stopped, None, {}, {"episodes": 3})
    with pytest.raises(InputError, match="--episodes ends it early"):
        Policy.load(stopped.path)
    run_training(stopped, resumed_config(stopped, None, {}, {"episodes": episodes}), resume=True)
    assert_same_run(short, stopped)
    assert stopped.config() == short.config()


@pytest.mark.parametrize("num_envs", [0, 3])
def test_run_ends_after_successes_in_a_row_also_if_resumed(num_envs, bead_config, tmp_path, monkeypatch):
    successes = dict(enumerate([1, 1, 0, 1, 1, 1, 1, 1]))
    rollout = episodes.rollout

    def rollout_with_success(*arguments, index, **options):
        return rollout(*arguments, index=index, **options) | {"success": successes[index]}

    monkeypatch.setattr(episodes, "rollout", rollout_with_success)
    learner = replace(bead_config.learner, stop_after_successes=3, num_envs=num_envs)
    config, whole, stopped = replace(bead_config, learner=learner), RunFolder(tmp_path / "a"), RunFolder(tmp_path / "b")
    run_training(whole, config)
    assert [row["success"] for row in whole.episodes().to_dict("records")] == [1, 1, 0, 1, 1, 1]
    assert len(list(whole.steps.glob("*.parquet"))) == 6
    assert Policy.load(whole.path)
    with pytest.raises(KeyboardInterrupt):
        run_training(stopped, config, observers=Observers(interrupt_in(4)))
    run_training(stopped, config, resume=True)
    assert_same_run(whole, stopped)
    monkeypatch.delattr(RunFolder, "remove_policy")  # the policy of a finished run is not removed
    run_training(stopped, config, resume=True)
    assert_same_run(whole, stopped)
    assert stopped.config().episodes == config.episodes


def test_demonstrated_successes_do_not_end_a_run(bead_config, tmp_path, monkeypatch):
    rollout = episodes.rollout
    monkeypatch.setattr(episodes, "rollout", lambda *values, **options: rollout(*values, **options) | {"success": 1})
    learner = replace(bead_config.learner, stop_after_successes=2, demonstration_episodes=2)
    folder = RunFolder(tmp_path / "run")
    run_training(folder, replace(bead_config, learner=learner), demonstrator=zero_policy)
    assert len(folder.episodes()) == 4


def test_outdated_policy_is_removed_when_a_run_continues(bead_config, tmp_path):
    folder = RunFolder(tmp_path / "run")
    run_training(folder, replace(bead_config, episodes=2))
    with pytest.raises(KeyboardInterrupt):
        run_training(folder, replace(bead_config, episodes=3), resume=True, observers=Observers(interrupt_in(2)))
    with pytest.raises(InputError, match="finish the run with --resume"):
        Policy.load(folder.path)
    run_training(folder, replace(bead_config, episodes=3), resume=True)
    before = Policy.load(folder.path).description
    run_training(folder, replace(bead_config, episodes=3), resume=True)
    assert Policy.load(folder.path).description == before, "the policy of a finished run is replaced"


def test_run_is_locked_against_other_processes(bead_config, forkserver, tmp_path):
    folder = RunFolder(tmp_path / "run")
    receiver, sender = FORKS.Pipe(duplex=False)
    process = FORKS.Process(target=hold_lock, args=(folder.path, sender))
    process.start()
    assert receiver.recv() == "locked"
    with pytest.raises(InputError, match="another process writes into"):
        run_training(folder, bead_config)
    process.kill()  # leaves a lock file without effect
    process.join()
    (folder.path / f".episodes.csv.{process.pid}.part").write_text("from a process that was killed while writing")
    with folder.locked():
        pass
    run_training(folder, replace(bead_config, episodes=2))
    assert {path.name for path in folder.path.iterdir() if path.name.startswith(".")} == set()


def test_step_log_stays_off_when_a_run_resumes(bead_config, tmp_path):
    folder = RunFolder(tmp_path / "run")
    run_training(folder, replace(bead_config, episodes=2, step_log=False))
    assert not folder.steps.exists()
    with pytest.raises(InputError, match="step_log False, not True"):
        Training(folder.path, choices={"step_log": True}, resume=True).start()


def test_run_is_refused_in_a_folder_with_other_files(bead_config, tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(InputError, match="already exists"):
        run_training(RunFolder(tmp_path), bead_config)
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]


@pytest.mark.parametrize(
    "damage",
    [
        lambda folder: folder.checkpoint.write_bytes(folder.checkpoint.read_bytes()[:-1000]),
        lambda folder: folder.checkpoint.unlink(),
        lambda folder: (folder.path / "episodes.csv").write_text("episode,success\n0,1\n"),
        lambda folder: (folder.path / "config.yaml").write_text("task: [Bead\n"),
        lambda folder: (folder.path / "config.yaml").write_text("task: Bead\nepisodes: many\n"),
    ],
    ids=["truncated checkpoint", "no checkpoint", "another table", "broken yaml", "incomplete yaml"],
)
def test_damaged_run_is_unchanged_when_resume_is_refused(bead_config, tmp_path, damage):
    folder = RunFolder(tmp_path / "run")
    run_training(folder, replace(bead_config, episodes=2))
    damage(folder)
    before = {path: path.read_bytes() for path in folder.path.rglob("*") if path.is_file()}
    with pytest.raises(InputError):
        train(out=folder.path, episodes=4, resume=True)
    assert before == {path: path.read_bytes() for path in folder.path.rglob("*") if path.is_file()}


def test_table_is_completed_from_the_checkpoint(bead_config, bead_run):
    folder = RunFolder(bead_run)
    table = folder.path / "episodes.csv"
    whole = table.read_bytes()
    for remaining in (b"".join(whole.splitlines(keepends=True)[:2]), None):
        table.unlink() if remaining is None else table.write_bytes(remaining)
        run_training(folder, bead_config, resume=True)
        assert table.read_bytes() == whole


def demonstrator_refused_in(episode):
    """Return a demonstrator that raises an `InputError` at the start of an episode."""
    requests = []

    def demonstrator(env):
        requests.append(env)
        if len(requests) == episode + 2:  # the first call checks the compatibility
            raise InputError("this is wrong")
        return lowest_action(env)

    return demonstrator


def test_folder_is_removed_when_the_first_episode_is_refused(bead_config, tmp_path):
    existing = tmp_path / "existing"
    existing.mkdir()
    (existing / ".hidden_file").write_text("")
    for path, remaining in ((tmp_path / "new", []), (existing, [".hidden_file"])):
        with pytest.raises(InputError, match="this is wrong"):
            run_training(RunFolder(path), with_demonstrations(bead_config, 3), demonstrator=demonstrator_refused_in(0))
        assert path.exists() is bool(remaining)
        assert [file.name for file in path.glob("*")] == remaining
    run_training(RunFolder(tmp_path / "new"), replace(bead_config, episodes=1))


def test_folder_is_kept_when_a_later_episode_is_refused(bead_config, tmp_path):
    config = with_demonstrations(bead_config, 3)
    later, created = RunFolder(tmp_path / "later"), RunFolder(tmp_path / "created")
    with pytest.raises(InputError, match="this is wrong"):
        run_training(later, config, demonstrator=demonstrator_refused_in(1))
    assert len(later.episodes()) == 1
    created.create(config)
    with pytest.raises(InputError, match="this is wrong"):
        run_training(created, config, resume=True, demonstrator=demonstrator_refused_in(0))
    assert created.config() == config


def test_run_starts_again_when_killed_before_a_checkpoint(bead_config, bead_run, tmp_path):
    created = RunFolder(tmp_path / "created")
    created.create(bead_config)
    run_training(created, bead_config, resume=True)
    assert_same_run(RunFolder(bead_run), created)


def test_resume_refuses_other_settings(bead_config, tmp_path):
    run_training(RunFolder(tmp_path / "run"), replace(bead_config, episodes=2))
    with pytest.raises(InputError, match="seed 5, not 7"):
        train(out=tmp_path / "run", seed=7, resume=True)
    with pytest.raises(InputError, match="other learner settings"):
        train(out=tmp_path / "run", settings={"batch_size": 8}, resume=True)


@pytest.mark.parametrize(("old", "new"), [("seed: 5", "seed: 6"), ("batch_size: 16", "batch_size: 8")])
def test_resume_refuses_an_edited_configuration(old, new, bead_run):
    folder, file = RunFolder(bead_run), bead_run / "config.yaml"
    assert old in file.read_text()
    file.write_text(file.read_text().replace(old, new))
    with pytest.raises(InputError, match="another task, seed, environment or learner than its checkpoint"):
        run_training(folder, folder.config(), resume=True)


@pytest.mark.parametrize(
    ("task", "preset", "algorithm"),
    [("GridClamp", "sac_gridclamp", "sac"), ("Pouring", "pouring", "sac"), ("BncConnector", "tqc_contact", "tqc")],
)
def test_default_learner_is_declared_by_the_task(task, preset, algorithm):
    config = configure(task, {}, **{"seed": 3})
    assert (config.preset, config.learner.algorithm, config.seed) == (preset, algorithm, 3)


def test_chosen_algorithm_replaces_the_default_learner():
    assert configure("GridClamp", {"guidance": "none"}, algorithm="tqc").preset == "tqc_contact"


def test_diverged_run_is_reported_and_its_folder_is_kept(bead_config, tmp_path):
    learner = replace(bead_config.learner, learning_rate=1e30, constant_episodes=0)
    folder = RunFolder(tmp_path / "run")
    with pytest.raises(InputError, match="diverged"):
        run_training(folder, replace(bead_config, learner=learner))
    assert (folder.path / "config.yaml").exists()
    assert not (folder.path / "policy.json").exists()


def test_resume_accepts_the_same_options_and_logs_versions(tmp_path, caplog):
    options = {
        **{"guidance": "kgrl", "action_dims": "0,1", "action_repeat": 40},
        "settings": {"net_arch": "8", "gradient_steps": 1},
        "pictures": False,
    }
    out = tmp_path / "run"
    train("NarrowPassage", out=out, episodes=1, **options)
    folder = RunFolder(out)
    folder.write_config(replace(folder.config(), versions={**folder.config().versions, "drake": "1.0.0"}))
    for _ in range(2):
        train("NarrowPassage", out=out, episodes=2, resume=True, **options)
    assert caplog.text.count("continues with other versions: drake 1.0.0, then ") == 1
    assert folder.config().versions["drake"].startswith("1.0.0, then ")
    with pytest.raises(InputError, match="has done 2 episodes"):
        train("NarrowPassage", out=out, episodes=1, resume=True, **options)


def write_subclass(folder, package, base, decorator, name):
    """Write a file that registers a subclass of a class of the package; return its path."""
    (module, _, base), (registry, _, decorator) = base.rpartition("."), decorator.partition(".")
    file = folder / "subclass.py"
    file.write_text(
        f"from {package}.{module} import {base}\nfrom {package}.{registry} import {decorator}\n"
        f"@{decorator}({name!r})\nclass Subclass({base}):\n    pass\n"
    )
    return file


def test_resume_refuses_a_changed_task_file(tmp_path, monkeypatch):
    monkeypatch.setitem(TASKS._entries, "changes/Passage", None)  # removed after the test
    names = "narrow_passage.NarrowPassage", "registry.register_task"
    file = write_subclass(tmp_path, "guiderail.diagrams.tasks", *names, "changes/Passage")
    out, environment = tmp_path / "run", {"guidance": "kgrl", "action_repeat": 40}
    Training(out, ["changes/Passage"], environment, {"episodes": 1}, imports=[str(file)], pictures=False).start()
    config = RunFolder(out).config()
    before = episodes_file(out, "uniform_random", config, config.environment, episodes=2)
    file.write_text(file.read_text() + "# changed\n")
    with pytest.raises(InputError, match=f"the files of changes/Passage or {file.name} are not those that the run"):
        train(out=out, episodes=2, resume=True)
    assert episodes_file(out, "uniform_random", config, config.environment, episodes=2) != before
    gymnasium.registry.pop(environment_id("changes/Passage"), None)


@pytest.fixture
def trained_config(monkeypatch, tmp_path):
    """Return a function from arguments of `train` to the configuration of the run, which is not trained."""
    configs = []
    monkeypatch.setattr(trainer, "run_training", lambda folder, config, **_: configs.append(config))

    def configuration(task="Bead", **arguments):
        train(task, out=tmp_path / "run", pictures=False, **arguments)
        assert not list(tmp_path.iterdir())
        return configs.pop()

    return configuration


def test_train_warns_when_its_source_is_unfinished(bead_config, tmp_path, monkeypatch, caplog):
    monkeypatch.setattr(trainer, "run_training", lambda *arguments, **options: None)
    source = RunFolder(tmp_path / "source")
    run_training(source, replace(bead_config, episodes=2))
    for _ in range(2):
        train("Bead", out=tmp_path / "run", settings={"init_from": str(source.path)}, pictures=False)
        assert (not caplog.records) is (source.path / "policy.json").is_file()
        source.remove_policy()
    assert f"{source.path} that init_from names is unfinished: training starts from its checkpoint of 2" in caplog.text


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"episode": 3}, "no argument 'episode': did you mean episodes"),
        ({"preSets": "a"}, "did you mean preset"),
        ({"wal": 2.0}, "did you mean wall"),
        ({"episode": 3, "task": "NarrowPassage"}, "no argument 'episode': did you mean episodes"),
        ({"task": 3}, "name of a task or its folder, an environment, .* not 3"),
        ({"task": None}, "name of a task or its folder, an environment, .* not None"),
    ],
)
def test_train_refuses_wrong_arguments_with_a_hint(options, message, trained_config):
    with pytest.raises(InputError, match=message):
        trained_config(**options)


@pytest.mark.parametrize(("method", "episodes"), [("state", 2), ("policy", 5), ("restore", 2)])
def test_failure_of_a_learner_of_a_user_is_named(method, episodes, bead_config, tmp_path, monkeypatch):
    class Own(SacLearner):
        pass

    def fail(self, *arguments):
        if method == "restore" or self.episodes == (3 if method == "state" else 5):
            raise AttributeError("no weights")
        return getattr(SacLearner, method)(self, *arguments)

    monkeypatch.setitem(LEARNERS._entries, "own", Own)
    monkeypatch.setattr(trainer, "MAX_SAVING_FRACTION", 1e9)
    folder = RunFolder(tmp_path / "run")
    config = replace(bead_config, learner=replace(bead_config.learner, algorithm="own"), episodes=5)
    if method == "restore":
        run_training(folder, replace(config, episodes=2))
    with monkeypatch.context() as patch:
        patch.setattr(Own, method, fail)
        with pytest.raises(InputError, match=rf"Own\.{method} failed: test_trainer\.py, line \d+: AttributeError: no"):
            run_training(folder, config, resume=method == "restore")
    assert len(folder.episodes()) == episodes
    assert len(run_training(folder, config, resume=True)) == 5
    assert (folder.path / "policy.json").is_file()


@pytest.mark.parametrize("method", ["state", "policy"])
def test_failure_of_a_learner_is_found_before_the_first_episode(method, bead_config, tmp_path, monkeypatch):
    def fail(self, *arguments):
        raise AttributeError("no weights")

    monkeypatch.setitem(LEARNERS._entries, "own", type("Own", (SacLearner,), {method: fail}))
    config = replace(bead_config, learner=replace(bead_config.learner, algorithm="own"))
    with pytest.raises(InputError, match=rf"Own\.{method} failed: .*AttributeError: no weights"):
        run_training(RunFolder(tmp_path / "run"), config)
    assert not (tmp_path / "run").exists()
