"""Environment server for programs of another Python installation."""

import io
import json
from functools import partial

import gymnasium
import numpy as np
import pytest

import guiderail  # noqa: F401 (registers the environments)
from guiderail.diagrams.envs.make import make_env
from guiderail.models.common.errors import InputError
from guiderail_lerobot.env_server import MAX_LINE, EnvServer, open_environment, serve

OPTIONS = {"guidance": "kgrl", "action_repeat": 20}


@pytest.fixture(scope="module")
def server():
    return EnvServer(open_environment("NarrowPassage", OPTIONS))


def test_answers_equal_the_steps_of_the_environment(server):
    env = gymnasium.make("guiderail/NarrowPassage-v0", **OPTIONS)
    observation, _ = env.reset(seed=3)
    assert server.answer({"reset": 3})["observation"] == observation.tolist()
    for _ in range(3):
        observation, *_ = env.step(np.full(2, 0.5))
        answer = server.answer({"action": [0.5, 0.5]})
        assert answer["observation"] == observation.tolist()
    assert answer["pose"] == env.unwrapped.trace.measured[-1].tolist()
    assert not answer["is_done"]


def test_seed_determines_the_hidden_offset_of_a_run():
    options = {"guidance": "kgrl", "station": "gantry", "action_repeat": 10}
    env = gymnasium.make("guiderail/BncConnector-v0", **options)
    offsets = [env.reset(seed=3)[1]["jack_offset"]]
    server = EnvServer(open_environment("BncConnector", options))
    for seed in (4, 3):
        server.answer({"reset": seed})
        offsets.append(server._info["jack_offset"])
    server.answer({"reset": None})
    np.testing.assert_array_equal(offsets[0], offsets[2])
    assert (offsets[1] != offsets[2]).any()
    np.testing.assert_array_equal(server._info["jack_offset"], offsets[2])


def test_end_of_the_episode_is_reported(server):
    answer = server.answer({"reset": 0})
    while not answer["is_done"]:
        answer = server.answer({"action": [0.0, 0.0]})
    assert answer["termination"]
    assert "reset" in server.answer({"action": [0.0, 0.0]})["error"]
    assert not server.answer({"reset": None})["is_done"]


@pytest.mark.parametrize(
    "request_",
    [
        {"action": [float("nan"), 0.0]},
        {"action": [0.0]},
        {"action": "up"},
        {"reset": -1},
        {"reset": True},
        {},
        [],
        {"x": 1},
    ],
)
def test_invalid_request_is_refused_and_changes_no_state(server, request_):
    before = server.answer({"reset": 0})
    assert "error" in server.answer(request_)
    assert server._state() == before


def test_lines_are_answered_until_the_input_ends(server):
    answers = io.StringIO()
    serve(server, io.StringIO('{"reset": 1}\nnonsense\n'), answers)
    first, second, third = map(json.loads, answers.getvalue().splitlines())
    assert first["action_size"] == 2
    assert first["period"] == pytest.approx(server._env.time_step)
    assert "observation" in second
    assert "one line of JSON" in third["error"]


def test_line_that_is_too_long_is_answered_with_one_error(server):
    answers = io.StringIO()
    padded = " " * MAX_LINE + '{"reset": 1}'
    serve(server, io.StringIO(f'{padded}\n{{"reset": 1}}\n{padded}'), answers)
    _, first, second, third = map(json.loads, answers.getvalue().splitlines())
    assert "one line of JSON" in first["error"]
    assert "observation" in second
    assert "one line of JSON" in third["error"]


@pytest.mark.parametrize(
    ("open_name", "message"),
    [(partial(open_environment, options={}), "cannot be read"), (make_env, "there is no task")],
)
def test_name_that_is_too_long_is_refused(open_name, message):
    with pytest.raises(InputError, match=message):
        open_name("x" * 300)


def test_real_robot_is_refused():
    pytest.importorskip("guiderail_hardware", reason="needs the station of guiderail-hardware")
    with pytest.raises(InputError, match="real robot"):
        open_environment("BncConnector", {"station": "hardware"})
