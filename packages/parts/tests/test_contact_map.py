"""Contact map: its file, its likelihood, and the socket's position that the histogram filter finds with it."""

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource

from guiderail.diagrams.wiring import add_system
from guiderail.models.common.errors import InputError
from guiderail.models.common.transforms import MM
from guiderail_parts.contact_map import RADIUS, ContactMap
from guiderail_parts.socket_estimator import SocketEstimator, histogram_positions

PERIOD = 0.02
SOCKET = np.array([2.0, -1.5]) * MM


def center_at(relative):
    """Return the center of pressure of a plug at a position relative to the socket, which points beside its axis."""
    return np.array([3.0 * MM, 0.0]) + relative @ np.array([[0.8, 0.3], [-0.2, 0.5]])


def linear_map():
    positions = np.random.default_rng(0).uniform(-6.0 * MM, 6.0 * MM, (600, 2))
    return ContactMap(positions, np.array([center_at(position) for position in positions]), np.ones(600, bool))


def estimate(contact_map, *, plugs, force=8.0, height=0.01, center=None):
    """Return the output (3,) after the plug was pressed on the rim at each position, ten samples each."""
    builder = DiagramBuilder()
    pose = add_system(builder, "pose", ConstantVectorSource(np.zeros(6)))
    wrench = add_system(builder, "wrench", ConstantVectorSource(np.zeros(6)))
    system = SocketEstimator(contact_map, min_force=2.0, lowest=0.009, period=PERIOD)
    add_system(builder, "estimator", system, pose.get_output_port(), wrench.get_output_port())
    simulator = Simulator(builder.Build())
    context = simulator.get_mutable_context()
    simulator.Initialize()
    for plug in plugs:
        x, y = center_at(plug - SOCKET) if center is None else center
        values = {pose: [*plug, height, 0, 0, 0], wrench: [0, 0, force, y * force, -x * force, 0]}
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
    [{"contact_map": None}, {"force": 1.9}, {"height": 0.0089}, {"force": np.nan}],
    ids=["no map", "no contact", "in the socket", "not finite"],
)
def test_without_usable_samples_every_position_stays_equally_likely(changes):
    *offset, xx, _, yy = estimate(changes.pop("contact_map", linear_map()) if changes else None, plugs=PLUGS, **changes)
    np.testing.assert_allclose(offset, -PLUGS[-1], atol=1e-9)
    assert xx == pytest.approx(yy)
    assert xx + yy == pytest.approx((histogram_positions() ** 2).sum(axis=1).mean())


def test_centers_that_contradict_the_map_leave_the_estimate_uncertain():
    *_, xx, _, yy = estimate(linear_map(), plugs=PLUGS, center=(0.3, 0.3))
    assert min(xx, yy) > (0.3 * RADIUS) ** 2


def test_wrong_early_samples_are_forgotten():
    wrong = [PLUGS[0]] * 3
    before = estimate(linear_map(), plugs=wrong, center=center_at(PLUGS[0] + SOCKET))
    assert np.linalg.norm(before[:2] - SOCKET) > 2.0 * MM
    contact_map = linear_map()
    positions = histogram_positions()
    log_probabilities = 30 * contact_map.log_likelihood(PLUGS[0], center_at(PLUGS[0] + SOCKET), positions)
    for plug in [*PLUGS] * 100:
        log_probabilities = 0.99 * log_probabilities + 0.25 * contact_map.log_likelihood(
            plug, center_at(plug - SOCKET), positions
        )
    np.testing.assert_allclose(positions[log_probabilities.argmax()], SOCKET, atol=0.3 * MM)


def test_map_is_read_as_written(tmp_path):
    written = linear_map()
    written.save(tmp_path / "contact_map.csv")
    read = ContactMap.load(tmp_path / "contact_map.csv")
    np.testing.assert_allclose(read.positions, written.positions, atol=1e-7)
    np.testing.assert_allclose(read.centers, written.centers, atol=1e-7)
    assert (read.on_rim == written.on_rim).all()


def test_a_plug_that_stays_on_the_rim_excludes_where_it_would_enter():
    positions = np.random.default_rng(1).uniform(-5.0 * MM, 5.0 * MM, (2000, 2))
    on_rim = np.hypot(*positions.T) > 1.0 * MM
    contact_map = ContactMap(positions, np.zeros_like(positions), on_rim)
    swept = [np.array([x, y]) * MM for x in (-3.0, -1.5, 0.0) for y in (-3.0, -1.5, 0.0, 1.5, 3.0)]
    x, y, *_ = estimate(contact_map, plugs=swept, center=(0.0, 0.0))
    assert (swept[-1] + [x, y])[0] > 1.0 * MM


HEADER = "x,y,center_x,center_y,on_rim\n"


@pytest.mark.parametrize(
    "text", ["", "x,y\n1,2\n", *(HEADER + row for row in ("", "1,2,3,word,1", "1,2,3,nan,1", "1,2,3,4,0"))]
)
def test_damaged_file_is_refused(tmp_path, text):
    path = tmp_path / "contact_map.csv"
    path.write_text(text)
    with pytest.raises(InputError, match=r"contact map"):
        ContactMap.load(path)
