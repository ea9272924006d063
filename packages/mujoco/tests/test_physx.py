"""PhysX as an engine: what it shares with other simulations in the process, failures, and limits of its shapes."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
from pushed_station import push_robot

from guiderail import InputError, make_env
from guiderail.diagrams.stations.workcell import Hull
from guiderail.diagrams.tasks.bnc_connector import BncWorkcell
from guiderail.models.common.transforms import MM
from guiderail_mujoco.physx import MAX_VERTICES, PhysxStation
from guiderail_mujoco.surfaces import surfaces_of

with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    sapien = pytest.importorskip("sapien")

CONNECTOR = BncWorkcell()


@pytest.fixture(scope="module")
def engine():
    return PhysxStation(CONNECTOR).gantry.engine


def test_settings_of_other_simulations_are_kept():
    common = sapien.physx.get_scene_config()
    assert common.enable_pcm
    np.testing.assert_allclose(common.gravity, [0.0, 0.0, -9.81], rtol=1e-6)
    PhysxStation(CONNECTOR)
    after = sapien.physx.get_scene_config()
    assert (after.enable_pcm, after.enable_tgs) == (common.enable_pcm, common.enable_tgs)
    np.testing.assert_array_equal(after.gravity, common.gravity)


def test_collision_shapes_are_the_convex_solids(engine):
    """PhysX computes hulls from vertices, in single precision, and could merge or drop some."""
    _, workpiece = surfaces_of(CONNECTOR)
    shapes = engine._body.collision_shapes
    assert len(shapes) == len(workpiece)
    for surface, shape in zip(workpiece, shapes, strict=True):
        if isinstance(surface.shape, Hull):
            distances = np.linalg.norm(shape.vertices[:, None] * MM - np.asarray(surface.shape.vertices)[None], axis=2)
            assert distances.min(axis=0).max() < 1e-9, surface.name


def test_hull_with_too_many_vertices_is_refused(engine):
    surface = next(surface for surface in surfaces_of(CONNECTOR)[1] if isinstance(surface.shape, Hull))
    angle = np.linspace(0.0, 6.0, MAX_VERTICES)
    hull = Hull(np.column_stack([np.cos(angle), np.sin(angle), np.cos(3.0 * angle)]) * MM)
    engine._shape(replace(surface, shape=hull))
    larger = Hull(np.concatenate([hull.vertices, [[0.0, 0.0, 3.0 * MM]]]))
    with pytest.raises(InputError, match="at most 255 vertices in PhysX"):
        engine._shape(replace(surface, shape=larger))


def test_divergence_ends_the_episode():
    env = make_env("BncConnector", station="sapien", action_repeat=5)
    for displacement in (1e11, 1e300):
        env.reset(seed=3)
        env.step(np.zeros(2))
        push_robot(env, np.array([0.0, 0.0, displacement, 0.0, 0.0, 0.0]))
        *_, terminated, truncated, info = env.step(np.zeros(2))
        assert (terminated, truncated) == (False, True)
        assert "the simulation failed in PhysX" in info["simulation_failure"]


def test_body_has_the_mass_of_tool_and_workpiece(engine):
    assert engine._body.mass == pytest.approx(engine._mass)
    np.testing.assert_allclose(engine._body.inertia * MM**2, engine._inertia, rtol=1e-6)
    np.testing.assert_array_equal(engine._body.cmass_local_pose.p, 0.0)
