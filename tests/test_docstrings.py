"""What people import says what it is, what it takes and what it refuses; the reference is made of nothing else."""

import ast
import dataclasses
import inspect
import re
import textwrap

import pytest

import guiderail
from guiderail import systems
from guiderail.diagrams import guidance
from guiderail.models import primitives

MODULES = (guiderail, systems, guidance, primitives)
EXPORTED = {
    f"{module.__name__}.{name}": getattr(module, name)
    for module in MODULES
    for name in module.__all__
    if name[:2] != "__"
}
CALLABLES = {
    f"{thing.__module__}.{thing.__qualname__}": thing
    for thing in EXPORTED.values()
    if inspect.isclass(thing) or inspect.isfunction(thing)
}


def functions(thing):
    """A function itself; of a class its constructor and its public methods, those it defines."""
    if inspect.isfunction(thing):
        return {thing.__name__: thing}
    found = {}
    for name, value in vars(thing).items():
        function = value.__func__ if isinstance(value, classmethod | staticmethod) else value
        function = function.fget if isinstance(function, property) else function
        if dataclasses.is_dataclass(thing) and name in {one.name for one in dataclasses.fields(thing)}:
            continue  # a function that is a default
        if inspect.isfunction(function) and (name == "__init__" or not name.startswith("_")):
            found[name] = function
    # The constructor of a dataclass is made of its fields, which the class describes; a protocol has none of its own.
    if dataclasses.is_dataclass(thing) or getattr(thing, "_is_protocol", False):
        found.pop("__init__", None)
    return found


def documented(function, thing):
    """A function's docstring; a constructor's is the class's and its own."""
    doc = inspect.getdoc(function) or ""
    return f"{inspect.getdoc(thing) or ''}\n{doc}" if function.__name__ == "__init__" else doc


def section(doc, name):
    """What a docstring has under a heading."""
    found = re.search(rf"^{name}:\n((?: .*\n?|\n)+)", doc, re.MULTILINE)
    return found[1] if found else ""


def arguments(function):
    return [name for name in inspect.signature(function).parameters if name not in ("self", "cls")]


def refuses(function):
    """Whether InputError is raised in its own body."""
    tree = ast.parse(textwrap.dedent(inspect.getsource(function)))
    raised = (node.exc for node in ast.walk(tree) if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call))
    return any(isinstance(one.func, ast.Name) and one.func.id == "InputError" for one in raised)


def entries(described):
    """Of each argument that a section lists, what it says."""
    found, names = {}, []
    for line in described.splitlines():
        entry = re.match(r"^    (\S[\w, /*]*):\s+(.*)$", line)
        if entry:
            names = [name.strip(" *") for name in re.split("[,/]", entry[1])]
        for name in names:
            found[name] = f"{found.get(name, '')} {entry[2] if entry else line.strip()}"
    return found


# (N,), (n, 6), (H+1, O, O) or (∗, 7); or the word.
SHAPE = re.compile(r"\((?:[\w ]|[+−∗·…()])+(?:, ?[^)]*|,)\)|\bshape")


def is_array(annotation):
    return bool(re.search("ndarray|ArrayLike", str(annotation))) and "Callable" not in str(annotation)


@pytest.mark.parametrize("thing", CALLABLES.values(), ids=CALLABLES)
def test_what_is_exported_says_what_shape_its_arrays_have(thing):
    said = []
    for name, function in functions(thing).items():
        doc, signature = documented(function, thing), inspect.signature(function)
        described = entries(section(doc, "Args") + section(doc, "Attributes"))
        for argument, parameter in signature.parameters.items():
            if is_array(parameter.annotation):
                said.append((f"{name}({argument})", described.get(argument, doc)))
        if is_array(signature.return_annotation):
            said.append((f"what {name} returns", doc))
    if dataclasses.is_dataclass(thing):
        doc = inspect.getdoc(thing)
        described = entries(section(doc, "Attributes") + section(doc, "Args"))
        said += [(one.name, described.get(one.name, "")) for one in dataclasses.fields(thing) if is_array(one.type)]
    missing = [name for name, words in said if not SHAPE.search(words)]
    assert not missing, f"{', '.join(missing)}: no shape is given"


@pytest.mark.parametrize("thing", CALLABLES.values(), ids=CALLABLES)
def test_what_is_exported_says_what_it_is_and_refuses(thing):
    assert (inspect.getdoc(thing) or "").strip()
    for name, function in functions(thing).items():
        doc = documented(function, thing)
        assert doc.strip(), f"{name} says nothing"
        if refuses(function):
            assert "InputError" in section(doc, "Raises"), f"{name} doesn't say when it raises InputError"


@pytest.mark.parametrize("thing", CALLABLES.values(), ids=CALLABLES)
def test_what_is_exported_says_what_it_takes(thing):
    if dataclasses.is_dataclass(thing):
        doc = inspect.getdoc(thing)
        described = section(doc, "Attributes") + section(doc, "Args")
        missing = [one.name for one in dataclasses.fields(thing) if not re.search(rf"\b{one.name}\b", described)]
        assert not missing, f"fields {', '.join(missing)} are not described"
        return
    constructor = functions(thing).get("__init__" if inspect.isclass(thing) else thing.__name__)
    if constructor is not None:
        described = section(documented(constructor, thing), "Args")
        missing = [name for name in arguments(constructor) if not re.search(rf"\b{name}\b", described)]
        assert not missing, f"arguments {', '.join(missing)} are not described"
