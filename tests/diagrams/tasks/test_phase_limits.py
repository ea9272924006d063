"""Limits of force, torque and speed in the states of a template, together with the limits of the task."""

from dataclasses import replace
from itertools import count

import gymnasium
import numpy as np
import pytest

from guiderail.diagrams.envs.make import make_env
from guiderail.diagrams.stations.impedance_control import WRENCH_RATE, make_phase_wrench_limit
from guiderail.diagrams.stations.station import Impedance, max_wrench
from guiderail.diagrams.tasks.grid_clamp import GridClamp
from guiderail.diagrams.tasks.registry import TASKS, register_task
from guiderail.models.common.errors import InputError
from guiderail.models.templates import Transition, load_template

NUMBERS = count()
HEIGHT = 0.012  # height at which the second state of `two_states` begins [m], above contact with the table


def with_limits(**limits):
    """Return the clamp's template with limits in its state."""
    template = load_template("grid_clamp")
    return replace(template, states=(replace(template.states[0], **limits),))


def two_states(above, below):
    """Return the clamp's template, split at `HEIGHT` into two states with limits."""
    template = load_template("grid_clamp")
    state = template.states[0]
    first = replace(state, name="above", transitions=(Transition("below", HEIGHT, 0.001),), ends_at=HEIGHT, **above)
    return replace(template, states=(first, replace(state, name="below", **below)))


def make_clamp(template, **options):
    """Return the clamp's environment with another template."""

    def prior(task):
        known = GridClamp.prior(task)
        return replace(known, template=replace(known.template, template=template))

    name = f"lab/Phases{next(NUMBERS)}"
    register_task(name)(type("Phases", (GridClamp,), {"prior": prior, "__module__": __name__}))
    try:
        return make_env(name, **options)
    finally:
        TASKS._entries.pop(name)
        gymnasium.registry.pop(f"{name}-v0")


def press(env, steps=16, action=(1.0, 1.0, -1.0)):
    """Press down and sideways on holes with an offset of 2.5 mm; return the force [N] of every control step."""
    env.reset(seed=0, options={"offset": (0.0025, 0.0)})
    over = False
    for _ in range(steps):
        if not over:
            *_, terminated, truncated, _ = env.step(np.array(action))
            over = terminated or truncated
    return env.trace.force


def phase_limit(env):
    """Return the system that limits force and torque by state, or None."""
    diagram = env.diagram.diagram
    return diagram.GetSubsystemByName("phase_wrench_limit") if diagram.HasSubsystemNamed("phase_wrench_limit") else None


@pytest.mark.parametrize("station", ["gantry", "arm"])
def test_force_is_below_the_limit_of_the_state(station):
    assert press(make_clamp(with_limits(), station=station)).max() > 8.0
    force = press(make_clamp(with_limits(max_force_n=6.0), station=station))
    assert 3.0 < force.max() < 6.0


def test_lower_limit_of_task_and_state_is_enforced():
    force = press(make_clamp(with_limits(max_force_n=25.0), force_limit_range=(8.0, 8.0)))
    assert 4.0 < force.max() < 8.0
    force = press(make_clamp(with_limits(max_force_n=6.0), force_limit_range=(25.0, 25.0)))
    assert 3.0 < force.max() < 6.0


def test_limit_changes_with_the_state_at_bounded_rate():
    env = make_clamp(two_states({}, {"max_force_n": 6.0}), action_repeat=1)
    limit = phase_limit(env)
    port = limit.get_phase_max_wrench_output_port()
    env.reset(seed=0, options={"offset": (0.0025, 0.0)})
    context = limit.GetMyContextFromRoot(env.simulator.get_context())
    guidance = env.diagram.diagram.GetSubsystemByName("guidance")
    state, guidance_context = (
        guidance.GetOutputPort("state"),
        guidance.GetMyContextFromRoot(env.simulator.get_context()),
    )
    bounds, states = [], []
    for _ in range(90):
        env.step(np.array([1.0, 1.0, -1.0]))
        bounds.append(port.Eval(context).copy())
        states.append(state.Eval(guidance_context)[0])
    changes = np.abs(np.diff(bounds, axis=0))
    assert states[0] == 0.0
    assert states[-1] == 1.0
    assert (changes <= WRENCH_RATE * env.diagram.control_period + 1e-12).all()
    np.testing.assert_array_equal(bounds[0], GridClamp.impedance(env.diagram.task).bound.numbers)
    np.testing.assert_array_equal(bounds[-1], np.minimum(bounds[0], max_wrench(6.0)))
    assert env.trace.force[-1] < 6.0


def test_command_satisfies_the_speed_limit_of_the_state():
    def speeds(template):
        env = make_clamp(template, action_repeat=1)
        press(env, 20, (0.3, 0.0, -1.0))
        return np.linalg.norm(np.diff(env.trace.commanded[:, :3], axis=0), axis=1) / env.diagram.control_period

    assert speeds(with_limits()).max() > 0.03
    slow = speeds(with_limits(max_speed_m_per_s=0.01))
    assert 0.0095 < slow.max() <= 0.01 * (1 + 1e-9)


def test_phase_limit_is_absent_without_force_limits():
    env = make_clamp(with_limits(max_speed_m_per_s=0.01))
    assert phase_limit(env) is None
    assert phase_limit(make_clamp(with_limits(max_torque_nm=1.0))) is not None
    names = [system.get_name() for system in env.diagram.diagram.GetSystems()]
    assert names == [system.get_name() for system in make_clamp(with_limits()).diagram.diagram.GetSystems()]


def test_force_limit_of_a_state_requires_bounded_force():
    with pytest.raises(InputError, match="state 'insert' of template 'grid_clamp' limits force or torque"):
        make_clamp(with_limits(max_torque_nm=1.0), bounded_force=False)
    make_clamp(with_limits(), bounded_force=False)


def test_state_does_not_raise_the_bound_of_the_station():
    bounded = Impedance().with_max_force(10.0)
    system = make_phase_wrench_limit(with_limits(max_force_n=100.0, max_torque_nm=100.0), bounded, 0.01)
    context = system.CreateDefaultContext()
    limit = with_limits(max_force_n=100.0, max_torque_nm=100.0).max_wrench(0)
    system.get_state_max_wrench_input_port().FixValue(context, limit)
    bound = system.get_phase_max_wrench_output_port().Eval(context)
    np.testing.assert_array_equal(bound, bounded.bound.numbers)
