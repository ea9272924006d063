import numpy as np
import pytest
from pydrake.systems.analysis import Simulator

from guiderail.models.common.errors import InputError
from guiderail.models.common.termination import Termination
from guiderail.systems.episode_terms import EpisodeMonitor, TerminationTerm

PERIOD = 0.1
SUCCESS, BLOCKED = Termination.SUCCESS.index, Termination.BLOCKED.index


class Episode:
    """Monitor with one value of the signal per control step, whose output is read as in an environment."""

    def __init__(self, *conditions, size=1):
        self.system = EpisodeMonitor(conditions, PERIOD)
        self.simulator = Simulator(self.system)
        self.context = self.simulator.get_mutable_context()
        self.pristine = self.system.CreateDefaultContext()
        self.signal = self.system.get_signal_input_port("u").FixValue(self.context, [0.0] * size)
        self.reset()

    def reset(self):
        self.context.SetTimeStateAndParametersFrom(self.pristine)
        self.steps = 0
        self.simulator.Initialize()

    def step(self, *values):
        """Run one control step with these values of the signal at its end; return the termination code."""
        self.simulator.AdvanceTo((self.steps + 0.5) * PERIOD)
        self.signal.GetMutableData().set_value(values)
        self.steps += 1
        self.simulator.AdvanceTo(self.steps * PERIOD)
        # An environment may evaluate the output several times.
        self.system.get_termination_output_port().Eval(self.context)
        return int(self.system.get_termination_output_port().Eval(self.context)[0])


def above(limit, **parameters):
    """Return the term that ends an episode as "blocked" when u exceeds `limit`."""
    return TerminationTerm("blocked", {"u": 1}, lambda u: u[0] > limit, **parameters)


def test_termination_includes_the_step_that_has_just_ended():
    episode = Episode(above(1))
    assert [episode.step(0), episode.step(2)] == [0, BLOCKED]


def test_termination_is_constant_until_a_reset():
    episode = Episode(above(1))
    assert [episode.step(2), episode.step(0), episode.step(0)] == [BLOCKED] * 3
    episode.reset()
    assert episode.step(0) == 0


def test_consecutive_steps_are_counted_once_each():
    episode = Episode(above(1, steps=3))
    assert [episode.step(u) for u in (2, 2, 0, 2, 2, 2)] == [0, 0, 0, 0, 0, BLOCKED]


def test_steps_are_counted_since_the_last_progress():
    # The first number of u is the progress, and the condition is that the second number is positive.
    stuck = TerminationTerm("blocked", {"u": 2}, lambda u: u[1] > 0, steps=3, progress=lambda u: u[0], min_progress=0.1)
    episode = Episode(stuck, size=2)
    # The count continues after a step without the condition and after progress below 0.1. Larger progress resets it.
    values = [(0, 1), (0, 1), (0.05, 0), (0.5, 1), (0.5, 1), (0.4, 0), (0.55, 1), (0.5, 1)]
    assert [episode.step(*u) for u in values] == [0] * 7 + [BLOCKED]


@pytest.mark.parametrize("index", range(3))
def test_progress_is_recorded_for_each_term(index):
    stuck = TerminationTerm("blocked", {"u": 2}, lambda u: u[1] > 0, steps=2, progress=lambda u: u[0], min_progress=0.5)
    other = TerminationTerm("spill", {"u": 2}, lambda u: u[1] > 0, steps=99, progress=lambda u: 0.0)
    terms = [other] * index + [stuck] + [other] * (2 - index)
    # Progress by exactly 0.5 does not reset the count, and progress by 0.5004 does.
    for values, termination in (([(0, 1), (0.5, 1), (0.5, 1)], BLOCKED), ([(0, 1), (0.5004, 1), (0.5004, 1)], 0)):
        episode = Episode(*terms, size=2)
        assert [episode.step(*u) for u in values] == [0, 0, termination]


def test_any_progress_resets_the_count_by_default():
    stuck = TerminationTerm("blocked", {"u": 1}, lambda u: True, steps=1, progress=lambda u: u[0])
    episode = Episode(stuck)
    assert [episode.step(u) for u in (0.0, 1e-6, 2e-6, 2e-6)] == [0, 0, 0, BLOCKED]


def test_first_term_takes_precedence():
    success = TerminationTerm("success", {"u": 1}, lambda u: u[0] > 1)
    assert Episode(success, above(1)).step(2) == SUCCESS
    assert Episode(above(1), success).step(2) == BLOCKED


@pytest.mark.parametrize(
    "make",
    [
        lambda: EpisodeMonitor([above(1)], 0.0),
        lambda: EpisodeMonitor([above(1), TerminationTerm("success", {"u": 2}, lambda u: True)], PERIOD),
        lambda: TerminationTerm("lost", {"u": 1}, lambda u: True),
        lambda: TerminationTerm("", {"u": 1}, lambda u: True),
        lambda: above(1, steps=0),
        lambda: above(1, steps=float("nan")),
        lambda: above(1, steps=float("inf")),
        lambda: above(1, steps=0.9995),
        lambda: above(1, steps=1.5),
    ],
)
def test_constructor_refuses_invalid_arguments(make):
    with pytest.raises(InputError):
        make()


@pytest.mark.parametrize(
    ("name", "words"), [("", "'blocked' is called"), ("Pouring", "'blocked' of Pouring is called")]
)
@pytest.mark.parametrize("functions", [{"condition": lambda v: True}, {"progress": lambda v: 0.0}])
def test_function_is_refused_when_parameters_are_not_signals(functions, name, words):
    term = TerminationTerm(**{"termination": "blocked", "inputs": {"u": 1}, "condition": lambda u: True} | functions)
    with pytest.raises(InputError, match=f"condition {words}"):
        EpisodeMonitor([term], PERIOD, name)


@pytest.mark.parametrize("value", [np.nan, np.inf, np.array([True, True]), np.array([]), None, "yes"])
@pytest.mark.parametrize("parameters", [{}, {"progress": lambda u: -np.inf}])
def test_condition_is_refused_when_it_returns_no_truth_value(value, parameters):
    episode = Episode(TerminationTerm("success", {"u": 1}, lambda u: value, **parameters))
    with pytest.raises(InputError, match="the condition 'success' must be true or false"):
        episode.step(0.0)


@pytest.mark.parametrize("value", [True, np.True_, 1, 0.5, np.array([True])])
def test_condition_may_return_a_single_number(value):
    assert Episode(TerminationTerm("blocked", {"u": 1}, lambda u: value)).step(0.0) == BLOCKED


def test_each_term_has_its_own_count():
    episode = Episode(above(5, steps=2), TerminationTerm("success", {"u": 1}, lambda u: u[0] > 1, steps=3))
    assert [episode.step(u) for u in (6, 2, 6, 0)] == [0, 0, SUCCESS, SUCCESS]


def test_initialization_resets_the_counts():
    episode = Episode(above(1))
    assert [episode.step(2), episode.step(0)] == [BLOCKED, BLOCKED]
    episode.signal.GetMutableData().set_value([0.0])
    episode.context.SetTime(0.0)
    episode.simulator.Initialize()
    assert episode.system.get_termination_output_port().Eval(episode.context)[0] == 0.0
