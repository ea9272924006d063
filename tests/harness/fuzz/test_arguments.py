"""Random values of `--set`, `--env` and reset options: each is accepted, or refused with one sentence."""

import numpy as np
import pytest
import yaml
from hypothesis import example, given
from hypothesis import strategies as st

from fuzz.tally import attempt, few_inputs
from guiderail.diagrams.envs.config import EnvConfig, option_models
from guiderail.diagrams.envs.make import make_env
from guiderail.diagrams.envs.options import option_fields
from guiderail.diagrams.tasks.registry import TASKS
from guiderail.models.common.errors import InputError
from guiderail.tools.environments import as_value, check_environment
from guiderail.tools.learning.learner_config import PRESETS, OffPolicyConfig
from guiderail.tools.learning.run_folder import configure

TASK_NAMES = ["BncConnector", "GridClamp", "NarrowPassage", "Pouring"]
NUMBERS = st.integers(-3, 300).map(str) | st.floats().map(repr) | st.integers().map(str)
WORDS = st.sampled_from(
    ["", " ", "inf", "-inf", "nan", "1e20", "1e-20", "1e400", "-0", "0x10", "1_0", "010", "1,000", "1000000,1000000"]
    + ["true", "True", "yes", "null", "None", "~", "auto", "auto_", "auto_inf", "auto_0", "auto_1e-3", "auto_nan"]
    + ["[1, 2]", "[0.1]", "[]", "{}", "{a: 1}", "[[0, 1]]", "2001-99-99", "2001-01-01", "1:30", "!!int 3", "&a [*a]"]
    + [
        "[" * 200,
        "9" * 5000,
        "*",
        "&a",
        "'",
        '"',
        "%s",
        "$x$",
        "\n",
        "\x00",
        "١",
        "é",
        "a: b: c",
        "x" * 400,
        "7",
        "0.5",
    ]
    + ["sparse", "shaped", "skgrl", "kgrl", "kmp", "sct", "none", "gantry", "arm", "image", "hard", "per_episode"]
    + ["tqc", "sac"]
)
TEXTS = NUMBERS | WORDS | st.lists(NUMBERS, min_size=1, max_size=3).map(",".join) | st.text(max_size=8)
BOMB = (
    "{a: &a [1,1,1,1,1,1,1,1,1], b: &b [*a,*a,*a,*a,*a,*a,*a,*a,*a], c: &c [*b,*b,*b,*b,*b,*b,*b,*b,*b], d: [*c,*c,*c]}"
)
SETTINGS = [name for name in OffPolicyConfig.__dataclass_fields__ if name != "algorithm"]


@few_inputs
@given(
    st.sampled_from(sorted(PRESETS)),
    st.lists(st.tuples(st.sampled_from(SETTINGS) | st.text(max_size=5), TEXTS), min_size=1, max_size=2),
)
@example("tqc_contact", [("ent_coef", "inf")])
@example("tqc_contact", [("net_arch", "1000000,1000000")])
@example("tqc_contact", [("batch_size", "1e20")])
@example("tqc_contact", [("net_arch.layer_norm", "7")])
def test_configure_accepts_or_refuses_any_learner_setting(preset, pairs):
    arguments = dict(pairs)
    config = attempt("--set", InputError, lambda: configure("NarrowPassage", {}, preset=preset, settings=arguments))
    if config is None:
        return
    for name, text in arguments.items():
        result = getattr(config.learner, name)
        if isinstance(result, bool):
            assert str(text).lower() in (
                ("1", "true", "yes", "on", "t", "y") if result else ("0", "false", "no", "off", "f", "n")
            )
        elif isinstance(result, str):
            assert result == text
        elif isinstance(result, tuple):
            assert result == tuple(int(float(number)) for number in text.split(","))
        else:
            assert result == float(text)
    for name, value in PRESETS[preset].__dict__.items():
        assert name in arguments or name == "algorithm" or getattr(config.learner, name) == value


def options_of(task):
    """Return all options of a task's environments with their defaults as text."""
    config = EnvConfig.resolve(task, {})
    models = option_models(TASKS.get(task), config.guidance, config.station).values()
    return {
        name: str(model.model_fields[field].default) for model in models for name, field in option_fields(model).items()
    }


OPTIONS = {task: options_of(task) for task in TASK_NAMES}


@st.composite
def environments(draw):
    """Draw a task and the texts of some options."""
    task, texts = draw(st.sampled_from(TASK_NAMES)), {}
    for _ in range(draw(st.integers(1, 3))):
        name = draw(st.sampled_from([*OPTIONS[task]] * 3 + ["guidance", "fixture_offset", "x", "", "render_mode"]))
        valid = st.just(OPTIONS[task].get(name) or "kmp") | st.floats(0, 1).map(repr) | st.integers(1, 50).map(str)
        texts[name] = draw(valid | valid | TEXTS)
    return task, texts


@few_inputs
@given(environments())
@example(("NarrowPassage", {"action_repeat": BOMB}))
@example(("NarrowPassage", {"action_repeat": "2001-99-99"}))
def test_check_environment_accepts_or_refuses_any_option(environment):
    task, texts = environment
    result = attempt("--env", InputError, lambda: check_environment(task, {k: as_value(v) for k, v in texts.items()}))
    if result is None:
        return
    for name, text in texts.items():
        value, parsed = result[name], yaml.safe_load(text) if text.strip() else None
        if isinstance(value, bool):
            assert text.strip().lower() in (
                ("1", "true", "yes", "on", "1.0") if value else ("0", "false", "no", "off", "0.0", "-0")
            )
        elif isinstance(value, tuple):
            words = parsed if isinstance(parsed, list) else [word for word in str(text).split(",") if word.strip()]
            assert list(value) == [float(word) for word in words]
        elif isinstance(value, int | float):
            assert value == float(text)
        else:
            assert value == parsed or (value is None and parsed is None) or str(value) == text.strip()


SCALARS = st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=3)
VALUES = SCALARS | st.lists(SCALARS, max_size=3) | st.lists(st.floats(-0.3, 0.3), min_size=2, max_size=3)
RESETS = {task: sorted(TASKS.get(task).Reset.model_fields) for task in TASK_NAMES}
GUIDANCE = {"NarrowPassage": {"guidance": "kmp"}, "BncConnector": {"guidance": "kmp"}}


@pytest.fixture(scope="module", params=TASK_NAMES)
def env(request):
    env = make_env(request.param, **GUIDANCE.get(request.param, {}))
    yield env
    env.close()


@few_inputs
@given(st.data())
def test_reset_accepts_or_refuses_any_option(env, data):
    task = env.diagram.task.name
    names = st.sampled_from(RESETS[task]) | st.sampled_from(RESETS[task]) | st.text(max_size=3)
    options = data.draw(st.dictionaries(names, VALUES | st.floats(-0.1, 0.1).map(lambda x: [x, -x]), max_size=2))
    seed = data.draw(st.integers(0, 99))
    result = attempt(f"reset, {task}", InputError, lambda: env.reset(seed=seed, options=options))
    if result is None:
        return
    observation, info = result
    assert np.isfinite(observation).all()
    assert info["fallback"] in (False, 0, None) if "fallback" in info else True
    for name, values in options.items():
        if name in info and values is not None:
            # The option is the estimated position of the mug, the info has the true position.
            estimate = np.asarray(info[name], float) + (info.get("mug_error", 0.0) if name == "mug_position" else 0.0)
            np.testing.assert_allclose(estimate, [float(value) for value in values], rtol=0, atol=1e-15)
