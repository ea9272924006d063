"""Smoothness benchmark and its measures."""

from dataclasses import replace

import numpy as np
import pytest

from guiderail.models.common.errors import InputError
from research.smoothness import (
    log_dimensionless_jerk,
    measure,
    methods,
    quiet_commands,
    smoothness,
    spectral_arc_length,
)


def minimum_jerk(duration=1.0, period=0.01, size=1.0):
    """Return a minimum-jerk motion along the first of two axes, (N, 2)."""
    t = np.arange(0.0, duration + period / 2, period) / duration
    return size * np.column_stack([10 * t**3 - 15 * t**4 + 6 * t**5, 0 * t])


def test_log_dimensionless_jerk_of_minimum_jerk_is_closed_form():
    """For distance D and duration T, ∫ jerk² dt = 720 D²/T⁵, and the peak velocity is 1.875 D/T."""
    assert log_dimensionless_jerk(minimum_jerk(), 0.01) == pytest.approx(-np.log(720 / 1.875**2), abs=0.1)


def test_measures_do_not_depend_on_duration_or_unit():
    reference = log_dimensionless_jerk(minimum_jerk(), 0.01)
    assert log_dimensionless_jerk(minimum_jerk(size=1e-3), 0.01) == pytest.approx(reference, abs=1e-9)
    assert log_dimensionless_jerk(minimum_jerk(), 0.02) == pytest.approx(reference, abs=1e-9)
    assert spectral_arc_length(minimum_jerk(size=1e-3), 0.01) == pytest.approx(
        spectral_arc_length(minimum_jerk(), 0.01)
    )


def test_measures_decrease_with_noise():
    rng = np.random.default_rng(0)
    noise = np.column_stack([rng.normal(size=101), np.zeros(101)])
    jerks = [log_dimensionless_jerk(minimum_jerk() + scale * noise, 0.01) for scale in (0.0, 1e-3, 1e-2)]
    assert jerks[0] > jerks[1] > jerks[2]
    arcs = []
    for frequency in (0, 4, 8):
        tremor = 1e-2 * np.sin(2 * np.pi * frequency * 0.01 * np.arange(101))
        arcs.append(spectral_arc_length(minimum_jerk() + tremor[:, None] * [1.0, 0.0], 0.01))
    assert arcs[0] == pytest.approx(-1.41, abs=0.01)  # value in the paper
    assert arcs[0] > arcs[1] > arcs[2]


def test_measures_have_fixed_values_without_motion():
    motionless = np.zeros((50, 3))
    assert log_dimensionless_jerk(motionless, 0.02) == -np.inf
    assert spectral_arc_length(motionless, 0.02) == 0.0
    assert log_dimensionless_jerk(np.zeros((3, 3)), 0.02) == -np.inf


@pytest.mark.parametrize("arguments", [{"episodes": 0}, {"action_scale": 0.0}, {"outputs": "some"}])
def test_smoothness_refuses_invalid_arguments(tmp_path, arguments):
    with pytest.raises(InputError):
        smoothness(tmp_path / "new", **arguments)
    assert not (tmp_path / "new").exists()


def test_methods_have_different_names():
    names = [method.name for method in methods()]
    assert len(set(names)) == len(names)
    for kind in ("KGRL", "adaptive", "white", "gSDE", "pink", "OU", "low-pass", "repeat"):
        assert any(kind in name for name in names), f"no method of kind {kind}"


@pytest.fixture(scope="module")
def quiet():
    return quiet_commands()


@pytest.mark.parametrize(("name", "places"), [("KGRL", ("free", "connector")), ("residual white", ("free",))])
def test_method_has_the_requested_rms(name, places, quiet, monkeypatch):
    monkeypatch.setattr("research.smoothness.PLACES", places)
    (method,) = [method for method in methods() if method.name == name]
    # Only commands are measured, and an episode at the connector ends at the first contact.
    short = {"time_step": 0.01, "bounded_force": False, "force_limit": 5.0}
    method = replace(method, environment={**method.environment, **short})
    free, *others = measure(method, (0, 1, 2, 3, 4, 5), quiet, episodes=1, action_scale=0.5, seed=0)
    assert (free["place"], *(row["place"] for row in others)) == places
    assert free["rms_in_deviations"] == pytest.approx(0.5, rel=0.05)
