"""Meshes from SDF models: frames, shapes, seated pose and clearance of a plug between two walls."""

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("trimesh")
pytest.importorskip("manifold3d")
pytest.importorskip("igl")

import trimesh

from guiderail.models.common.errors import InputError
from research.parts.connectors import CONNECTORS, Connector, main, read_model, write_connector

SURFACE = "<surface><friction><bullet><friction>0.5</friction></bullet></friction></surface>"
PAIR = Connector("plug", "port", "tip", "seat", ("body", "tip"), ("walls",), frozenset({"filling"}))


def box(name, pose, size, extra=""):
    return (
        f"<collision name='{name}'><pose>{pose}</pose><geometry><box><size>{size}</size></box></geometry>{extra}"
        "</collision>"
    )


@pytest.fixture
def models(tmp_path):
    """Return a folder with a plug that points along x, and a port with a clearance of 0.2 mm, open along y."""
    shaft = box("shaft", "0 0 0 0 0 0", "0.02 0.004 0.004")
    mark = box("mark", "0 0 0.0005 0 0 0", "0.002 0.002 0.001")  # in the tip's frame: reaches 1 mm ahead
    walls = [box(f"wall_{x}", f"{x} 0 0 0 0 0", "0.001 0.006 0.01", SURFACE) for x in (0.0027, -0.0027)]
    floor, filling = box("floor", "0 0 -0.0055 0 0 0", "0.0064 0.006 0.001"), box("filling", "0 0 0 0 0 0", "1 1 1")
    links = {
        "plug": f"<link name='body'>{shaft}</link><link name='tip'><pose>0.01 0 0 0 1.5708 0</pose>{mark}</link>",
        "port": f"<link name='walls'>{''.join(walls)}{floor}{filling}</link>"
        "<link name='entrance'><pose>0 0 0.005 3.14159 0 0</pose></link>"
        "<link name='seat'><pose relative_to='entrance'>0 0 0.0095 0 0 0</pose></link>",
    }
    for name, text in links.items():
        (tmp_path / name).mkdir()
        (tmp_path / name / "model.sdf").write_text(f"<sdf version='1.9'><model name='{name}'>{text}</model></sdf>")
    return tmp_path


def test_plug_is_seated_where_it_first_touches_the_socket(models, tmp_path):
    measured = write_connector(models, PAIR, tmp_path / "out")
    # The tip ends 1 mm below the seat's frame, and the floor is 0.5 mm below this frame.
    assert measured["seated_above_frames_mm"] == pytest.approx(0.5, abs=5e-3)
    assert measured["clearance_mm"] == pytest.approx(0.2, abs=2e-3)
    assert measured["depth_mm"] == pytest.approx(10.0, abs=5e-3)
    assert measured["friction"] == 0.5
    plug, socket = (trimesh.load(tmp_path / "out" / f"{name}.stl") for name in ("plug", "socket"))
    assert plug.is_watertight
    assert socket.is_watertight
    assert plug.volume == pytest.approx(20.0 * 16.0 + 4.0, rel=1e-4)
    np.testing.assert_allclose(plug.bounds, [[-2.0, -2.0, -0.5], [2.0, 2.0, 20.5]], atol=5e-3)
    np.testing.assert_allclose(socket.bounds, [[-3.2, -3.0, -1.5], [3.2, 3.0, 9.5]], atol=5e-3)


def test_connector_is_refused_when_shapes_do_not_fit(models, tmp_path):
    out = tmp_path / "out"
    with pytest.raises(InputError, match="overlaps the socket"):
        write_connector(models, replace(PAIR, left_out=frozenset()), out)
    with pytest.raises(InputError, match="nothing stops the plug"):
        write_connector(models, replace(PAIR, left_out=frozenset({"filling", "floor"})), out)
    with pytest.raises(InputError, match="the model port has no link lid"):
        write_connector(models, replace(PAIR, seat="lid"), out)
    assert not out.exists()


def test_main_refuses_models_of_something_else(models, tmp_path):
    (models / CONNECTORS["sc"].plug).symlink_to(models / "plug")
    file = models / "plug" / "model.sdf"
    with pytest.raises(InputError, match=r"SC Port/model\.sdf cannot be read"):
        main(["--models", str(models), "--out", str(tmp_path / "out")])
    for old, new, message in (("box>", "sphere>", "neither a box nor a cylinder"), ("0.02 ", "nan ", "3 numbers")):
        text = file.read_text()
        file.write_text(text.replace(old, new))
        with pytest.raises(InputError, match=message):
            read_model(file)
        file.write_text(text)
