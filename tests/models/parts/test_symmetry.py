"""The symmetries that are found are those of the parts' drawings."""

import pytest

from guiderail.models.common.transforms import DEGREE
from guiderail.models.parts.assembly_check import plan_motion
from guiderail.models.parts.symmetry import SYMMETRIES, find_symmetries

pytest.importorskip("trimesh")
pytest.importorskip("manifold3d")

from guiderail.tools.parts.create_task import read_parts
from oracles.parts import PARTS


@pytest.mark.parametrize(
    ("name", "turn", "same", "on_the_rim"),
    [
        ("square_peg", 0.0, set(SYMMETRIES), set()),
        ("keyed_peg", 0.0, {"mirrored across x"}, set(SYMMETRIES) - {"mirrored across x"}),
        ("snap_fit", 0.0, {"half turn", "mirrored across x", "mirrored across y"}, None),
        ("dovetail", 0.0, {"mirrored across y"}, set()),
        ("bayonet", 40.0, set(), None),  # a turn in one direction is not its own mirror image
    ],
)
def test_find_symmetries_returns_those_of_the_drawing(name, turn, same, on_the_rim, tmp_path):
    parts = read_parts(*PARTS[name]().write(tmp_path), "mm", (0.0,) * 6, "+z", None)
    exact, approximate = find_symmetries(*parts, plan_motion(*parts, turn * DEGREE))
    assert set(exact) == same
    assert on_the_rim is None or set(approximate) == on_the_rim
    assert not set(exact) & set(approximate)
