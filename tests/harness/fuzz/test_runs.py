"""Mutated files of a run: each is read exactly, or refused with one sentence."""

import csv
import io
import json

import numpy as np
import pandas as pd
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from safetensors.numpy import load_file
from spaces_only_env import SpacesOnlyEnv

from fuzz.changes import bit_flips, changed_texts, changed_trees, edited, edits, flipped
from fuzz.tally import attempt, few_inputs
from guiderail.models.common.errors import InputError
from guiderail.models.policy import FORMAT, Policy, _digest
from guiderail.tools.environments import check_environment
from guiderail.tools.evaluation.metrics import summary
from guiderail.tools.learning.checkpoint import load_checkpoint, save_checkpoint
from guiderail.tools.learning.episodes import Episodes
from guiderail.tools.learning.learner import LEARNERS
from guiderail.tools.learning.learner_config import config_values, resolve_preset
from guiderail.tools.learning.run_folder import RunFolder, configure
from guiderail.tools.learning.train import SUMMARY
from guiderail.tools.learning.trainer import TrainingLoop
from guiderail.tools.tables import table_text


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return RunFolder(tmp_path_factory.mktemp("fuzz") / "run")


def config_text(config, folder):
    """Return a configuration as the text of its file."""
    folder.write_config(config)
    return (folder.path / "config.yaml").read_text()


CONFIGS = [
    configure("NarrowPassage", {"guidance": "skgrl", "action_dims": [1], "action_repeat": 3}, episodes=7, seed=3),
    configure("BncConnector", {"guidance": "kgrl"}, preset="sac_gridclamp", algorithm="sac", seed=2**31 - 1),
    configure("Pouring", {}, preset="pouring", settings={"net_arch": "32", "ent_coef": "0.2"}, step_log=False),
]


@pytest.fixture(scope="module")
def texts(folder):
    return [config_text(config, folder) for config in CONFIGS]


def read(folder):
    """Read a configuration and check that an environment and a learner can be built from it."""
    config = folder.config()
    check_environment(config.task, config.environment)
    LEARNERS.get(config.learner.algorithm)
    return config


def assert_config_is_exact_or_refused(target, folder, text):
    """Assert that a text of config.yaml is refused, or read with the values that PyYAML finds."""
    (folder.path / "config.yaml").write_text(text, encoding="utf-8", newline="")
    config = attempt(target, InputError, lambda: read(folder))
    if config is None:
        return
    expected = yaml.safe_load(text)
    for name in ("task", "seed", "episodes", "preset"):
        assert getattr(config, name) == expected[name]
        assert type(getattr(config, name)) is type(expected[name])
    for name, value in expected["environment"].items():
        result = config.environment[name]
        assert (list(result) if isinstance(result, tuple) else result) == value or value != value
    settings = config_values(config.learner)
    for name, value in expected["learner"].items():
        result = settings[name]
        if isinstance(result, bool) or isinstance(value, bool):
            assert result in (0, 1)
            assert isinstance(result, bool)
        elif isinstance(result, str):
            assert result == str(value)
        elif isinstance(result, tuple | list):
            assert list(result) == [int(n) for n in (value.split(",") if isinstance(value, str) else value)]
        else:
            assert result == float(value)


@few_inputs
@given(st.data())
def test_config_with_changed_entries_is_exact_or_refused(folder, texts, data):
    tree = data.draw(changed_trees([yaml.safe_load(text) for text in texts]))
    # Imported modules are executed, so a changed import can raise any exception.
    if isinstance(tree, dict):
        tree.pop("imports", None)
    assert_config_is_exact_or_refused(
        "config.yaml, entries changed", folder, yaml.safe_dump(tree, sort_keys=False, allow_unicode=True)
    )


@few_inputs
@given(st.data())
def test_config_with_changed_characters_is_exact_or_refused(folder, texts, data):
    text = data.draw(changed_texts([text.replace("imports: []\n", "") for text in texts]))
    assert_config_is_exact_or_refused("config.yaml, characters changed", folder, text)


