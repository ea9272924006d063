"""Task that a user declares: effects of the declaration, and messages about mistakes in it."""

import sys

import gymnasium
import numpy as np
import pytest

from guiderail.diagrams.envs.config import EnvConfig, prior_of
from guiderail.diagrams.envs.env import INFO_KEYS, RECORDED_SIGNALS
from guiderail.diagrams.envs.make import make_env
from guiderail.diagrams.envs.observation import ObservationTerm, affine
from guiderail.diagrams.guidance.prior import Prior
from guiderail.diagrams.guidance.registry import possible_guidance
from guiderail.diagrams.stations.plane import PlaneStation
from guiderail.diagrams.tasks.registry import TASKS, register_task
from guiderail.diagrams.tasks.task import Task, Threshold
from guiderail.models.common.errors import InputError
from guiderail.models.objects.narrow_passage import PassageGeometry
from guiderail.models.primitives import ReferenceTrajectory
from guiderail.tools.catalog import describe_task_options
from guiderail.tools.evaluation.baselines import find_scripted_policy
from guiderail.tools.evaluation.subject import counts_collisions, evaluation_scope
from guiderail.tools.imports import import_modules
from guiderail.tools.learning.train import train
from research.action_fuzzing.tasks import fuzz

NUM_STEPS = 10


class Own(Task):
    """Task whose reference moves straight up through a wide gap."""

    station = PlaneStation

    def workcell(self):
        return PassageGeometry(start=(0.35, 0.1), goal=(0.35, 0.9), goal_radius=0.05, gap_x=(0.2, 0.5))

    def prior(self):
        means = np.column_stack([np.full(NUM_STEPS, 0.35), np.linspace(0.1, 0.2, NUM_STEPS)])
        times, covariances = 0.02 * np.arange(NUM_STEPS), np.tile(1e-4 * np.eye(2), (NUM_STEPS, 1, 1))
        return Prior(ReferenceTrajectory(times, means, covariances))

    def rewards(self):
        return {"a": lambda pose: -float(pose[1])}

    def done(self):
        return {"success": self.workcell().at_goal}


@pytest.fixture(autouse=True)
def remove_task():
    yield
    TASKS._entries.pop("lab/Own", None)
    gymnasium.registry.pop("lab/Own-v0", None)


def first_step(**options):
    env = make_env("lab/Own", guidance="kmp", **options)
    env.reset(seed=0)
    env.step(np.zeros(env.action_space.shape))


def declare(of=Own, **attributes):
    return register_task("lab/Own")(type("Declared", (of,), {**attributes, "__module__": __name__}))


@pytest.mark.parametrize(
    ("attributes", "message"),
    [
        ({"prior": lambda self: Prior()}, r"no guidance can be built for lab/Own: let its prior\(\) have a reference"),
        ({"presets": {"hard": {"gapp": 1}}}, "hard of lab/Own sets the unknown option 'gapp'"),
        ({"defaults": {"histroy": 5}}, "defaults of lab/Own sets the unknown option 'histroy': did you mean history"),
    ],
)
def test_task_without_a_possible_environment_is_refused(attributes, message):
    declare(**attributes)
    with pytest.raises(InputError, match=message):
        EnvConfig.resolve("lab/Own", {})


def test_task_that_lacks_methods_is_refused_with_their_names():
    message = "the class Declared lacks done, workcell: see `Task`"
    with pytest.raises(InputError, match=message):
        declare(of=Task, station=PlaneStation)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("reward_terms", lambda self: {}, "Task has no method 'reward_terms': did you mean rewards?"),
        ("reward", lambda self: {}, "'reward' is an option of Declared, not a method: did you mean rewards?"),
        ("colision", property(lambda self: None), "did you mean collision?"),
        ("clipp", 2.0, "did you mean clip?"),
        ("motion_constraints", lambda self: None, r"return Prior\(reference, linear, motion=\.\.\.\)"),
    ],
)
def test_misspelled_method_of_a_task_is_refused(name, value, message):
    with pytest.raises(InputError, match=message):
        declare(**{name: value})
    declare(**{"_" + name: value, "goal": value, "station": lambda workcell: None})


def test_default_guidance_has_an_effect():
    declare()
    assert possible_guidance(prior_of(TASKS.get("lab/Own")).provides)[0] == "base_policy"
    assert EnvConfig.resolve("lab/Own", {}).guidance == "kgrl"


def test_scripted_policy_is_the_first_or_that_of_the_difficulty():
    def hold(observation):
        return np.zeros(2)

    def push(observation):
        return np.ones(2)

    declare(scripted_policies=(hold, push), scripted_defaults={"hard": push}, presets={"hard": {"history": 4}})
    assert find_scripted_policy("lab/Own", "scripted") is hold
    assert find_scripted_policy("lab/Own", "scripted", "hard") is push
    assert find_scripted_policy("lab/Own", "hold", "hard") is hold


