"""Docstrings of exported names: arguments, shapes and exceptions. The reference is generated from them."""

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
    """Return a function itself, or the constructor and the public methods that a class defines."""
    if inspect.isfunction(thing):
        return {thing.__name__: thing}
    result = {}
    for name, value in vars(thing).items():
        function = value.__func__ if isinstance(value, classmethod | staticmethod) else value
        function = function.fget if isinstance(function, property) else function
        if dataclasses.is_dataclass(thing) and name in {one.name for one in dataclasses.fields(thing)}:
            continue  # the default value is a function
        if inspect.isfunction(function) and (name == "__init__" or not name.startswith("_")):
            result[name] = function
    # The constructor of a dataclass takes its fields, which the class documents; a protocol has no constructor.
    if dataclasses.is_dataclass(thing) or getattr(thing, "_is_protocol", False):
        result.pop("__init__", None)
    return result


def documented(function, thing):
    """Return the docstring of a function; for a constructor together with that of its class."""
    doc = inspect.getdoc(function) or ""
    return f"{inspect.getdoc(thing) or ''}\n{doc}" if function.__name__ == "__init__" else doc


def section(doc, name):
    """Return the text of a section of a docstring."""
    result = re.search(rf"^{name}:\n((?: .*\n?|\n)+)", doc, re.MULTILINE)
    return result[1] if result else ""


def arguments(function):
    return [name for name in inspect.signature(function).parameters if name not in ("self", "cls")]


def refuses(function):
    """Return True if the function itself raises InputError."""
    tree = ast.parse(textwrap.dedent(inspect.getsource(function)))
    raised = (node.exc for node in ast.walk(tree) if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call))
    return any(isinstance(one.func, ast.Name) and one.func.id == "InputError" for one in raised)


def entries(described):
    """Return the description of each argument in a section."""
    result, names = {}, []
    for line in described.splitlines():
        entry = re.match(r"^    (\S[\w, /*]*):\s+(.*)$", line)
        if entry:
            names = [name.strip(" *") for name in re.split("[,/]", entry[1])]
        for name in names:
            result[name] = f"{result.get(name, '')} {entry[2] if entry else line.strip()}"
    return result


# (N,), (n, 6), (H+1, O, O) or (∗, 7), or the word "shape".
SHAPE = re.compile(r"\((?:[\w ]|[+−∗·…()])+(?:, ?[^)]*|,)\)|\bshape")


def is_array(annotation):
    return bool(re.search("ndarray|ArrayLike", str(annotation))) and "Callable" not in str(annotation)


@pytest.mark.parametrize("thing", CALLABLES.values(), ids=CALLABLES)
def test_exported_arrays_have_shapes(thing):
    descriptions = []
    for name, function in functions(thing).items():
        doc, signature = documented(function, thing), inspect.signature(function)
        described = entries(section(doc, "Args") + section(doc, "Attributes"))
        for argument, parameter in signature.parameters.items():
            if is_array(parameter.annotation):
                descriptions.append((f"{name}({argument})", described.get(argument, doc)))
        if is_array(signature.return_annotation):
            descriptions.append((f"return value of {name}", doc))
    if dataclasses.is_dataclass(thing):
        doc = inspect.getdoc(thing)
        described = entries(section(doc, "Attributes") + section(doc, "Args"))
        descriptions += [
            (one.name, described.get(one.name, "")) for one in dataclasses.fields(thing) if is_array(one.type)
        ]
    missing = [name for name, words in descriptions if not SHAPE.search(words)]
    assert not missing, f"{', '.join(missing)}: no shape is given"


@pytest.mark.parametrize("thing", CALLABLES.values(), ids=CALLABLES)
def test_exported_names_have_docstrings_with_raises(thing):
    assert (inspect.getdoc(thing) or "").strip()
    for name, function in functions(thing).items():
        doc = documented(function, thing)
        assert doc.strip(), f"{name} has no docstring"
        if refuses(function):
            assert "InputError" in section(doc, "Raises"), f"{name} has no Raises section for InputError"


@pytest.mark.parametrize("thing", CALLABLES.values(), ids=CALLABLES)
def test_exported_arguments_are_described(thing):
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
