import numpy as np
import pytest

from research.smoothness import log_dimensionless_jerk, spectral_arc_length


def minimum_jerk(duration=1.0, period=0.01, size=1.0):
    t = np.arange(0.0, duration + period / 2, period) / duration
    return size * np.column_stack([10 * t**3 - 15 * t**4 + 6 * t**5, 0 * t])


def test_of_a_minimum_jerk_motion_is_the_closed_form():
    """∫ jerk² dt = 720 D²/T⁵ and v = 1.875 D/T."""
    assert log_dimensionless_jerk(minimum_jerk(), 0.01) == pytest.approx(-np.log(720 / 1.875**2), abs=0.1)


def test_neither_tempo_nor_unit_decides():
    reference = log_dimensionless_jerk(minimum_jerk(), 0.01)
    assert log_dimensionless_jerk(minimum_jerk(size=1e-3), 0.01) == pytest.approx(reference, abs=1e-9)
    assert log_dimensionless_jerk(minimum_jerk(), 0.02) == pytest.approx(reference, abs=1e-9)
    assert spectral_arc_length(minimum_jerk(size=1e-3), 0.01) == pytest.approx(
        spectral_arc_length(minimum_jerk(), 0.01)
    )


def test_noise_makes_both_worse_and_more_of_it_worse_still():
    rng = np.random.default_rng(0)
    noise = np.column_stack([rng.normal(size=101), np.zeros(101)])
    jerks = [log_dimensionless_jerk(minimum_jerk() + scale * noise, 0.01) for scale in (0.0, 1e-3, 1e-2)]
    assert jerks[0] > jerks[1] > jerks[2]
    arcs = []
    for frequency in (0, 4, 8):
        tremor = 1e-2 * np.sin(2 * np.pi * frequency * 0.01 * np.arange(101))
        arcs.append(spectral_arc_length(minimum_jerk() + tremor[:, None] * [1.0, 0.0], 0.01))
    assert arcs[0] == pytest.approx(-1.41, abs=0.01)  # the value of the paper
    assert arcs[0] > arcs[1] > arcs[2]


def test_what_does_not_move():
    still = np.zeros((50, 3))
    assert log_dimensionless_jerk(still, 0.02) == -np.inf
    assert spectral_arc_length(still, 0.02) == 0.0
    assert log_dimensionless_jerk(np.zeros((3, 3)), 0.02) == -np.inf
