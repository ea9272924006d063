"""Reset and step of `DiagramEnv`, on a task with one position, whose outputs are known exactly."""

import gymnasium
import numpy as np
import pytest
from pydrake.gym import DrakeGymEnv
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import DiagramBuilder, LeafSystem

from guiderail.diagrams.envs.env import INFO_KEYS, DiagramEnv
from guiderail.diagrams.envs.make import make_env
from guiderail.diagrams.envs.task_diagram import TaskDiagram
from guiderail.models.common.arrays import round_period
from guiderail.models.common.errors import InputError

TICK = round_period(0.02)
SUBSTEPS = 5
PERIOD = SUBSTEPS * TICK
SOLVER_FAILURE = "The SAP solver failed to converge at simulation time = 0.1."
HESSIAN_FAILURE = "The Hessian of the momentum cost along the search direction is NaN."


class Toy(LeafSystem):
    """System with one position, which changes by 0.1 times the held action at each control step.

    State: position, position at initialization, number of plant steps, held action of the control step.
    """

    def __init__(self):
        super().__init__()
        self.error: Exception | None = None
        self.failing, self.fails_from = "", 0.0  # name of a port or method; time from which it fails [s]
        self.nan_port = ""  # port whose value is NaN at position 0.1
        self.action = self.DeclareVectorInputPort("action", 1)
        self.state = self.DeclareDiscreteState(4)
        self.DeclareInitializationDiscreteUpdateEvent(self.initialize)
        self.DeclarePeriodicDiscreteUpdateEvent(PERIOD, 0.0, self.control)
        self.DeclarePeriodicDiscreteUpdateEvent(TICK, 0.0, self.tick)

        def port(name, size, value):
            def calc(context, output):
                self.fail(name, context)
                is_nan = name == self.nan_port and abs(self.x(context)[0] - 0.1) < 1e-9
                output.SetFromVector(np.full(size, np.nan) if is_nan else np.atleast_1d(value(self.x(context))))

            self.DeclareVectorOutputPort(name, size, calc, prerequisites_of_calc={self.xd_ticket()})

        port("observation", 4, lambda x: x)
        port("reward", 1, lambda x: 2 * x[0] + 1)
        port("double", 1, lambda x: 2 * x[0])
        port("constant", 1, lambda x: 1.0)
        port("termination", 1, lambda x: float(x[0] >= 0.95))
        port("commanded_violation", 1, lambda x: x[0] - 1)
        port("measured_violation", 1, lambda x: x[0] - 2)
        port("contact_force", 1, lambda x: 10 * x[0])
        port("desired_pose", 1, lambda x: x[0] + x[3])
        port("pose", 1, lambda x: x[0])
        port("fallback", 1, lambda x: float(abs(x[0] - 0.3) < 1e-9))

    def x(self, context):
        return context.get_discrete_state(self.state).value()

    def fail(self, name, context):
        if name == self.failing and context.get_time() >= self.fails_from - 1e-9:
            raise RuntimeError(HESSIAN_FAILURE)

    def initialize(self, context, state):
        self.fail("initialize", context)
        x = self.x(context).copy()
        x[1] = x[0]
        state.set_value(x)

    def control(self, context, state):
        if self.error is not None:
            raise self.error
        x = state.value().copy()
        x[3] = self.action.Eval(context)[0]
        x[0] += 0.1 * x[3]
        state.set_value(x)

    def tick(self, context, state):
        x = state.value().copy()
        x[2] += 1
        state.set_value(x)


def make(num_steps=20, plant_step=None, **arguments):
    """Return an environment of `Toy`, whose reset option `start` is the initial position."""
    builder = DiagramBuilder()
    if plant_step is not None:
        nested = DiagramBuilder()
        nested.AddSystem(MultibodyPlant(plant_step)).Finalize()
        builder.AddSystem(nested.Build())
    toy = builder.AddNamedSystem("toy", Toy())
    builder.ExportInput(toy.get_input_port(), "action")
    for i in range(toy.num_output_ports()):
        builder.ExportOutput(toy.get_output_port(i), toy.get_output_port(i).get_name())

    def randomize(context, rng, options):
        toy.fail("randomize", context)
        start = options.get("start", rng.uniform(-0.5, -0.4))
        toy.GetMyMutableContextFromRoot(context).get_mutable_discrete_state(toy.state).SetAtIndex(0, start)
        return {"start": start}

    task = TaskDiagram(
        diagram=builder.Build(),
        control_period=PERIOD,
        num_steps=num_steps,
        observation_space=gymnasium.spaces.Box(-np.inf, np.inf, (4,), np.float32),
        reward_terms=("double", "constant"),
        randomize=randomize,
    )
    env = DiagramEnv(task, **arguments)
    env.toy = toy
    return env