def test_default_reward_is_one_at_success():
    declare(rewards=Task.rewards)
    env = make_env("lab/Own", guidance="kmp")
    env.reset(seed=0)
    over, rewards = False, []
    while not over:
        _, reward, terminated, truncated, info = env.step(np.zeros(env.action_space.shape))
        rewards.append(reward)
        over = terminated or truncated
    assert sum(rewards) == float(info["termination"] == "success")


def test_settings_of_another_guidance_are_accepted():
    declare(presets={"hard": {"history": 4}}, defaults={"guidance": "kmp"})
    assert EnvConfig.resolve("lab/Own", {"difficulty": "hard"}).options["guidance"] == "kmp"


HUGE = {name: lambda pose: 1e308 for name in "ab"}


def returning(value):
    return lambda self, *arguments: value


@pytest.mark.parametrize(
    ("attributes", "message"),
    [
        ({"rewards": returning({"a": lambda pose: np.nan})}, "reward term 'a' of lab/Own is not finite, but nan"),
        ({"rewards": returning({"a": lambda pose: pose})}, "reward term 'a' of lab/Own must be one number, and it is"),
        ({"rewards": returning({"a": lambda place: 0.0})}, "the reward of lab/Own needs the signal 'place'"),
        ({"rewards": returning({"a": 3.0})}, "the reward of lab/Own is a function of signals, .*, not 3.0"),
        ({"rewards": returning({"a": max})}, "the reward of lab/Own "),
        ({"rewards": returning(HUGE)}, "the sum of the reward terms of lab/Own is not finite, but inf"),
        ({"done": returning({"success": lambda place: False})}, "termination of lab/Own needs the signal 'place'"),
        ({"done": returning({"won": lambda pose: False})}, "an episode can't end as 'won', only as success"),
        (
            {"collision": property(returning(Threshold("wrench")))},
            "threshold of lab/Own takes one number as the signal 'wrench', which has 2",
        ),
        ({"duration": property(returning(0.0))}, "the duration of lab/Own must be positive, not 0.0 s"),
        (
            {"reset": lambda self, world, rng, given: world.set_pose(np.full(2, 100.0))},
            r"reset of lab/Own puts the robot at \[100\. 100\.\] m, and at most 10 m are allowed: give poses in meters",
        ),
    ],
)
def test_wrong_declaration_is_named_at_the_first_step(attributes, message):
    declare(**attributes)
    with pytest.raises(InputError, match=message) as error:
        first_step()
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("terms", "message"),
    [
        ((), "the observation of lab/Own is empty: let observe"),
        ((ObservationTerm("pose", entries=()),), "the observation of lab/Own is empty"),
        ((ObservationTerm("pose", scale=0.0),), "the observed signal 'pose' of lab/Own has a .* scale that is not 0"),
        ((ObservationTerm("phase"), ObservationTerm("pose", scale=[0.5, 0.0])), "'pose' .* scale that is not 0"),
        ((ObservationTerm("pose", scale=1e-320),), "the observed signal 'pose' of lab/Own has a center and a scale"),
        ((ObservationTerm("pose", scale=np.nan),), "are finite"),
        ((ObservationTerm("pose", center=np.inf),), "are finite"),
    ],
)
def test_invalid_observation_term_is_refused(terms, message):
    declare(observe=returning(terms))
    with pytest.raises(InputError, match=message):
        make_env("lab/Own", guidance="kmp")


@pytest.mark.parametrize(
    ("attributes", "message"),
    [
        (
            {"observe": returning((ObservationTerm("pose", center=[0.5] * 3),))},
            "'pose' of lab/Own has 2 entries: center",
        ),
        ({"observe": returning(["pose"])}, r"observe returns terms, such as ObservationTerm\('pose'\), not 'pose'"),
        ({"workcell": returning(3)}, "building lab/Own failed: .*AttributeError: 'int' object"),
        ({"station": None}, "station of lab/Own is a class that register_station registers, not None"),
        ({"reset": returning(np.zeros(2))}, r"reset of lab/Own returns a dict of values by name or None, not array"),
        (
            {"reset": lambda self, world, rng, given: 1 / 0},
            r"reset of lab/Own failed: test_own_task.py, line .*ZeroDiv",
        ),
    ],
)
def test_error_in_a_method_of_a_task_is_one_sentence(attributes, message):
    declare(**attributes)
    with pytest.raises(InputError, match=message):
        first_step()


@pytest.mark.parametrize(("name", "method"), [("reset", lambda self, world: None), ("done", lambda: {})])
def test_task_is_refused_when_a_method_lacks_parameters(name, method):
    with pytest.raises(InputError, match=rf"{name} of Declared must have the parameters \(self"):
        declare(**{name: method})


