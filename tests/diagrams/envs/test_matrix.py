"""Shipped tasks with every guidance and station: episodes, ports, options and held-out conditions."""

from importlib.util import find_spec

import gymnasium
import numpy as np
import pytest

from guiderail.diagrams.envs.config import EnvConfig, prior_of, stations_of
from guiderail.diagrams.envs.make import make_env, make_skill
from guiderail.diagrams.guidance.guidance import INPUTS, OUTPUTS
from guiderail.diagrams.guidance.registry import GUIDANCE, REQUIREMENTS, possible_guidance
from guiderail.diagrams.stations.registry import STATIONS
from guiderail.diagrams.stations.station import INPUTS as STATION_INPUTS
from guiderail.diagrams.stations.station import OUTPUTS as STATION_OUTPUTS
from guiderail.diagrams.tasks.narrow_passage import NarrowPassage
from guiderail.diagrams.tasks.registry import TASKS, environment_id
from guiderail.models.common.errors import InputError

SHIPPED = [name for name in TASKS.names() if TASKS.get(name).__module__.startswith("guiderail.")]
PAIRS = [(task, guidance) for task in SHIPPED for guidance in GUIDANCE.names()]
WHOLE_EPISODES = {("NarrowPassage", guidance) for guidance in possible_guidance(prior_of(NarrowPassage).provides)}
"""Pairs with an episode in test_narrow_passage.py."""


@pytest.mark.parametrize("task", SHIPPED)
def test_task_is_registered_as_an_environment(task):
    assert environment_id(task) in gymnasium.registry


@pytest.mark.parametrize(("task", "guidance"), [pair for pair in PAIRS if pair not in WHOLE_EPISODES])
def test_task_and_guidance_run_or_name_missing_requirements(task, guidance):
    provides = prior_of(TASKS.get(task)).provides
    if guidance not in possible_guidance(provides):
        with pytest.raises(InputError) as error:
            make_env(task, guidance=guidance)
        message = str(error.value)
        assert any(words in message for words in REQUIREMENTS.values()), message
        assert "\n" not in message
        return
    env = make_env(task, guidance=guidance, action_repeat=2)
    rng = np.random.default_rng(0)
    _, info = env.reset(seed=0)
    assert not info["fallback"]
    for _ in range(2):
        *_, terminated, truncated, info = env.step(rng.uniform(-0.3, 0.3, env.action_space.shape))
        assert {"is_success", "termination", "control_steps", "fallback"} <= set(info)
        if terminated or truncated:
            break
    assert info["control_steps"] == len(env.trace)
    assert np.isfinite(env.trace.measured).all()


@pytest.mark.parametrize("task", SHIPPED)
def test_station_and_guidance_have_the_declared_ports(task):
    missing = [engine for engine in ("pybullet", "sapien") if find_spec(engine) is None]  # their stations need them
    for name in (name for name in stations_of(TASKS.get(task)) if name not in missing):
        if STATIONS.get(name).is_simulated:
            diagram = make_env(task, station=name).diagram.diagram
        else:
            with pytest.raises(InputError, match="guiderail deploy"):
                make_env(task, station=name)
            diagram = make_skill(task, lambda observation: observation, station=name, robot_url="memq://").diagram
        station, guidance = (diagram.GetSubsystemByName(part) for part in ("station", "guidance"))
        assert all(station.HasInputPort(port) for port in STATION_INPUTS), name
        assert all(station.HasOutputPort(port) for port in STATION_OUTPUTS), name
        assert station.GetOutputPort("contact_force").size() == station.GetOutputPort("command_timed_out").size() == 1
        assert station.GetInputPort("desired_pose").size() == station.GetOutputPort("pose").size()
        assert all(guidance.HasInputPort(port) for port in INPUTS)
        assert all(guidance.HasOutputPort(port) for port in OUTPUTS)


@pytest.mark.parametrize("task", SHIPPED)
def test_resolved_options_resolve_to_themselves(task):
    """The options stored with a run resolve to the same options again."""
    values = EnvConfig.resolve(task, {}).options
    assert EnvConfig.resolve(task, values).options == values


@pytest.mark.parametrize("task", SHIPPED)
def test_held_out_conditions_differ_from_training_and_repeat(task):
    env = make_env(task)
    samples = []
    for seed, options in ((3, {}), (3, {"held_out": True}), (3, {"held_out": True}), (4, {"held_out": True})):
        _, info = env.reset(seed=seed, options=options)
        samples.append({key: np.array(value) for key, value in info.items() if isinstance(value, np.ndarray)})
    training, held_out, second, next_seed = samples
    assert any((training[key] != held_out[key]).any() for key in training)
    assert any((next_seed[key] != held_out[key]).any() for key in training)
    assert all((held_out[key] == second[key]).all() for key in training)
