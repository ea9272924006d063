import numpy as np
import pytest

from guiderail.models.common.errors import InputError
from guiderail.models.primitives import Demonstrations
from guiderail.models.primitives.demonstrations import compute_bounds, phases_of_steps
from guiderail_data.alignment import align_demonstrations


def wavy(lengths=(50, 80), outputs=2):
    """Return demonstrations with different clocks and numbers of samples."""
    times = [np.linspace(0.1 * m, 2 + m, n) for m, n in enumerate(lengths)]
    return Demonstrations(times, [np.column_stack([np.sin(t + o) for o in range(outputs)]) for t in times])


@pytest.mark.parametrize("ending", ["npz", "csv"])
def test_load_returns_the_saved_demonstrations(tmp_path, ending):
    demonstrations = wavy()
    demonstrations.save(tmp_path / f"d.{ending}")
    loaded = Demonstrations.load(tmp_path / f"d.{ending}")
    assert loaded.names == demonstrations.names
    for a, b in zip(loaded.times + loaded.outputs, demonstrations.times + demonstrations.outputs, strict=True):
        np.testing.assert_array_equal(a, b)


def test_load_reads_arrays_saved_by_numpy(tmp_path):
    t = np.linspace(0, 1, 10)
    np.savez(tmp_path / "d.npz", times=np.tile(t, (3, 1)), outputs=np.ones((3, 10, 2)))
    loaded = Demonstrations.load(tmp_path / "d.npz")
    assert loaded.num_demonstrations == 3
    assert loaded.num_outputs == 2


def test_resampled_demonstrations_share_a_clock_and_end_points():
    resampled = wavy((50, 200)).resampled(100)
    np.testing.assert_array_equal(resampled.times[0], resampled.times[1])
    assert np.ptp(np.diff(resampled.times[0])) < 1e-12
    assert resampled.times[0][-1] - resampled.times[0][0] == pytest.approx((2 + 2.9) / 2)
    for before, after in zip(wavy((50, 200)).outputs, resampled.outputs, strict=True):
        np.testing.assert_array_equal(after[[0, -1]], before[[0, -1]])
        assert after.shape == (100, 2)


def test_resampled_returns_self_when_the_clock_is_uniform():
    t = np.linspace(0, 1, 20)
    d = Demonstrations(t, np.random.default_rng(0).standard_normal((3, 20, 1)))
    assert d.resampled() is d


def test_constructor_drops_repeated_samples():
    d = Demonstrations([[0.0, 0.1, 0.1, 0.2]], [[[1.0], [2.0], [2.0], [3.0]]])
    np.testing.assert_array_equal(d.times[0], [0, 0.1, 0.2])


@pytest.mark.parametrize(
    ("times", "outputs", "message"),
    [
        ([], [], "at least one"),
        ([[0.0]], [[[1.0]]], "1 point"),
        ([[0.0, 1.0]], [[[1.0], [np.nan]]], "NaN"),
        ([[0.0, np.inf]], [[[1.0], [2.0]]], "infinity"),
        ([[0.0, 1.0]], [[[1.0], [-1e101]]], "1e.101, which is too large"),
        ([[0.0, 1e101]], [[[1.0], [2.0]]], "1e.101, which is too large"),
        ([[0.0, 0.0]], [[[1.0], [2.0]]], "does not increase at sample 1"),
        ([[0.0, 2.0, 1.0]], [[[1.0], [2.0], [3.0]]], "does not increase at sample 2"),
        ([[0.0, 1.0], [0.0, 1.0]], [[[1.0], [2.0]], [[1.0, 1.0], [2.0, 2.0]]], "2 outputs, the first has 1"),
        ([[0.0, 1.0]], np.zeros((1, 2, 0)), "demonstration 0 has no output: record at least one"),
        ([[0.0, 1.0]], [[1.0, 2.0]], "shapes"),
        ([[0.0, 1.0, 2.0]], [[[1.0], [2.0]]], "shapes"),
        ([[0.0, 1.0]], [[["a"], ["b"]]], "not an array of numbers"),
        ([[0.0, 1.0]], [[["1"], ["2"]]], "not an array of numbers"),
        ([[0.0, 1.0]], [np.array([[1j], [2]])], "not an array of numbers"),
        ([[0.0, 1.0]], [[[1.0], [2.0, 3.0]]], "not an array of numbers"),
        ([[0.0, 1.0]], [[[10**400], [2.0]]], "not an array of numbers"),
        ([np.array([0, 1], dtype="M8[s]")], [[[1.0], [2.0]]], "not an array of numbers"),
        ([[0, 2**60]], [[[1.0], [2.0]]], "beyond|and more"),
        (0.0, [[[1.0], [2.0]]], "times must be a list"),
        ([[0.0, 1.0]], 1.0, "outputs must be a list"),
        ([[0.0, 1.0]] * 2, [[[1.0], [2.0]]], "2 time vectors"),
    ],
)
def test_constructor_refuses_invalid_demonstrations(times, outputs, message):
    with pytest.raises(InputError, match=message):
        Demonstrations(times, outputs)