def test_observation_is_centered_and_scaled_by_entry():
    declare(observe=returning((ObservationTerm("pose", 0.5, [-1.0, 2.0], entries=(-1, 0)),)))
    env = make_env("lab/Own", guidance="kmp")
    observation, _ = env.reset(seed=0)
    x, y = env.diagram.diagram.GetOutputPort("pose").Eval(env.simulator.get_context())
    np.testing.assert_allclose(observation, [-(y - 0.5), (x - 0.5) / 2.0], rtol=1e-6)


@pytest.mark.parametrize("name", [*INFO_KEYS, *RECORDED_SIGNALS, "observation", "pose", "privileged", "rgb_image"])
def test_reward_term_with_a_reserved_name_is_refused(name):
    declare(rewards=returning({name: lambda pose: 0.0}))
    with pytest.raises(InputError, match=f"no reward term of lab/Own can be called {name!r}"):
        make_env("lab/Own", guidance="kmp")


@pytest.mark.parametrize("name", INFO_KEYS)
def test_reset_value_with_a_reserved_name_is_refused(name):
    declare(reset=returning({name: -9.0}))
    env = make_env("lab/Own", guidance="kmp")
    with pytest.raises(InputError, match=f"reset of lab/Own returns a value named {name!r}, which is reserved"):
        env.reset(seed=0)


def test_reward_term_may_have_the_name_of_a_guidance_port():
    declare(rewards=returning({"held_action": lambda pose: -float(pose[1])}))
    env = make_env("lab/Own", guidance="kmp")
    env.reset(seed=0)
    _, reward, *_, info = env.step(np.zeros(env.action_space.shape))
    assert info["held_action"] == reward != 0.0


@pytest.mark.parametrize("number", [np.nan, np.inf])
def test_observation_that_is_not_finite_is_refused(number):
    def signals(self, builder, station):
        broken = builder.AddNamedSystem("broken", affine(np.eye(2), [0.0, number]))
        builder.Connect(station.get_pose_output_port(), broken.get_input_port())
        return {"broken": broken.get_output_port()}

    declare(signals=signals, observe=returning((ObservationTerm("phase"), ObservationTerm("broken", entries=(1,)))))
    with pytest.raises(InputError, match=r"the observation of lab/Own is not finite, but"):
        first_step()


def test_scope_is_training_without_held_out_conditions():
    declare()
    assert "conditions as in training" in evaluation_scope("lab/Own", {}, resample_offsets=False)
    options = describe_task_options("lab/Own")
    assert options["reset: held_out"].startswith("no effect")
    assert options["reward"] == "the task has a single reward without a name"
    declare(has_held_out_distribution=True)
    assert evaluation_scope("lab/Own", {}, resample_offsets=False) == "held-out starts"
    assert describe_task_options("lab/Own")["reset: held_out"].startswith("sample held-out conditions")


def test_collisions_are_counted_only_if_declared():
    declare()
    assert not counts_collisions("lab/Own")
    declare(collision=property(returning(Threshold("contact_force"))))
    assert counts_collisions("lab/Own")
    assert all(map(counts_collisions, ("BncConnector", "GridClamp", "Pouring", "NarrowPassage")))


def test_training_reports_collisions_only_if_declared(tmp_path):
    for name, attributes, expected in (
        ("without", {}, None),
        ("with", {"collision": property(returning(Threshold("contact_force")))}, 0),
    ):
        declare(**attributes)
        run = train("lab/Own", out=tmp_path / name, episodes=1, algorithm="ppo", pictures=False)
        assert run.summary["collisions"] == expected


def test_own_task_is_fuzzed_with_every_guidance():
    declare()
    result = fuzz("lab/Own", episodes=3)
    assert result["failures"] == []
    guidance = {"base_policy", "kgrl", "kgrl_base_policy", "kmp", "residual", "residual_base_policy", "skgrl"}
    assert result["cases"].keys() <= guidance
    assert result["all"]["episodes"] == 3


def test_imported_file_finds_its_folder_and_names_errors(tmp_path):
    path = [*sys.path]
    (tmp_path / "lab_period.py").write_text("PERIOD = 3\n")
    good, wrong = tmp_path / "own_good.py", tmp_path / "own_wrong.py"
    good.write_text("from lab_period import PERIOD\n")
    wrong.write_text("PERIOD = 3\nimport nowhere_to_be_found\n")
    assert import_modules([str(good)]) == (str(good),)
    with pytest.raises(InputError, match=r"importing own_wrong\.py failed: own_wrong\.py, line 2: ModuleNotFoundError"):
        import_modules([str(wrong)])
    with pytest.raises(InputError, match="there is no module, file or task folder nowhere_to_be_found"):
        import_modules(["nowhere_to_be_found"])
    assert sys.path == path
    sys.modules.pop("lab_period")


def test_task_keeps_its_name_when_another_name_is_taken():
    task = TASKS.get("NarrowPassage")
    TASKS.get("GridClamp")  # imports the module that registers the task
    with pytest.raises(InputError, match="already"):
        register_task("GridClamp")(task)
    assert task.name == "NarrowPassage"
