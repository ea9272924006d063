"""Environment NarrowPassage, made by `gymnasium.make`: constraints, rewards, pushes, images and options."""

import warnings
from itertools import islice

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env as gymnasium_check
from pushed_station import push_robot
from stable_baselines3.common.env_checker import check_env as sb3_check

import guiderail
from guiderail.diagrams.envs import assemble, scene
from guiderail.diagrams.envs.config import prior_of
from guiderail.diagrams.guidance.registry import possible_guidance
from guiderail.diagrams.tasks.narrow_passage import NarrowPassage
from guiderail.models.common.errors import InputError
from guiderail.models.objects.narrow_passage import PassageGeometry

WORLD = PassageGeometry()
GUIDANCE = possible_guidance(prior_of(NarrowPassage).provides)
NULL_SPACE = ("kgrl", "skgrl")


def make(guidance="skgrl", **arguments):
    return gymnasium.make("guiderail/NarrowPassage-v0", guidance=guidance, **arguments).unwrapped


def play(env, policy, **reset):
    """Run an episode; return rewards, observations and all infos. `policy` depends on the number of the action."""
    observation, info = env.reset(**reset)
    observations, rewards, infos = [observation], [], [info]
    finished = False
    while not finished:
        observation, reward, terminated, truncated, info = env.step(policy(len(rewards)))
        finished = terminated or truncated
        observations.append(observation)
        rewards.append(reward)
        infos.append(info)
    return np.array(rewards), np.array(observations), infos


def zero_action(_):
    return np.zeros(2, np.float32)


