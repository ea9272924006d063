"""Contact map: its file, its likelihood, and the socket's position that the histogram filter finds with it."""

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource

from guiderail.diagrams.wiring import add_system
from guiderail.models.common.errors import InputError
from guiderail.models.common.transforms import MM
from guiderail_parts.contact_map import ContactMap
from guiderail_parts.socket_estimator import POSITIONS, RADIUS, SocketEstimator

PERIOD = 0.02
SOCKET = np.array([2.0, -1.5]) * MM
HEIGHT = 10.0 * MM  # of the rim

TILT = np.array([0.005, -0.002])


def center_at(relative, tilt=TILT):
    """Return the center of pressure of a tilted plug at a position relative to the socket, beside its axis."""
    return np.array([3.0 * MM, 0.0]) + relative @ np.array([[0.8, 0.3], [-0.2, 0.5]]) + 0.2 * tilt


def linear_map(height=HEIGHT):
    rng = np.random.default_rng(0)
    positions, tilts = rng.uniform(-6.0 * MM, 6.0 * MM, (600, 2)), rng.uniform(-0.015, 0.015, (600, 2))
    centers = np.array([center_at(*sample) for sample in zip(positions, tilts, strict=True)])
    return ContactMap(np.column_stack([positions, np.full(600, height)]), tilts, centers)


def estimate(contact_map, *, plugs, force=8.0, height=HEIGHT, center=None, changes=None):
    """Return the output (5,) after the plug was pressed on the rim at each position, ten samples each."""
    builder = DiagramBuilder()
    pose = add_system(builder, "pose", ConstantVectorSource(np.zeros(6)))
    wrench = add_system(builder, "wrench", ConstantVectorSource(np.zeros(6)))
    system = SocketEstimator(contact_map, min_force=2.0, period=PERIOD)
    add_system(builder, "estimator", system, pose.get_output_port(), wrench.get_output_port())
    simulator = Simulator(builder.Build())
    context = simulator.get_mutable_context()
    simulator.Initialize()
    number, wrong = changes or (0, None)
    for index, plug in enumerate(plugs):
        x, y = wrong if index < number else center_at(plug - SOCKET) if center is None else center
        values = {pose: [*plug, height, 0, *TILT], wrench: [0, 0, force, y * force, -x * force, 0]}
        for source, value in values.items():
            source.get_mutable_source_value(source.GetMyMutableContextFromRoot(context)).set_value(value)
        simulator.AdvanceTo(context.get_time() + 10 * PERIOD)
    port = system.get_socket_offset_output_port()
    return port.Eval(system.GetMyContextFromRoot(context))


PLUGS = np.array([[0.0, 0.0], [1.0, 1.0], [-1.0, 0.5]]) * MM


def test_estimate_is_the_socket_relative_to_the_plug():
    *offset, xx, _, yy = estimate(linear_map(), plugs=PLUGS)
    np.testing.assert_allclose(offset, SOCKET - PLUGS[-1], atol=0.25 * MM)
    assert max(xx, yy) < (0.3 * MM) ** 2


@pytest.mark.parametrize(
    "changes",
    [{"contact_map": None}, {"force": 1.9}, {"height": 0.0}, {"force": np.nan}],
    ids=["no map", "no contact", "far below the samples", "not finite"],
)
def test_without_usable_samples_every_position_stays_equally_likely(changes):
    *offset, xx, _, yy = estimate(changes.pop("contact_map", linear_map()) if changes else None, plugs=PLUGS, **changes)
    np.testing.assert_allclose(offset, -PLUGS[-1], atol=1e-9)
    assert xx == pytest.approx(yy)
    assert xx + yy == pytest.approx((POSITIONS**2).sum(axis=1).mean())


def test_centers_that_contradict_the_map_leave_the_estimate_uncertain():
    *_, xx, _, yy = estimate(linear_map(), plugs=PLUGS, center=(0.3, 0.3))
    assert min(xx, yy) > (0.3 * RADIUS) ** 2


def test_tilt_of_the_plug_does_not_move_the_estimate():
    ignored = ContactMap(linear_map().positions, np.zeros((600, 2)), linear_map().centers)
    errors = [np.linalg.norm(estimate(each, plugs=PLUGS)[:2] + PLUGS[-1] - SOCKET) for each in (linear_map(), ignored)]
    assert errors[0] < 0.25 * MM < errors[1]


def test_samples_of_another_rim_do_not_mislead():
    upper, lower = linear_map(HEIGHT + 5.0 * MM), linear_map()
    both = ContactMap(
        *(
            np.concatenate(pair)
            for pair in zip(
                (upper.positions, upper.tilts, -upper.centers),
                (lower.positions, lower.tilts, lower.centers),
                strict=True,
            )
        )
    )
    offset = estimate(both, plugs=PLUGS)[:2]
    np.testing.assert_allclose(offset, SOCKET - PLUGS[-1], atol=0.3 * MM)


def test_wrong_early_samples_are_forgotten():
    wrong = estimate(linear_map(), plugs=[PLUGS[0]] * 3, center=center_at(PLUGS[0] + SOCKET))
    assert np.linalg.norm(wrong[:2] - SOCKET) > 2.0 * MM
    mended = estimate(linear_map(), plugs=[PLUGS[0]] * 3 + [*PLUGS] * 10, changes=(3, center_at(PLUGS[0] + SOCKET)))
    np.testing.assert_allclose(mended[:2], SOCKET - PLUGS[-1], atol=0.3 * MM)


def test_map_is_read_as_written(tmp_path):
    written = linear_map()
    written.save(tmp_path / "contact_map.csv")
    read = ContactMap.load(tmp_path / "contact_map.csv")
    np.testing.assert_allclose(read.positions, written.positions, atol=1e-7)
    np.testing.assert_allclose(read.tilts, written.tilts, atol=1e-6)
    np.testing.assert_allclose(read.centers, written.centers, atol=1e-7)


HEADER = "x,y,z,tilt_y,tilt_x,center_x,center_y\n"


@pytest.mark.parametrize(
    "text", ["", "x,y\n1,2\n", *(HEADER + row for row in ("", "1,2,0,0,0,3,word", "1,2,0,0,0,3,nan", "1,2,3"))]
)
def test_damaged_file_is_refused(tmp_path, text):
    path = tmp_path / "contact_map.csv"
    path.write_text(text)
    with pytest.raises(InputError, match=r"contact map"):
        ContactMap.load(path)
