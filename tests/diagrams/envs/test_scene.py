"""Cameras of a scene: poses, projection and rendering."""

import subprocess
import sys
from importlib.util import find_spec
from types import SimpleNamespace

import numpy as np
import pytest
from pydrake.geometry import SceneGraph
from pydrake.math import RigidTransform
from pydrake.systems.framework import DiagramBuilder

from guiderail.diagrams.envs.scene import Camera, add_camera, look_at

SCRIPT = """
import gymnasium, guiderail
env = gymnasium.make("guiderail/NarrowPassage-v0", guidance="kgrl", observation="image")
env.reset(seed=0)
import torch._dynamo
env.step(env.action_space.sample())
"""


def test_project_returns_pixels_when_camera_is_fixed():
    camera = Camera((40, 20), np.deg2rad(90.0), look_at(np.zeros(3), np.array([1.0, 0.0, 0.0])))
    points = [[2.0, 0.0, 0.0], [2.0, 1.0, 0.0], [2.0, 0.0, 1.0]]
    np.testing.assert_allclose(camera.project(points), [[20.0, 10.0], [15.0, 10.0], [20.0, 5.0]])


def test_triton_is_imported_before_rendering(tmp_path, monkeypatch):
    (tmp_path / "triton.py").write_text("")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "triton", raising=False)
    builder, scene_graph = DiagramBuilder(), SceneGraph()
    builder.AddSystem(scene_graph)
    camera = Camera((8, 8), 1.0, RigidTransform())
    query = scene_graph.get_query_output_port()
    ports = {"HasOutputPort": lambda name: True, "GetOutputPort": lambda name: query}
    add_camera(builder, SimpleNamespace(scene_graph=scene_graph, **ports), "camera", camera)
    assert sys.modules.pop("triton").__file__ == str(tmp_path / "triton.py")


@pytest.mark.skipif(find_spec("triton") is None, reason="Triton is installed only with PyTorch for CUDA")
def test_pytorch_compiler_is_imported_after_rendering():
    assert subprocess.run([sys.executable, "-c", SCRIPT], timeout=300).returncode == 0