def test_info_has_all_keys_at_reset_and_every_step():
    env = make()
    expected = {*INFO_KEYS, "double", "constant"} - {"simulation_failure"}  # only after a failed simulation
    _, info = env.reset(options={"start": 0.0})
    assert set(info) == expected | {"start"}
    assert info["constraint_violation"] == -1.0
    _, reward, _, _, info = env.step([1.0])
    assert set(info) == expected
    assert info["contact_force"] == pytest.approx(1.0)
    assert reward == pytest.approx(info["double"] + info["constant"])


def test_initialization_reads_the_state_of_the_new_episode():
    env = make()
    env.reset(options={"start": 0.5})
    env.step([1.0])
    observation, _ = env.reset(options={"start": -0.25})
    np.testing.assert_array_equal(observation, np.float32([-0.25, -0.25, 0, 0]))


def test_reset_sets_the_held_action_to_zero():
    env = make()
    env.reset(options={"start": 0.0})
    env.step([1.0])
    env.reset(options={"start": 0.0})
    env.simulator.AdvanceTo(PERIOD)
    assert env.trace.measured.size == 0
    assert env.diagram.diagram.GetOutputPort("pose").Eval(env.simulator.get_context()) == [0.0]


def test_starts_repeat_only_when_the_seed_is_equal():
    def starts(seed):
        env = make()
        return [env.reset(seed=seed)[1]["start"], *(env.reset()[1]["start"] for _ in range(3))]

    assert starts(3) == starts(3)
    assert not set(starts(3)) & set(starts(4))
    # Environments without a seed sample different starts.
    assert starts(None) != starts(None)


def test_every_step_has_the_same_number_of_plant_steps():
    env = make(num_steps=1000)
    env.reset(options={"start": -1.0})
    ticks = [0.0]
    for _ in range(1000):
        observation, *_ = env.step([0.0])
        ticks.append(observation[2])
    assert set(np.diff(ticks)) == {SUBSTEPS}


def test_episode_is_truncated_at_the_time_limit():
    env = make(num_steps=3)
    env.reset(options={"start": 0.0})
    results = [env.step([0.0])[2:] for _ in range(3)]
    assert [(terminated, truncated) for terminated, truncated, _ in results] == [(False, False)] * 2 + [(False, True)]
    assert results[-1][2]["termination"] == "time_limit"
    assert not results[-1][2]["is_success"]
    assert len(env.trace) == 3


def test_success_in_the_last_step_terminates_the_episode():
    env = make(num_steps=2)
    env.reset(options={"start": 0.8})
    env.step([1.0])
    _, _, terminated, truncated, info = env.step([1.0])
    assert (terminated, truncated, info["termination"], info["is_success"]) == (True, False, "success", True)


def test_repeated_action_sums_rewards_until_the_episode_ends():
    env = make(action_repeat=4)
    env.reset(options={"start": 0.0})
    _, reward, terminated, _, info = env.step([1.0])
    assert reward == pytest.approx(4 + 2 * (0.1 + 0.2 + 0.3 + 0.4))
    assert info["constant"] == 4
    assert info["contact_force"] == pytest.approx(4.0)
    _, _, _, _, info = env.step([-1.0])
    assert info["constraint_violation"] == pytest.approx(0.3 - 1)  # the largest violation of the repeated control steps
    env.reset(options={"start": 0.75})
    *_, terminated, _, info = env.step([1.0])
    assert terminated
    assert info["control_steps"] == 2


@pytest.mark.parametrize(
    ("port", "key"),
    [
        ("commanded_violation", "constraint_violation"),
        ("measured_violation", "measured_violation"),
        ("contact_force", "contact_force"),
    ],
)
@pytest.mark.parametrize("action_repeat", [1, 3])
def test_info_is_nan_when_a_control_step_is_nan(port, key, action_repeat):
    env = make(action_repeat=action_repeat)
    env.reset(options={"start": 0.0})
    env.toy.nan_port = port
    info = env.step([1.0])[-1]
    assert {name for name, value in info.items() if value != value} == {key}


