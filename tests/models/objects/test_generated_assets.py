"""Files generated for objects whose dimensions differ from those of the shipped files."""

import dataclasses
import re

import numpy as np
import pytest

from guiderail.models.common.transforms import MM
from guiderail.models.objects import bnc_connector, grid_clamp
from guiderail.models.objects.bnc_connector import BORE_SIDES, FOLDER, FRICTION, LIP_RISE, LIP_WIDTH, BncDimensions
from guiderail.models.objects.grid_clamp import FOLDER as GRID_CLAMP_FOLDER
from guiderail.models.objects.grid_clamp import NUM_SIDES, GridClampDimensions
from guiderail.models.objects.sdf import equal_area_radius


def read_vertices(path):
    """Return the vertices (V, 3) of an OBJ file [m]."""
    return np.array([line.split()[1:] for line in path.read_text().splitlines() if line.startswith("v ")], float)


@pytest.mark.parametrize(
    ("folder_of", "dimensions", "folder"),
    [
        (bnc_connector.folder_of, BncDimensions(), FOLDER),
        (grid_clamp.folder_of, GridClampDimensions(), GRID_CLAMP_FOLDER),
    ],
)
def test_folder_of_returns_the_shipped_folder_by_default(folder_of, dimensions, folder):
    assert folder_of(dimensions) == folder
    assert folder_of(dataclasses.replace(dimensions)) == folder


def test_generated_connector_has_the_given_dimensions():
    dimensions = dataclasses.replace(BncDimensions().with_bore_clearance(0.07 * MM), mouth_chamfer=0.25 * MM)
    folder = bnc_connector.folder_of(dimensions, 0.35)
    assert bnc_connector.folder_of(dimensions, 0.35) == folder != FOLDER
    bore, corner = read_vertices(folder / "bnc_bore.obj"), equal_area_radius(1.0, BORE_SIDES)
    radii = np.hypot(*bore[:, :2].T) / corner
    np.testing.assert_allclose(radii[bore[:, 2] > 1.0 * MM], 4.825 * MM + 0.07 * MM, atol=1e-8)
    # The chamfer is as wide as it is deep, up to the lip.
    assert np.isclose(bore[:, 2], 0.25 * MM).any()
    np.testing.assert_allclose(radii[np.isclose(bore[:, 2], LIP_RISE)] + LIP_RISE, 5.145 * MM, atol=1e-8)
    np.testing.assert_allclose(radii[bore[:, 2] < 1e-9], 5.145 * MM + LIP_WIDTH, atol=1e-8)
    face = read_vertices(folder / "bnc_face.obj")
    assert np.hypot(*face[:, :2].T).min() == pytest.approx(corner * (5.145 * MM + LIP_WIDTH), abs=1e-8)
    for name in ("bnc_jack.sdf", "bnc_plug.sdf"):
        frictions = re.findall(r"<drake:mu_static>([\d.]+)<", (folder / name).read_text())
        assert set(frictions) == {"0.35", "0.05"}


def test_generated_slot_has_the_given_width():
    standard, wide = (
        read_vertices(bnc_connector.folder_of(dimensions) / "bnc_slots.obj")
        for dimensions in (BncDimensions(), dataclasses.replace(BncDimensions(), slot_clearance=0.2 * MM))
    )
    assert wide[:, 2].max() - standard[:, 2].max() == pytest.approx(0.075 * MM, abs=1e-6)


def test_generated_clamp_and_table_have_the_given_dimensions():
    dimensions = dataclasses.replace(
        GridClampDimensions().with_clearance(0.1 * MM), hole_chamfer=0.3 * MM, peg_chamfer=0.2 * MM
    )
    folder = grid_clamp.folder_of(dimensions, 0.3)
    inradius_ratio = np.cos(np.pi / NUM_SIDES)  # distance of a polygon's sides over that of its corners
    hole, peg = read_vertices(folder / "grid_clamp_hole.obj"), read_vertices(folder / "grid_clamp_peg.obj")
    assert np.hypot(*hole[:, :2].T).min() * inradius_ratio == pytest.approx(4.1 * MM, abs=1e-8)
    assert np.isclose(hole[:, 2], -0.3 * MM).any()
    tip = peg[(peg[:, 2] < 1e-9) & (np.hypot(*peg[:, :2].T) > 1.0 * MM)]
    np.testing.assert_allclose(np.hypot(*tip[:, :2].T) * inradius_ratio, 3.8 * MM, atol=1e-8)
    clearance = dimensions.hole_radius - dimensions.peg_radius
    assert clearance + dimensions.hole_chamfer + dimensions.peg_chamfer == pytest.approx(0.6 * MM)
    assert "<drake:mu_static>0.3<" in (folder / "grid_table.sdf").read_text()
    assert FRICTION != 0.3
