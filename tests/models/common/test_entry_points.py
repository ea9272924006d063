"""Entry points of installed packages: discovery, name conflicts, and errors of broken entry points."""

import sys

import pytest

from guiderail.models.common.errors import InputError
from guiderail.models.common.registry import BUILT_IN, Registry, check_callable


@pytest.fixture
def install(tmp_path, monkeypatch):
    """Return a function that installs a package of one module with plug-ins of the kind "shape"."""
    monkeypatch.syspath_prepend(str(tmp_path))

    def install(package, source, **entry_points):
        if source is not None:
            (tmp_path / f"{package}.py").write_text(source)
        information = tmp_path / f"{package}-1.0.dist-info"
        information.mkdir()
        (information / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n")
        lines = [f"shape:{name} = {package}:{value}" for name, value in entry_points.items()]
        (information / "entry_points.txt").write_text("\n".join(["[guiderail]", *lines, ""]))

    yield install
    for name, module in list(sys.modules.items()):  # only modules of the temporary folder
        if (getattr(module, "__file__", None) or "").startswith(str(tmp_path)):
            del sys.modules[name]


def make_registry(**arguments):
    return Registry("shape", plugin="shape", check=check_callable, **arguments)


@pytest.mark.parametrize(
    ("source", "reason"),
    [
        ("def broken(:\n", "importing lab_broken:Cone failed: SyntaxError"),
        ("raise RuntimeError('no licence')\n", r"failed: lab_broken\.py, line 1: RuntimeError: no licence"),
        ("raise SystemExit(3)\n", "SystemExit: 3"),
        ("import nowhere\n", "ModuleNotFoundError: No module named 'nowhere'"),
        ("\n", "has no attribute 'Cone'"),
        ("Cone = 3\n", "'cone' is registered with a function or a class, not with 3"),
        (None, "No module named 'lab_broken'"),
    ],
)
def test_broken_entry_point_is_refused_only_when_used(install, source, reason):
    install("lab_broken", source, cone="Cone")
    install("lab_sound", "def Cube():\n    pass\n", cube="Cube")
    registry = make_registry()
    registry.register("sphere", install)
    assert registry.get("sphere") is install
    assert registry.get("cube").__module__ == "lab_sound"
    for _ in range(2):
        with pytest.raises(InputError, match=f"the shape 'cone' of the installed package lab_broken .*{reason}"):
            registry.get("cone")
    assert registry.names() == ["cone", "cube", "sphere"]
    assert registry.usable() == ["cube", "sphere"]
    assert list(registry.broken) == ["cone"]


def test_entry_points_of_two_packages_with_one_name_are_refused(install):
    install("lab_one", "def Cone():\n    pass\n", cone="Cone")
    install("lab_two", "def Cone():\n    pass\n", cone="Cone")
    registry = make_registry()
    with pytest.raises(InputError, match=r"the shape 'cone' of the installed package .* there is another shape 'cone'"):
        registry.get("cone")
    assert registry.usable() == []


def test_entry_point_is_refused_when_its_name_is_registered(install):
    install("lab_one", "def Cone():\n    pass\n", cone="Cone")
    registry = make_registry()
    registry.register("cone", test_entry_points_of_two_packages_with_one_name_are_refused)
    with pytest.raises(InputError, match=r"lab_one cannot be used: there is another shape 'cone', from \S+\.py"):
        registry.get("cone")


def test_built_in_is_returned_when_an_entry_point_has_its_name(install, tmp_path, caplog, monkeypatch):
    (tmp_path / "own_cones.py").write_text("def Cone():\n    pass\n")
    monkeypatch.setitem(BUILT_IN, "shape:cone", "own_cones:Cone")
    install("lab_broken", "raise RuntimeError\n", cone="Cone")
    registry = make_registry()
    for _ in range(2):
        assert registry.get("cone").__module__ == "own_cones"
    assert registry.broken == {}
    assert registry.usable() == ["cone"]
    assert [record.getMessage() for record in caplog.records] == [
        "the shape 'cone' of the installed package lab_broken is ignored, because guiderail has one of this name: "
        "rename or uninstall it"
    ]


def test_entry_point_is_found_when_its_module_registers_it(install):
    source = "import lab_shapes\n\n\n@lab_shapes.REGISTRY.register('cone')\ndef Cone():\n    pass\n"
    install("lab_one", source, cone="Cone")
    registry = make_registry()
    sys.modules["lab_shapes"] = type(sys)("lab_shapes")
    sys.modules["lab_shapes"].REGISTRY = registry
    cone = registry.get("cone")
    assert registry.get("cone") is cone
    assert registry.broken == {}


def test_name_of_finds_an_entry_point_without_loading_it(install):
    install("lab_one", "class Cone:\n    pass\n", cone="Cone")
    registry = make_registry()
    assert registry.name_of(Registry) is None
    import lab_one

    assert registry.name_of(lab_one.Cone) == "cone"
    registry.register("registry", Registry)
    assert registry.name_of(Registry) == "registry"