@pytest.mark.parametrize("names", [["a", "b"], ["a\n"], [" x"], [1], ["x" * 201], ["\ud800"]])
def test_constructor_refuses_invalid_names(names):
    with pytest.raises(InputError, match="name"):
        Demonstrations([[0.0, 1.0]], [[[1.0], [2.0]]], names)


def make_demonstrations():
    t = np.linspace(0.0, 2.0, 101)
    return Demonstrations(t, [np.column_stack([a * t, np.sin(3 * t) + a]) for a in (0.9, 1.0, 1.1)])


@pytest.mark.parametrize("phases", [1, 3, 7])
def test_bounds_contain_every_demonstration(phases):
    bounds = compute_bounds(make_demonstrations(), phases, margin=0.0)
    for outputs in make_demonstrations().outputs:
        phase = phases_of_steps(bounds.phases, len(outputs))
        assert ((outputs >= bounds.lower[phase]) & (outputs <= bounds.upper[phase])).all()


def test_bounds_contain_demonstrations_with_uneven_samples():
    t = np.array([0.0, 0.1, 0.13, 0.16, 1.0, 1.2, 1.7, 2.0])
    peak = np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0, -2.0, 0.0])
    bounds = compute_bounds(Demonstrations(t, [peak[:, None], np.zeros((8, 1))]), 2, margin=0.0)
    np.testing.assert_array_equal(bounds.upper[:, 0], [1.0, 0.0])
    assert bounds.lower[1, 0] == -2.0


def test_bounds_are_tighter_with_more_phases():
    widths = [np.mean(b.upper - b.lower) for b in (compute_bounds(make_demonstrations(), k) for k in (1, 2, 4, 8))]
    assert sorted(widths, reverse=True) == widths
    assert widths[-1] < 0.4 * widths[0]


def test_margin_is_relative_to_the_range_with_a_minimum():
    tight = compute_bounds(make_demonstrations(), margin=0.0)
    wide = compute_bounds(make_demonstrations(), margin=0.25)
    size = tight.upper - tight.lower
    np.testing.assert_allclose(wide.upper - tight.upper, 0.25 * size)
    np.testing.assert_allclose(tight.lower - wide.lower, 0.25 * size)
    np.testing.assert_allclose(
        compute_bounds(make_demonstrations(), margin=0.0, min_margin=5.0).upper - tight.upper, 5.0
    )


def test_unbounded_output_has_infinite_bounds():
    bounds = compute_bounds(make_demonstrations(), 2, bounded=[1])
    assert np.isinf(bounds.lower[:, 0]).all()
    assert np.isfinite(bounds.upper[:, 1]).all()


def test_max_rates_use_the_clock_of_each_demonstration():
    np.testing.assert_allclose(compute_bounds(make_demonstrations()).max_rates[0], 1.1, rtol=1e-9)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"phases": 0}, "phases"),
        ({"phases": 99}, "phases"),
        ({"margin": -1.0}, "margin"),
        ({"margin": "a"}, "must be a number, not"),
        ({"margin": None}, "must be a number, not"),
        ({"min_margin": [0.1]}, "must be a number, not"),
        ({"bounded": [2]}, "an index of an output must be a whole number from 0 to 1, not 2"),
        ({"bounded": 0}, "bounded must be a list, not 0"),
    ],
)
def test_compute_bounds_refuses_invalid_arguments(arguments, message):
    with pytest.raises(InputError, match=message):
        compute_bounds(make_demonstrations(), **arguments)


@pytest.mark.parametrize(
    ("band", "message"),
    [
        *((value, "band must be a number, not") for value in (None, "a", [0.2])),
        *((value, "band of an alignment is a share") for value in (0.0, 1.1)),
    ],
)
def test_alignment_refuses_an_invalid_band(band, message):
    with pytest.raises(InputError, match=message):
        align_demonstrations(make_demonstrations(), band)