ROW = {"episode": 0, "return": -1.25, "success": 1, "termination": "success", "steps": 40, "peak_force": 1.5}
ROW |= {"max_commanded_violation": -1e-3, "collisions": 0, "wall_time": 0.125}
ROWS = [ROW | {"episode": n, "return": -n / 3, "success": n % 2} for n in range(12)]
TABLE = table_text(ROWS).encode()
FIELDS = st.sampled_from(
    ["", "nan", "inf", "-inf", "1e400", "1e-400", "x", "True", "1_0", "0x10", " 1", "1 ", "9007199254740993", "None"]
    + ["1" * 30, "-0.0", '"1"', '"', "1,1", "success", "2001-01-01", "١", "\x00", "a\nb", "0.1" + "0" * 400, "1e5"]
)


def assert_table_is_exact_or_refused(target, folder, content):
    """Assert that the content of episodes.csv is refused, or read with the values that the csv module finds."""
    (folder.path / "episodes.csv").write_bytes(content)
    table = attempt(target, InputError, lambda: _summarized(folder))
    if table is None:
        return
    header, *rows = csv.reader(io.StringIO(content.decode(), newline=""))
    assert list(table.columns) == header
    assert len(table) == len([row for row in rows if row])
    for row, (_, result) in zip([row for row in rows if row], table.iterrows(), strict=True):
        for text, value in zip(row, result, strict=True):
            if isinstance(value, str):
                assert value == text
            elif text == "":
                assert pd.isna(value)
            elif isinstance(value, bool | np.bool_):
                assert str(value) == text
            else:
                assert float(value) == float(text) or float(text) != float(text)


def _summarized(folder):
    table = folder.episodes()
    summary(table, SUMMARY)
    return table


@few_inputs
@given(st.lists(st.tuples(st.integers(0, 12), st.integers(0, 8), FIELDS), min_size=1, max_size=3))
def test_episodes_with_changed_fields_are_exact_or_refused(folder, changes):
    rows = [line.split(",") for line in TABLE.decode().splitlines()]
    for row, column, field in changes:
        rows[row][column] = field
    assert_table_is_exact_or_refused("episodes.csv, odd fields", folder, "\n".join(map(",".join, rows)).encode())


@few_inputs
@given(edits(3))
def test_episodes_with_changed_bytes_are_exact_or_refused(folder, changes):
    assert_table_is_exact_or_refused("episodes.csv, bytes changed", folder, edited(TABLE, changes))


ARRAYS = {"weights": np.linspace(-1, 1, 6, dtype=np.float32).reshape(2, 3), "count": np.arange(3), "none": np.zeros(0)}
VALUES = {"rows": ROWS[:2], "learner": {"decisions": 12, "selection": {}}, "environment": {"state": 2**100}}


@few_inputs
@given(edits(3), bit_flips())
def test_checkpoint_with_changed_bytes_is_exact_or_refused(folder, changes, flips):
    save_checkpoint(folder.checkpoint, ARRAYS, VALUES)
    folder.checkpoint.write_bytes(flipped(edited(folder.checkpoint.read_bytes(), [] if flips else changes), flips))
    loaded = attempt("checkpoint, bytes changed", InputError, lambda: load_checkpoint(folder.checkpoint))
    if loaded is not None:
        assert loaded[1] == VALUES
        assert loaded[0].keys() == ARRAYS.keys()
        for name, array in ARRAYS.items():
            np.testing.assert_array_equal(loaded[0][name], array, strict=True)


LAYERS = [
    (np.linspace(-1, 1, 12, dtype=np.float32).reshape(4, 3), np.zeros(4, np.float32)),
    (np.linspace(1, -1, 8, dtype=np.float32).reshape(2, 4), np.ones(2, np.float32)),
]
DESCRIPTION = {"pool": 1, "action_low": [-1.0, -2.0], "action_high": [1.0, 2.0], "activation": "relu", "task": "Bead"}
DESCRIPTION |= {"observation_shape": [3]}
OBSERVATION = np.array([0.5, -1.0, 2.0])


def assert_policy_is_bounded_or_refused(target, folder, expected):
    """Assert that a policy is refused, or acts within its limits and with the expected action unless it is None."""
    policy = attempt(target, InputError, lambda: Policy.load(folder.path))
    if policy is None:
        return
    action = attempt(f"{target}, acting", InputError, lambda: policy(np.resize(OBSERVATION, policy._shape)))
    assert np.isfinite(action).all()
    assert (action >= policy._low).all()
    assert (action <= policy._high).all()
    if expected is not None:
        np.testing.assert_array_equal(action, expected)


