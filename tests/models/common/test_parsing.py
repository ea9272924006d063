"""Packages that a model names by `package://`."""

from pathlib import Path

import pytest
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.systems.framework import DiagramBuilder

from guiderail.models.common.errors import InputError
from guiderail.models.common.parsing import add_models

URDF = """<robot name="r"><link name="a"><visual><geometry><mesh filename="package://meshes/box.obj"/></geometry>
</visual></link></robot>"""
OBJ = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


def make_package(folder: Path, name="meshes"):
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "package.xml").write_text(f"<package><name>{name}</name></package>")
    (folder / "box.obj").write_text(OBJ)


@pytest.mark.parametrize("depth", [0, 1, 3])
@pytest.mark.parametrize("place", ["above", "sibling", "ROS_PACKAGE_PATH", "nowhere"])
def test_package_of_a_mesh_is_found(place, depth, tmp_path, monkeypatch):
    monkeypatch.delenv("ROS_PACKAGE_PATH", raising=False)
    package = tmp_path / "src" / "robot"
    model = package.joinpath(*["urdf", "arm", "left"][:depth]) / "robot.urdf"
    model.parent.mkdir(parents=True)
    model.write_text(URDF)
    if place == "above":
        make_package(package)
    elif place == "sibling":
        make_package(package, "robot")
        make_package(tmp_path / "src" / "other")
    elif place == "ROS_PACKAGE_PATH":
        make_package(tmp_path / "ros" / "share" / "meshes")
        monkeypatch.setenv("ROS_PACKAGE_PATH", f"{tmp_path / 'missing'}:{tmp_path / 'ros'}")
    plant, scene_graph = AddMultibodyPlantSceneGraph(DiagramBuilder(), 0.001)
    if place == "nowhere":
        with pytest.raises(InputError, match=r"can't be read.*meshes"):
            add_models(plant, model)
    else:
        assert len(add_models(plant, model)) == 1
        assert scene_graph.model_inspector().num_geometries() == 1


def test_models_of_this_package_have_urls():
    plant, _ = AddMultibodyPlantSceneGraph(DiagramBuilder(), 0.01)
    add_models(plant, "package://guiderail/robots/iiwa14.urdf")
    assert plant.HasBodyNamed("iiwa_flange")
    with pytest.raises(InputError, match=r"nothing\.urdf"):
        add_models(plant, "package://guiderail/robots/nothing.urdf")