def adversaries():
    """Yield policies with extreme actions: constant, alternating at several rates, and random.

    Where a test has two cases, each case uses every second policy.
    """
    rng = np.random.default_rng(0)
    corners = [np.array(corner, np.float32) for corner in ((1, 1), (1, -1), (-1, 1), (-1, -1), (1, 0), (-1, 0))]
    yield from (lambda k, corner=corner: corner for corner in corners)
    yield from (lambda k, steps=steps: np.full(2, (-1.0) ** (k // steps), np.float32) for steps in (1, 4, 10))
    for _ in range(2):
        yield lambda k: rng.uniform(-1, 1, 2).astype(np.float32)
        yield lambda k: rng.choice([-1.0, 1.0], 2).astype(np.float32)


@pytest.mark.parametrize(
    ("guidance", "options"),
    [("skgrl", {}), ("residual", {}), ("kgrl", {"observation": "image", "render_mode": "rgb_array"})],
)
def test_environment_passes_the_checkers_without_a_warning(guidance, options, monkeypatch):
    monkeypatch.setenv("DRAKE_ALLOW_NETWORK", "meshcat")  # Gymnasium's checker also makes render_mode="human"
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        env = make(guidance, **options)
        gymnasium_check(env, skip_render_check=not options)
        sb3_check(env, warn=True)
    assert not [str(warning.message) for warning in warned]


@pytest.mark.parametrize("guidance", GUIDANCE)
def test_zero_action_succeeds_and_crosses_the_obstacle(guidance):
    env = make(guidance)
    rewards, _, infos = play(env, lambda _: np.zeros(env.action_space.shape, np.float32), seed=0)
    assert not infos[0]["fallback"]
    assert {"is_success", "termination", "control_steps", "fallback"} <= set(infos[-1])
    assert infos[-1]["control_steps"] == len(env.trace)
    assert infos[-1]["is_success"]
    assert env.trace.statistics()["collisions"] == 0
    assert sum(info["obstacle_cost"] for info in infos) < -50
    total = sum(info[name] for info in infos for name in env.diagram.reward_terms)
    assert rewards.sum() == pytest.approx(total)
    assert infos[-1]["terminal_reward"] == 200


@pytest.mark.parametrize(("guidance", "action_repeat", "first"), [("kgrl", 5, 0), ("skgrl", 1, 1)])
def test_null_space_guidance_withstands_adversaries(guidance, action_repeat, first):
    env = make(guidance, action_repeat=action_repeat)
    for policy in islice(adversaries(), first, None, 2):
        _, _, infos = play(env, policy)
        statistics = env.trace.statistics()
        assert statistics["max_commanded_violation"] <= 1e-9
        assert statistics["max_measured_violation"] <= 1e-9
        assert statistics["collisions"] == 0
        assert infos[-1]["is_success"]
        # The trace and the infos of the steps have the same violations.
        assert statistics["max_commanded_violation"] == max(info["constraint_violation"] for info in infos[1:])
        assert statistics["max_measured_violation"] == max(info["measured_violation"] for info in infos[1:])
        assert statistics["steps"] == len(env.trace)


@pytest.mark.parametrize("guidance", NULL_SPACE)
def test_no_action_sequence_reaches_the_walls(guidance):
    """The sum of absolute impulse responses bounds the reach of all sequences with an action per control step."""
    lc_ns_kmp = make(guidance).diagram.diagram.GetSubsystemByName("guidance").GetSubsystemByName("lc_ns_kmp")
    primitive, gain = lc_ns_kmp.primitive, lc_ns_kmp.gain
    steps, history = primitive.num_steps, primitive.history
    response = np.zeros((history + steps, 2, steps, 2))  # [step n, output, step k, action]
    for n in range(steps):
        history_map, action_map, _ = primitive.linear_response(n)
        response[history + n, :, n] = action_map * gain
        if history:
            past = response[n : n + history].reshape(history * 2, -1)
            response[history + n] += (history_map @ past).reshape(2, steps, 2)
    reach = np.abs(response[history:]).sum(axis=(2, 3))
    env = make(guidance, action_repeat=1)
    play(env, zero_action)
    path = env.trace.commanded
    bottom, top = WORLD.wall_y
    y_reach = reach[: len(path), 1]
    is_between_walls = (path[:, 1] + y_reach > bottom) & (path[:, 1] - y_reach < top)
    assert is_between_walls.sum() > 30
    x, x_reach = path[is_between_walls, 0], reach[: len(path)][is_between_walls, 0]
    assert (x - x_reach > WORLD.gap_x[0]).all()
    assert (x + x_reach < WORLD.gap_x[1]).all()


def test_residual_collides_but_does_not_pass_through_walls():
    env = make("residual", action_scale=3.0)
    lower, upper = WORLD.walls
    endings, collisions, violation = set(), 0, -np.inf
    for policy in islice(adversaries(), 0, None, 2):
        _, _, infos = play(env, policy)
        endings.add(infos[-1]["termination"])
        collisions += env.trace.statistics()["collisions"]
        violation = max(violation, env.trace.statistics()["max_measured_violation"])
        # A wall is penetrated by at most 21 mm, about the motion of the robot in one plant step.
        path = env.trace.measured[:, None]
        assert not ((path > lower + 0.021) & (path < upper - 0.021)).all(axis=2).any()
    assert "blocked" in endings
    assert collisions > 10
    assert violation > 0.01


def test_safe_residual_is_blocked_without_collisions():
    endings = set()
    for first, action_scale in enumerate((1.0, 3.0)):
        env = make("safe_residual", action_scale=action_scale)
        for policy in islice(adversaries(), first, None, 2):
            _, _, infos = play(env, policy)
            endings.add(infos[-1]["termination"])
            assert env.trace.statistics()["collisions"] == 0
            assert env.trace.statistics()["max_measured_violation"] <= -0.02 + 1e-6
    assert "blocked" in endings


def test_skgrl_has_less_jerk_than_kgrl():
    rng = np.random.default_rng(0)
    actions = rng.uniform(-1, 1, (80, 2)).astype(np.float32)
    jerk = {}
    for guidance in NULL_SPACE:
        env = make(guidance)
        play(env, lambda k: actions[k])
        jerk[guidance] = guiderail.diagrams.envs.trace.mean_jerk(env.trace.measured, env.trace.period)
    assert jerk["skgrl"] < jerk["kgrl"] / 10


def test_episode_has_the_length_of_the_thesis():
    env = make("kmp")
    _, observations, _ = play(env, zero_action)
    assert observations[0] == -1.0
    assert (np.diff(observations[:, 0]) > 0).all()
    assert env.diagram.num_steps == 400
    assert env.diagram.control_period == pytest.approx(0.02, rel=1e-9)


def test_shaped_reward_adds_progress_towards_the_goal():
    sparse, _, _ = play(make("kmp"), zero_action)
    shaped, _, infos = play(make("kmp", reward="shaped"), zero_action)
    progress = sum(info["progress"] for info in infos)
    assert shaped.sum() == pytest.approx(sparse.sum() + progress)
    start = np.linalg.norm(np.array(WORLD.goal) - infos[0]["start"])
    assert progress == pytest.approx(100 * (start - WORLD.goal_radius), abs=1.0)


@pytest.fixture(scope="module")
def measuring():
    """Return an environment whose history is the measured pose."""
    return make("skgrl", history={"length": 1, "source": "measured"})


@pytest.mark.parametrize(
    ("step", "push"),
    [(10, (-0.1, 0.0)), (10, (0.0, 0.03)), (20, (0.1, 0.0)), (45, (0.01, 0.0)), (45, (0.0, 0.03))],
)
def test_command_continues_at_the_pushed_pose(step, push, measuring):
    """Section 5.3.4: with P = 1 the history is the measured pose, so the command continues at the robot."""
    env = measuring
    env.reset()
    info = {"termination": ""}
    worst_after = -np.inf
    for k in range(80):
        if k == step:
            before = env.trace.commanded[-1].copy()
            push_robot(env, push)
        *_, info = env.step(zero_action(k))
        if k >= step:
            worst_after = max(worst_after, info["constraint_violation"])
        if info["termination"]:
            break
    jump = env.trace.commanded[5 * step] - (before + push)
    assert np.linalg.norm(jump) < 0.03 + max(0.0, before[0] + push[0] - WORLD.zone_x)
    assert worst_after <= 1e-9
    assert info["is_success"]
    assert env.trace.statistics()["collisions"] == 0


def test_robot_returns_when_pushed_out_of_the_constraint():
    env = make("skgrl", history={"length": 1, "source": "measured"}, action_repeat=1)
    env.reset()
    for k in range(100):
        env.step(zero_action(k))
    push_robot(env, [WORLD.zone_x + 0.05 - env.trace.measured[-1, 0], 0.0])
    *_, info = env.step(zero_action(0))
    assert info["constraint_violation"] <= 1e-9
    measured = []
    for k in range(30):
        *_, info = env.step(zero_action(k))
        assert info["constraint_violation"] <= 1e-9
        measured.append(info["measured_violation"])
    assert max(measured[1:]) <= 1e-6
    assert info["termination"] == ""


def test_reset_option_start_sets_the_start():
    env = make("skgrl")
    _, info = env.reset(options={"start": (0.27, 0.07)})
    np.testing.assert_allclose(info["start"], [0.27, 0.07])
    env.step(zero_action(0))
    assert np.linalg.norm(env.trace.commanded[0] - [0.27, 0.07]) < 0.005
    for options in ({"begin": 1}, {"start": (0, 0, 0)}, {"start": (np.nan, 0)}, {"start": "here"}):
        with pytest.raises(InputError, match="start"):
            env.reset(options=options)


def test_memory_does_not_grow_with_resets(forks, tmp_path):
    # A separate process, because memory of other tests would be part of the measurement.
    script = """
import gymnasium, guiderail
env = gymnasium.make("guiderail/NarrowPassage-v0", guidance="skgrl", action_repeat=1).unwrapped
import gc, resource
import numpy as np
def run(resets):
    for k in range(resets):
        env.reset(seed=k)
        env.step(np.ones(2, np.float32))
    gc.collect()
    return int(open("/proc/self/statm").read().split()[1]) * resource.getpagesize()
env.reset()
for k in range(340):
    env.step(np.zeros(2, np.float32))  # computes the factorization of every step once
before = run(100)
print(run(400) - before)
"""
    result = forks.run("-c", script, folder=tmp_path, DRAKE_ALLOW_NETWORK="meshcat", OMP_NUM_THREADS="1")
    assert int(result.stdout) < 400_000, result.stderr


def test_image_shows_the_motion_of_the_robot():
    env = make("kmp", observation="image")
    first, _ = env.reset()
    assert (first.shape, first.dtype) == ((110, 144, 3), np.uint8)
    assert env.observation_space.contains(first)
    second = first
    for k in range(20):
        second, *_ = env.step(zero_action(k))
    is_changed = np.abs(first.astype(int) - second).max(axis=2) > 40
    # Only pixels of the robot change, at its first and at its last position.
    assert 5 < is_changed.sum() < 120
    columns = np.flatnonzero(is_changed.any(axis=0))
    assert np.ptp(columns) > 10


def test_missing_display_library_is_named(monkeypatch):
    load = scene.ctypes.CDLL

    def missing(name, *arguments, **named):
        if "EGL" in str(name):
            raise OSError(f"{name}: cannot open shared object file")
        return load(name, *arguments, **named)

    monkeypatch.setattr(scene.ctypes, "CDLL", missing)
    for arguments in ({"observation": "image"}, {"render_mode": "rgb_array"}):
        with pytest.raises(InputError, match=r"libEGL\.so\.1.*libegl1"):
            make("kmp", horizon=17, **arguments)  # a horizon that no reused diagram has
    make("kmp")  # without a camera


@pytest.mark.parametrize("guidance", NULL_SPACE)
def test_commands_avoid_an_obstacle_that_is_a_constraint(guidance):
    options = {"obstacle_radius": 0.06, "max_speed": (0.5,), "max_acceleration": (4.0,)}
    env = make(guidance, obstacles_constrain=True, action_repeat=5, **options)
    rng = np.random.default_rng(0)
    _, _, infos = play(env, lambda k: np.array([0.5, rng.uniform(-1.0, 1.0)]), seed=0)
    commands = env.trace.commanded
    distances = np.linalg.norm(commands - WORLD.obstacle, axis=1) - 0.06
    assert 0.0 <= distances.min() < 1e-3
    assert max(info["constraint_violation"] for info in infos[1:]) <= 1e-9
    displacements = np.diff(commands, axis=0) / env.diagram.control_period
    assert np.abs(displacements).max() <= 0.5 * (1 + 1e-9)


def test_observed_phase_stops_while_the_motion_waits(monkeypatch):
    monkeypatch.setattr(assemble, "PROGRESS_TOLERANCE", (1e-9, 0.1))
    monkeypatch.setattr(assemble, "MAX_LAG", 0.5)
    env = make("kgrl", progress="state", action_repeat=5, history=7)  # no diagram of this key is in the pool
    clock, times = make("kgrl", action_repeat=5), []
    assert env.diagram.num_steps == clock.diagram.num_steps + round(0.5 / env.diagram.control_period)
    duration = clock.diagram.num_steps * env.diagram.control_period
    env.reset(seed=0)
    for _ in range(12):
        observation, *_ = env.step(np.zeros(2))
        times.append(env.diagram.diagram.GetOutputPort("motion_time").Eval(env.simulator.get_context())[0])
        assert observation[0] == pytest.approx(2.0 * times[-1] / duration - 1.0, abs=1e-6)
    late = 60 * env.diagram.control_period - np.array(times[-1])
    assert 0.3 < late <= 0.5 + 2 * env.diagram.control_period  # the position error is almost always above 1 nm