def test_trace_has_every_control_step():
    env = make(action_repeat=3)
    env.reset(options={"start": 0.0})
    env.step([0.5])
    env.step([-0.5])
    np.testing.assert_allclose(env.trace.measured[:, 0], [0.05, 0.1, 0.15, 0.1, 0.05, 0.0], atol=1e-12)
    np.testing.assert_allclose(env.trace.commanded[:3], env.trace.measured[:3] + 0.5)
    np.testing.assert_allclose(env.trace.force, 10 * env.trace.measured[:, 0])
    assert len(env.trace) == 6
    env.reset()
    assert len(env.trace) == 0


@pytest.mark.parametrize(
    "action", [[np.nan], [np.inf], [-np.inf], [0.5 + 1j], [0.0, 0.0], 0.0, "up", [[0.0]], None, [10**400]]
)
def test_invalid_action_is_refused_before_time_advances(action):
    env = make()
    env.reset(options={"start": 0.0})
    with pytest.raises(InputError, match="action"):
        env.step(action)
    assert env.simulator.get_context().get_time() == 0
    observation, *_ = env.step([1.0])
    assert observation[0] == np.float32(0.1)


def test_action_is_clipped_when_out_of_range():
    env = make()
    env.reset(options={"start": 0.0})
    observation, *_ = env.step([1e9])
    assert observation[0] == np.float32(0.1)


@pytest.mark.parametrize("kind", [RuntimeError, ValueError, SystemExit, KeyboardInterrupt])
def test_wiring_error_is_raised_and_does_not_truncate(kind):
    env = make()
    env.reset()
    env.toy.error = kind("InputPort::Eval(): required InputPort[0] (u0) is not connected")
    with pytest.raises(kind, match="not connected"):
        env.step([0.0])


@pytest.mark.parametrize(
    "error",
    [
        RuntimeError(SOLVER_FAILURE),
        RuntimeError("Actuation input port for model instance robot contains NaN."),
        SystemExit("Failure in SetPositionsAndVelocities(): condition 'AllFinite(q_v)' failed."),
    ],
)
def test_simulation_failure_truncates_with_the_last_observation(error):
    env = make()
    env.reset(options={"start": 0.0})
    before, *_ = env.step([1.0])
    env.toy.error = error
    after, reward, terminated, truncated, info = env.step([1.0])
    assert (reward, terminated, truncated) == (0.0, False, True)
    assert info["simulation_failure"] == str(error)
    assert info["termination"] == ""
    assert info["constraint_violation"] == pytest.approx(0.1 - 1)
    np.testing.assert_array_equal(after, before)
    env.toy.error = None
    env.reset(options={"start": 0.0})
    assert env.step([1.0])[0][0] == np.float32(0.1)


PORTS = [port.get_name() for port in map(Toy().get_output_port, range(Toy().num_output_ports()))]
READ_AT_RESET = ("observation", "pose", "commanded_violation", "measured_violation", "fallback")


@pytest.mark.parametrize("port", PORTS)
def test_port_failure_truncates_before_the_failed_step(port):
    env = make(action_repeat=3)
    before, info = env.reset(options={"start": 0.0})
    env.toy.failing, env.toy.fails_from = port, (3 if port == "observation" else 2) * PERIOD
    after, reward, terminated, truncated, info = env.step([1.0])
    steps = 2 if port == "observation" else 1  # the observation is read only after the last control step
    assert (terminated, truncated, info["termination"]) == (False, True, "")
    assert info["simulation_failure"] == HESSIAN_FAILURE
    assert info["control_steps"] == len(env.trace) == steps
    assert reward == pytest.approx([1.2, 2.6][steps - 1])
    np.testing.assert_array_equal(after, before)
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step([1.0])
    env.toy.failing = ""
    env.reset(options={"start": 0.0})
    assert env.step([1.0])[0][0] == np.float32(0.3)


