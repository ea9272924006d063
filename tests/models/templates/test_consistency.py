"""Contradictions of active constraints are found, and consistent constraints are accepted."""

from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from guiderail.models.common.transforms import RigidTransform, RotationMatrix
from guiderail.models.templates import active_constraints as ac
from guiderail.models.templates import load_template, parse_template
from guiderail.models.templates.consistency import find_contradiction
from guiderail.models.templates.schema import shipped_templates

TEMPLATE = (Path(__file__).parent / "reach.yaml").read_text()
BOX = ac.Box((-0.1, -0.01, 0.0), (0.02, 0.01, 0.02))
UPRIGHT = ac.FixedOrientation()


@pytest.mark.parametrize(
    ("constraints", "indices"),
    [
        ([BOX, ac.FixedOrientation((90.0, 0.0, 0.0)), UPRIGHT], (1, 2)),
        ([UPRIGHT, ac.TiltLimits("world", 30.0, 60.0)], (0, 1)),
        ([ac.FixedOrientation((0.0, 0.0, 20.0)), ac.TiltLimits("world", -10.0, 10.0)], (0, 1)),  # rotated about z
        ([ac.TiltLimits("world", 0.0, 20.0), ac.TiltByDistance("world", (0.1, 0.2), (40.0, 30.0))], (0, 1)),
        ([ac.TiltLimits("world", 10.0, 20.0), ac.TiltLimits("world", -20.0, -10.0)], (0, 1)),
        ([BOX, UPRIGHT, ac.KeepAbove(0.5)], (0, 2)),
        ([BOX, ac.KeepAbove(0.01, points_m=((0.0, 0.0, -0.1),)), UPRIGHT], (0, 1, 2)),
        ([BOX, ac.Cylinder("world", 0.2)], (0, 1)),
        ([BOX, ac.Sector("world", 30.0, 60.0), ac.HalfSpace((1.0, 0.0, 0.0), 0.019)], (0, 1, 2)),
        ([ac.HalfSpace((1.0, 0.0, 0.0), 1.0), ac.HalfSpace((-1.0, 0.0, 0.0), -0.9999)], (0, 1)),
        ([ac.HalfSpace((1.0, 1.0, 0.0), 0.1), ac.HalfSpace((-1.0, 1.0, 0.0), 0.1), ac.HalfSpace((0.0, -1.0, 0.0), 0.0)],
         (0, 1, 2)),
        ([ac.InsideSphere(0.05), ac.OutsideSphere(0.1)], (0, 1)),
        ([BOX, ac.OutsideBox((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))], (0, 1)),
        ([ac.Funnel("world", 0.1, 0.1, 0.5), ac.KeepAbove(0.3), ac.Cylinder("world", 0.0, 0.2)], (0, 1, 2)),
    ],
)  # fmt: skip
def test_find_contradiction_returns_contradictory_constraints(constraints, indices):
    assert find_contradiction(constraints) == indices


@pytest.mark.parametrize(
    "constraints",
    [
        [BOX, UPRIGHT, UPRIGHT],
        [ac.FixedOrientation((0.0, 45.0, 0.0)), ac.TiltLimits("world", -60.0, -30.0)],  # on the other side of the axis
        [ac.TiltLimits("world", -180.0, -179.0), ac.TiltLimits("world", 179.0, 180.0)],
        [ac.TiltLimits("world", 10.0, 20.0), ac.TiltLimits("world", -20.0, -10.0, turns_along=True)],
        # In each of the next three lists, the sets have a single point or edge in common.
        [ac.Box((0.005, -0.05, 0.0), (0.02, 0.05, 0.01)), ac.Cylinder("world", 0.0, 0.005)],
        [ac.HalfSpace((1.0, 0.0, 0.0), 0.1), ac.HalfSpace((-1.0, 0.0, 0.0), -0.1)],
        [ac.Funnel("world", 0.1, 0.1, 0.5), ac.KeepAbove(0.3)],
        # Constraints in different frames are not compared, because objects move.
        [UPRIGHT, ac.FixedOrientation((90.0, 0.0, 0.0), "cup")],
    ],
)
def test_find_contradiction_accepts_constraints_with_a_pose(constraints):
    assert find_contradiction(constraints) == ()


@given(st.integers(0, 2**32 - 1))
def test_find_contradiction_accepts_constraints_around_a_pose(seed):
    rng = np.random.default_rng(seed)
    p, room = 0.3 * rng.standard_normal(3), float(rng.choice([0.0, 1e-9, 1e-3, 0.1]))
    X_WE = RigidTransform(RotationMatrix(Rotation.random(rng=rng).as_matrix()), p)
    normals = rng.standard_normal((3, 3))
    azimuth, radius = np.rad2deg(np.arctan2(p[1], p[0])), float(np.hypot(*p[:2]))
    around = [
        *(ac.HalfSpace(tuple(n), float(n @ p / np.linalg.norm(n)) - room) for n in normals),
        ac.Box(tuple(p - room), tuple(p + rng.uniform(0.0, 1.0, 3))),
        ac.Cylinder("world", max(0.0, radius - room), radius + room),
        ac.Sector("world", azimuth - room, azimuth + float(rng.choice([0.0, 90.0, 200.0]))),
        ac.KeepAbove(p[2] - 0.2 - room, points_m=((0.0, 0.0, -0.2), (0.2, 0.0, 0.0))),
        ac.Funnel("world", 0.1, p[2] + room, 0.5),
        ac.InsideSphere(float(np.linalg.norm(p)) + room + 1e-12),
        ac.OutsideSphere(0.1, tuple(p + [0.1 + room + 1e-9, 0.0, 0.0])),
    ]
    chosen = [around[i] for i in rng.permutation(len(around))[: rng.integers(2, len(around) + 1)]]
    assert all(constraint.violation(X_WE, {}) < 1e-8 for constraint in chosen)
    assert find_contradiction(chosen) == ()


@given(st.integers(0, 2**32 - 1))
def test_find_contradiction_accepts_orientations_of_a_pose(seed):
    rng = np.random.default_rng(seed)
    rpy, low, high = tuple(rng.uniform(-180, 180, 3)), *np.sort(rng.uniform(-180, 180, 2)).tolist()
    along, p = bool(rng.integers(2)), 0.3 * rng.standard_normal(3)
    tilt = ac.TiltLimits("world", low, high, rpy, along)
    X_WE = tilt.project(RigidTransform(RotationMatrix(Rotation.random(rng=rng).as_matrix()), p), {})
    rpy_of_pose = Rotation.from_matrix(X_WE.rotation().matrix()).as_euler("xyz", degrees=True)
    fixed = ac.FixedOrientation(tuple(rpy_of_pose.tolist()))
    assert fixed.violation(X_WE, {}) < 1e-7
    assert find_contradiction([tilt, fixed]) == ()


@pytest.mark.parametrize("name", shipped_templates())
def test_shipped_templates_have_no_contradiction(name):
    assert load_template(name).contradiction is None


def test_contradiction_names_state_and_constraints():
    data = yaml.safe_load(TEMPLATE)
    data["states"]["near"]["active_constraints"] = [
        {"kind": "fixed_orientation", "frame": "cup", "rpy_deg": [90, 0, 0]},
        {"kind": "fixed_orientation", "frame": "cup"},
    ]
    template = parse_template(yaml.safe_dump(data, sort_keys=False))
    assert template.contradiction == (
        "near: active constraint 1 (FixedOrientation) contradicts 2 (FixedOrientation); no pose satisfies both: "
        "change one"
    )
    assert template.without_active_constraints().contradiction is None
