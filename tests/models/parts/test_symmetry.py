"""From which sides parts look the same is what their drawings say."""

import pytest

from guiderail.models.common.units import DEGREE
from guiderail.models.parts.assembly_check import motion
from guiderail.models.parts.symmetry import SIDES, sides

pytest.importorskip("trimesh")
pytest.importorskip("manifold3d")

from guiderail.tools.parts.create_task import read_parts
from oracles.parts import PARTS


@pytest.mark.parametrize(
    ("name", "turn", "same", "on_the_rim"),
    [
        ("square_peg", 0.0, set(SIDES), set()),
        ("keyed_peg", 0.0, {"mirrored across x"}, set(SIDES) - {"mirrored across x"}),
        ("snap_fit", 0.0, {"half turn", "mirrored across x", "mirrored across y"}, None),
        ("dovetail", 0.0, {"mirrored across y"}, set()),
        ("bayonet", 40.0, set(), None),  # what turns one way is not its own mirror image
    ],
)
def test_sides_are_those_of_the_drawing(name, turn, same, on_the_rim, tmp_path):
    parts = read_parts(*PARTS[name]().write(tmp_path), "mm", (0.0,) * 6, "+z", None)
    found, nearly = sides(*parts, motion(*parts, turn * DEGREE))
    assert set(found) == same
    assert on_the_rim is None or set(nearly) == on_the_rim
    assert not set(found) & set(nearly)