@pytest.mark.parametrize("failing", [*PORTS, "randomize", "initialize"])
def test_reset_failure_truncates_at_the_first_step(failing):
    env = make()
    env.reset(options={"start": 0.0})
    before, *_ = env.step([1.0])
    env.toy.failing = failing
    observation, info = env.reset(options={"start": 0.5})
    if failing in {*READ_AT_RESET, "randomize", "initialize"}:
        assert info["simulation_failure"] == HESSIAN_FAILURE
        np.testing.assert_array_equal(observation, before)
        env.toy.failing = ""
    after, reward, terminated, truncated, info = env.step([1.0])
    assert (reward, terminated, truncated) == (0.0, False, True)
    assert info["simulation_failure"] == HESSIAN_FAILURE
    assert info["control_steps"] == len(env.trace) == 0
    np.testing.assert_array_equal(after, observation)
    env.toy.failing = ""
    assert "simulation_failure" not in env.reset(options={"start": 0.0})[1]
    assert env.step([1.0])[0][0] == np.float32(0.1)


@pytest.mark.parametrize("failing", [*READ_AT_RESET, "randomize", "initialize"])
def test_failure_before_the_first_observation_is_raised(failing):
    env = make()
    env.toy.failing = failing
    with pytest.raises(RuntimeError, match="Hessian"):
        env.reset()


@pytest.mark.parametrize("position", [10.5, -10.5, 1e300, np.nan, np.inf])
def test_simulation_fails_when_the_position_is_implausible(position):
    env = make(action_repeat=2)
    env.reset(options={"start": 0.0})
    context = env.toy.GetMyMutableContextFromRoot(env.simulator.get_mutable_context())
    context.get_mutable_discrete_state(env.toy.state).SetAtIndex(0, position)
    _, reward, terminated, truncated, info = env.step([0.0])
    assert (reward, terminated, truncated, info["control_steps"]) == (0.0, False, True, 0)
    assert "the robot is at" in info["simulation_failure"] or "not finite" in info["simulation_failure"]


def test_simulation_fails_when_joint_speed_is_implausible():
    env = make_env("NarrowPassage")
    env.reset(seed=0)
    (plant,) = env._plants
    context = plant.GetMyMutableContextFromRoot(env.simulator.get_mutable_context())
    plant.SetVelocities(context, np.full(plant.num_velocities(), 1e7))
    *_, truncated, info = env.step(np.zeros(2))
    assert truncated
    assert info["simulation_failure"]
    env.reset()
    assert "simulation_failure" not in env.step(np.zeros(2))[-1]
    plant.SetVelocities(context, np.array([0.0, -1001.0]))
    with pytest.raises(RuntimeError, match="a joint moves at 1001"):
        env._check_plausible(env.simulator.get_context(), np.zeros(2))


def test_step_is_refused_before_a_reset_and_after_the_end():
    env = make(num_steps=1)
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step([0.0])
    env.reset()
    env.step([0.0])
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step([0.0])


def test_metadata_is_not_shared_between_environments():
    before = dict(gymnasium.Env.metadata), dict(DrakeGymEnv.metadata), dict(DiagramEnv.metadata)
    first, second = make(action_repeat=1), make(action_repeat=5)
    assert (dict(gymnasium.Env.metadata), dict(DrakeGymEnv.metadata), dict(DiagramEnv.metadata)) == before
    assert (first.metadata["render_fps"], second.metadata["render_fps"]) == (10, 2)
    assert make(action_repeat=30).metadata["render_fps"] == 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"render_mode": "rgb_array"}, "camera"),
        ({"render_mode": "human"}, "Meshcat"),
        ({"render_mode": "ascii"}, "render mode"),
    ],
)
def test_env_refuses_unsupported_arguments(arguments, message):
    with pytest.raises(InputError, match=message):
        make(**arguments)


@pytest.mark.parametrize("step", [0.03, 0.2])
def test_time_step_of_a_nested_plant_divides_the_control_period(step):
    make(plant_step=0.025)
    make(plant_step=0.0)  # continuous
    with pytest.raises(InputError, match=f"of 0.1 s is no whole multiple of a plant's time step of {step} s"):
        make(plant_step=step)


def test_step_is_refused_when_the_simulator_is_ahead():
    env = make()
    env.reset(seed=0)
    env.simulator.AdvanceTo(3 * PERIOD)
    with pytest.raises(InputError, match="advance it by step"):
        env.step([0.0])
