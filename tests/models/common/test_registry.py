"""Registries refuse unknown and duplicate names, and read declarations without importing their modules."""

import sys
from dataclasses import dataclass
from importlib import import_module
from types import SimpleNamespace

import pytest

import guiderail
from guiderail.diagrams.tasks.registry import register_task
from guiderail.models.common.errors import InputError
from guiderail.models.common.registry import Registry


@pytest.mark.parametrize("name", [{}, [], None, 3, ["sphere"]])
def test_get_refuses_names_that_are_not_text(name):
    shapes = Registry("shape")
    shapes.register("sphere", object())
    with pytest.raises(InputError, match=r"a shape is named by a word, not .*: choose one of sphere"):
        shapes.get(name)


@pytest.mark.parametrize("task", [5, None, ["NarrowPassage"]])
def test_make_env_refuses_tasks_that_are_not_text(task):
    with pytest.raises(InputError, match="a task is named by a word"):
        guiderail.make_env(task)


@pytest.mark.parametrize("name", [object, "", 3, None])
def test_register_refuses_names_that_are_not_text(name):
    shapes = Registry("shape")
    with pytest.raises(InputError, match=r"a shape is registered by a name, as in @register_\.\.\.\("):
        shapes.register(name)
    with pytest.raises(InputError, match="a task is registered by a name"):
        register_task(name)
    assert shapes.names() == []


def test_get_suggests_the_closest_name_when_a_name_is_unknown():
    shapes = Registry("shape")
    shapes.register("sphere", object())
    with pytest.raises(InputError, match="there is no shape 'spere': did you mean sphere"):
        shapes.get("spere")


def test_get_refuses_all_names_when_no_entry_is_registered():
    with pytest.raises(InputError, match="there is no shape 'sphere': none is registered"):
        Registry("shape").get("sphere")


@dataclass(frozen=True)
class _Kind:
    build: object


def _function_from(file):
    """Return a function whose source file is `file`."""
    module = {"__file__": str(file)}
    exec("def build():\n    pass", module)
    return module["build"]


def test_register_replaces_an_entry_of_the_same_file_only(tmp_path):
    shapes = Registry("shape")
    shapes.register("sphere", _Kind(_function_from(tmp_path / "one.py")))
    second = _Kind(_function_from(tmp_path / "one.py"))
    shapes.register("sphere", second)
    assert shapes.get("sphere") is second
    with pytest.raises(InputError, match=r"there is a shape 'sphere' already, from \S*one\.py: choose another name"):
        shapes.register("sphere", _Kind(_function_from(tmp_path / "two.py")))
    assert shapes.get("sphere") is second


def test_declared_reads_literals_without_an_import(tmp_path, monkeypatch):
    (tmp_path / "local_shapes").mkdir()
    (tmp_path / "local_shapes/__init__.py").touch()
    (tmp_path / "local_shapes/polygons.py").write_text(
        'SIDES = 4\n\n\n@register_shape("triangle", sides=3)\ndef triangle():\n    raise AssertionError\n\n\n'
        '@register_shape("square", sides=SIDES)\ndef square():\n    pass\n'
    )
    monkeypatch.syspath_prepend(tmp_path)
    shapes = Registry("shape", package="local_shapes", decorator="register_shape")
    assert shapes.names() == ["square", "triangle"]
    assert shapes.declared("triangle", "sides") == 3
    with pytest.raises(NameError, match="register_shape"):  # `sides` is not a literal: the module is imported
        shapes.declared("square", "sides")
    triangle = _function_from(tmp_path / "local_shapes/polygons.py")
    shapes.register("triangle", SimpleNamespace(sides=30, build=triangle))
    assert shapes.declared("triangle", "sides") == 30


def test_register_refuses_a_declared_name_before_its_import(tmp_path, monkeypatch):
    (tmp_path / "lazy_shapes").mkdir()
    (tmp_path / "lazy_shapes/__init__.py").touch()
    (tmp_path / "lazy_shapes/polygons.py").write_text(
        'from lazy_shapes.kinds import register_shape\n\n\n@register_shape("triangle")\ndef triangle():\n    pass\n'
    )
    (tmp_path / "lazy_shapes/kinds.py").write_text(
        "from guiderail.models.common.registry import Registry\n\n"
        'SHAPES = Registry("shape", package="lazy_shapes", decorator="register_shape")\n'
        "register_shape = SHAPES.register\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    shapes = import_module("lazy_shapes.kinds").SHAPES
    with pytest.raises(InputError, match=r"there is a shape 'triangle' already, from lazy_shapes\.polygons: choose"):
        shapes.register("triangle", _function_from(tmp_path / "other.py"))
    assert "lazy_shapes.polygons" not in sys.modules
    triangle = shapes.get("triangle")
    assert triangle.__module__ == "lazy_shapes.polygons"
    with pytest.raises(InputError, match="there is a shape 'triangle' already"):
        shapes.register("triangle", _function_from(tmp_path / "other.py"))
    assert shapes.get("triangle") is triangle