@few_inputs
@given(st.sampled_from(["policy.json", "policy.safetensors"]), edits(3), bit_flips())
def test_policy_with_changed_bytes_is_exact_or_refused(folder, file, changes, flips):
    policy = Policy(LAYERS, DESCRIPTION)
    policy.save(folder.path)
    path = folder.path / file
    path.write_bytes(flipped(edited(path.read_bytes(), [] if flips else changes), flips))
    assert_policy_is_bounded_or_refused("policy, bytes changed", folder, policy(OBSERVATION))


@few_inputs
@given(st.data())
def test_policy_with_changed_entries_is_bounded_or_refused(folder, data):
    """The changed policies have a valid digest."""
    tree = data.draw(changed_trees([DESCRIPTION | {"format": FORMAT}]))
    Policy(LAYERS, DESCRIPTION).save(folder.path)
    tree = json.loads(json.dumps(tree, default=str))
    if isinstance(tree, dict):
        tree["digest"] = _digest(load_file(folder.path / "policy.safetensors"), tree)
    (folder.path / "policy.json").write_text(json.dumps(tree))
    assert_policy_is_bounded_or_refused("policy, entries changed", folder, None)


@pytest.fixture(scope="module")
def resumable(folder):
    """Return an environment, a small learner, and the arrays and values of the learner's checkpoint."""
    env = SpacesOnlyEnv()
    settings = {"net_arch": "4", "learning_starts": 2, "batch_size": 2, "gradient_steps": 1, "train_freq": 1}
    learner = LEARNERS.get("tqc")(
        resolve_preset("tqc_contact", "tqc", settings), env, action_repeat=1, seed=0, max_transitions=12, symmetry=None
    )
    arrays, values = learner.state()
    arrays = {key: array.copy() for key, array in arrays.items()}
    values = {
        "run": CONFIGS[0].identity,
        "rows": ROWS,
        "learner": values,
        "environment": env.np_random.bit_generator.state,
        "episodes": {},
    }
    return env, learner, arrays, json.loads(json.dumps(values))


def restored(folder, learner, env):
    loop = TrainingLoop(folder, learner, Episodes(CONFIGS[0], env))
    loop.restore()
    return loop


@few_inputs
@given(st.data())
def test_checkpoint_with_changed_content_is_exact_or_refused(folder, resumable, data):
    """The changed checkpoints have a valid digest."""
    env, learner, arrays, values = resumable
    changed = dict(arrays)
    for name in data.draw(st.lists(st.sampled_from(sorted(arrays)), max_size=2)):
        action = data.draw(st.sampled_from(["remove", "reshape", "type", "number", "rename", "repeat"]))
        array = changed.pop(name, arrays[name])
        if action == "reshape":
            changed[name] = array.reshape(-1, 1)
        elif action == "type":
            changed[name] = array.astype(data.draw(st.sampled_from(["f2", "f8", "i4", "u1"])))
        elif action == "number":
            changed[name] = np.full_like(array, data.draw(st.integers(0, 9)))
        elif action == "rename":
            changed[data.draw(st.sampled_from(["", "x", "optimizer/x", f"{name}/0"]))] = array
        elif action == "repeat":
            changed[name] = np.concatenate([array.ravel(), array.ravel()])
    tree = values if data.draw(st.booleans()) and changed.keys() else data.draw(changed_trees([values]))
    save_checkpoint(folder.checkpoint, changed, tree)
    folder.write_episodes(ROWS[: data.draw(st.sampled_from([3, len(ROWS)]))])
    resumed = attempt("checkpoint, other content", InputError, lambda: restored(folder, learner, env))
    if resumed is not None:
        assert resumed.rows == tree["rows"]
        restored_arrays, restored_values = learner.state()
        assert json.loads(json.dumps(restored_values)) == tree["learner"]
        assert restored_arrays.keys() == changed.keys()
        for name, array in changed.items():
            np.testing.assert_array_equal(restored_arrays[name], array, strict=True)
        assert env.np_random.bit_generator.state == tree["environment"]


def test_negative_number_in_a_generators_state_is_refused(folder, resumable):
    env, learner, arrays, values = resumable
    tree = json.loads(json.dumps(values))
    tree["learner"]["python"][1][0] = -1
    save_checkpoint(folder.checkpoint, arrays, tree)
    folder.write_episodes(ROWS)
    with pytest.raises(InputError, match="belongs to other settings"):
        restored(folder, learner, env)