@pytest.mark.parametrize("value", [2.5, "3", True])
def test_numbers_of_steps_and_phases_are_whole(value):
    demonstrations = Demonstrations([np.arange(10.0)], [np.zeros((10, 2))])
    for call in (
        lambda: demonstrations.first(value),
        lambda: demonstrations.resampled(value),
        lambda: compute_bounds(demonstrations, value),
        lambda: compute_bounds(demonstrations, bounded=[value]),
    ):
        with pytest.raises(InputError, match="must be a whole number"):
            call()
    assert len(demonstrations.resampled(np.int64(4)).times[0]) == 4
    assert demonstrations.first(1.0).num_demonstrations == 1


VECTOR, EULER = ("r_x", "r_y", "r_z"), ("Rz [rad]", "Ry [rad]", "Rx [rad]")


@pytest.mark.parametrize("names", [VECTOR, ("rx [rad]", "ry [rad]", "rz [rad]"), EULER, ("a", "theta [rad]")])
@pytest.mark.parametrize("half_turn", [np.pi, -np.pi])
def test_angles_are_unwrapped_at_half_turns(names, half_turn):
    """The demonstrations begin before or after the half turn; the first demonstration determines the branch."""
    is_pose, column = len(names) == 3, 0 if names == EULER else 1
    axis = np.eye(len(names))[column]
    paths = [np.outer(half_turn + np.linspace(start, start + 0.6, 40), axis) for start in (-0.3, 0.1, -0.1)]
    wrapped = [(path + np.pi) % (2 * np.pi) - np.pi for path in paths]
    outputs, unwrapped = ([np.hstack([np.zeros((40, 3)), y]) if is_pose else y for y in ys] for ys in (wrapped, paths))
    result = Demonstrations(np.arange(40), outputs, (*"xyz", *names) if is_pose else names).outputs
    offset = unwrapped[0][0] - result[0][0]
    np.testing.assert_allclose(np.array(result) + offset, unwrapped, atol=1e-12)
    # Default names declare no angles.
    np.testing.assert_array_equal(Demonstrations(np.arange(40), outputs).outputs, outputs)


@pytest.mark.parametrize("names", [VECTOR, EULER])
def test_outputs_without_a_jump_of_a_full_turn_are_unchanged(names):
    turning = np.zeros((3, 40, 6))
    turning[..., 3] = np.linspace(-5.0, 9.0, 40) + np.array([[0.0], [3.0], [13.0]])
    turning[2, ::2, 4] = 5.0  # neither a full turn nor a small change
    result = Demonstrations(np.arange(40), turning, (*"xyz", *names)).outputs
    np.testing.assert_array_equal(result, turning)


ORIENTATIONS = [("Rz", "Ry", "Rx"), ("psi_z", "psi_y", "psi_x"), ("r_x", "r_y", "r_z"), ("rx", "ry", "rz")]


@pytest.mark.parametrize("orientation", ORIENTATIONS)
@pytest.mark.parametrize("unit", [" [deg]", " [degrees]", " (deg)", "_deg", " [\u00b0]"])
def test_orientation_in_degrees_is_refused(orientation, unit):
    names = ["x [m]", "y [m]", "z [m]", *(name + unit for name in orientation)]
    with pytest.raises(InputError, match=r"is in degrees: convert it to radians, and name it with \[rad\]"):
        Demonstrations(np.arange(3.0), [np.zeros((3, 6))] * 2, names)


@pytest.mark.parametrize("orientation", ORIENTATIONS)
@pytest.mark.parametrize("steps", [16, 18, 60])
def test_orientation_that_may_be_in_degrees_is_unchanged(orientation, steps):
    t = np.linspace(0, 1, steps)
    y = np.column_stack([t, t, t, 90 * t, 0 * t, 0 * t])
    result = Demonstrations(t, [y] * 3, ["x", "y", "z", *orientation])
    np.testing.assert_array_equal(result.outputs, [y] * 3)


@pytest.mark.parametrize("unit", ["", " [rad]"])
def test_full_turn_of_an_angle_in_radians_is_removed(unit):
    angle = np.linspace(2.5, 3.8, 20)
    wrapped = np.angle(np.exp(1j * angle))
    y = np.column_stack([np.zeros((20, 3)), wrapped, np.zeros((20, 2))])
    names = ["x", "y", "z", *(name + unit for name in ("Rz", "Ry", "Rx"))]
    np.testing.assert_allclose(Demonstrations(np.arange(20.0), [y], names).outputs[0][:, 3], angle)
