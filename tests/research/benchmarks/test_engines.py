"""Benchmark of physics engines."""

import numpy as np
import pytest

from guiderail.diagrams.tasks.contact_probe import SPEEDS, drag, press_on_rim
from guiderail.models.common.transforms import MM
from guiderail.models.objects.bnc_connector import BncDimensions
from guiderail_studies.contact_probe import DROPPED
from research.benchmarks import engines
from research.benchmarks.engines import OFFSETS, draw, even_lever, rigid_lever

D = BncDimensions()


def test_rigid_lever_is_shorter_than_even_lever():
    for offset in np.array(OFFSETS) * MM:
        assert 0.0 < rigid_lever(D, offset) < even_lever(D, offset) < D.ring_radius


def test_lever_is_even_when_soft_and_shorter_when_hard():
    soft, nominal = (engines._lever("gantry", 2.0 * MM, modulus) for modulus in (0.01, 1.0))
    assert soft == pytest.approx(even_lever(D, 2.0 * MM), rel=0.1)
    assert rigid_lever(D, 2.0 * MM) < nominal < 0.8 * soft


def test_lever_is_similar_in_mujoco():
    pytest.importorskip("mujoco")
    drake, mujoco = (engines._lever(station, 2.0 * MM, 1.0) for station in ("gantry", "mujoco"))
    assert rigid_lever(D, 2.0 * MM) < mujoco < drake == pytest.approx(mujoco, rel=0.4)


def test_capture_and_drag_in_mujoco_are_those_of_the_geometry():
    pytest.importorskip("mujoco")
    workcell, contact = engines.NARROW.workcell(), engines.NARROW.rim_contact()
    drops, stays = (
        press_on_rim(workcell, contact, [(engines.geometric_capture() + error, 0.0)], "mujoco", {})[0]
        for error in (-0.03 * MM, 0.03 * MM)
    )
    assert drops["pose"][-1, 2] < contact.height - DROPPED < stays["pose"][-1, 2]
    drags = [drag(workcell, contact, speed, "mujoco") for speed in SPEEDS]
    assert drags == pytest.approx([engines.FRICTION] * 2, rel=0.05)


def test_draw_writes_a_picture(tmp_path):
    names = ("time", "height_mm", "push_n", "torque_nm")
    profiles = {
        f"{task} {engine}": {name: [0.0, 1.0] for name in names} | {"real_time_factor": 1.0, "peak_force_n": 1.0}
        for task in engines.TASKS
        for engine in engines.ENGINES
    }
    results = {"profiles": profiles, "offsets_mm": [1.0, 2.0], "levers_mm": {"MuJoCo": [3.0, 2.0]}}
    assert draw(results, tmp_path / "engines.png").stat().st_size > 10_000
