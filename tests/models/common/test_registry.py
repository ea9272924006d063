"""Registries refuse unknown and duplicate names; the table of plug-ins has every entry of guiderail."""

import sys
from dataclasses import dataclass
from importlib.metadata import EntryPoint

import pytest

import guiderail
from guiderail.diagrams.guidance.registry import GUIDANCE
from guiderail.diagrams.stations.registry import STATIONS
from guiderail.diagrams.tasks.registry import TASKS, register_task
from guiderail.models.common import registry as registry_module
from guiderail.models.common.errors import InputError
from guiderail.models.common.registry import BUILT_IN, SIBLINGS, Registry, find_plugins
from guiderail.models.primitives.kernels import KERNELS
from guiderail.models.robots.robot import END_EFFECTORS, ROBOTS
from guiderail.tools.learning.learner import LEARNERS

REGISTRIES = {
    "task": TASKS, "station": STATIONS, "guidance": GUIDANCE, "kernel": KERNELS, "robot": ROBOTS,
    "end_effector": END_EFFECTORS, "learner": LEARNERS,
}  # fmt: skip
OPTIONS = {"station_options": (STATIONS, "options"), "learner_config": (LEARNERS, "Config")}


@pytest.mark.parametrize(
    ("entry", "sibling"), [(name, sibling) for sibling, names in SIBLINGS.items() for name in names if ":" in name]
)
def test_plugin_of_missing_sibling_names_the_line_that_installs_it(entry, sibling, monkeypatch):
    kind, _, name = entry.partition(":")
    assert name in dict(find_plugins(kind))
    monkeypatch.setattr(registry_module, "find_plugins", lambda kind: iter(()))
    with pytest.raises(InputError, match=rf"the {kind} '{name}' needs .*: pip install \"guiderail\[{sibling}\]\""):
        Registry(kind, plugin=kind).get(name)


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


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("spere", "there is no shape 'spere': did you mean sphere"),
        *((name, "a shape is named by a word, not .*: choose one of sphere") for name in ({}, [], None, 3, ["sphere"])),
    ],
)
def test_get_refuses_unknown_names_and_suggests_one(name, message):
    shapes = Registry("shape")
    shapes.register("sphere", object())
    with pytest.raises(InputError, match=message):
        shapes.get(name)


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


def test_register_refuses_a_name_of_the_table_before_its_import(tmp_path, monkeypatch):
    (tmp_path / "polygons.py").write_text("def triangle():\n    pass\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setitem(BUILT_IN, "shape:triangle", "polygons:triangle")
    shapes = Registry("shape", plugin="shape")
    assert shapes.names() == ["triangle"]
    assert shapes.is_packaged("triangle")
    with pytest.raises(InputError, match=r"there is a shape 'triangle' already, from polygons: choose"):
        shapes.register("triangle", _function_from(tmp_path / "other.py"))
    assert "polygons" not in sys.modules
    triangle = shapes.get("triangle")
    assert triangle.__module__ == "polygons"
    with pytest.raises(InputError, match="there is a shape 'triangle' already"):
        shapes.register("triangle", _function_from(tmp_path / "other.py"))
    assert shapes.get("triangle") is triangle


@pytest.mark.parametrize("name", BUILT_IN)
def test_every_target_of_the_table_is_registered_under_its_name(name):
    kind, _, entry = name.partition(":")
    target = EntryPoint(name, BUILT_IN[name], "").load()
    if kind in REGISTRIES:
        value = REGISTRIES[kind].get(entry)
        assert target in (value, getattr(value, "build", None))
    else:
        if kind == "task_options":
            assert issubclass(TASKS.get(entry), target)
            return
        registry, attribute = OPTIONS[kind]
        assert getattr(registry.get(entry), attribute) is target


def test_every_own_entry_is_in_the_table():
    for kind, registry in REGISTRIES.items():
        for name in registry.names():
            registry.get(name)
        own = {name for name, entry in registry._entries.items() if _module(entry).startswith("guiderail.")}
        assert own == {name.partition(":")[2] for name in BUILT_IN if name.startswith(f"{kind}:")}


def _module(entry):
    return str(getattr(getattr(entry, "build", entry), "__module__", ""))
