"""Docstrings of exported names describe arguments, array shapes and exceptions; they are the reference's source."""

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
    f"{exported.__module__}.{exported.__qualname__}": exported
    for exported in EXPORTED.values()
    if inspect.isclass(exported) or inspect.isfunction(exported)
}


def functions(exported):
    """Return a function by name, or the constructor and the public methods that a class defines."""
    if inspect.isfunction(exported):
        return {exported.__name__: exported}
    result = {}
    for name, value in vars(exported).items():
        function = value.__func__ if isinstance(value, classmethod | staticmethod) else value
        function = function.fget if isinstance(function, property) else function
        if dataclasses.is_dataclass(exported) and name in {field.name for field in dataclasses.fields(exported)}:
            continue  # a field whose default value is a function
        if inspect.isfunction(function) and (name == "__init__" or not name.startswith("_")):
            result[name] = function
    # The constructor of a dataclass takes its fields, which the class documents; a protocol has no constructor.
    if dataclasses.is_dataclass(exported) or getattr(exported, "_is_protocol", False):
        result.pop("__init__", None)
    return result


def docstring(function, exported):
    """Return the docstring of a function, preceded by the docstring of the class for a constructor."""
    doc = inspect.getdoc(function) or ""
    return f"{inspect.getdoc(exported) or ''}\n{doc}" if function.__name__ == "__init__" else doc


def section(doc, name):
    """Return the text of a section of a docstring."""
    result = re.search(rf"^{name}:\n((?: .*\n?|\n)+)", doc, re.MULTILINE)
    return result[1] if result else ""


def raises_input_error(function):
    """Return True if the body of the function has `raise InputError(...)`."""
    tree = ast.parse(textwrap.dedent(inspect.getsource(function)))
    calls = (node.exc for node in ast.walk(tree) if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call))
    return any(isinstance(call.func, ast.Name) and call.func.id == "InputError" for call in calls)


def entries(sections):
    """Return the description of each argument in sections of a docstring, by name."""
    result, names = {}, []
    for line in sections.splitlines():
        entry = re.match(r"^    (\S[\w, /*]*):\s+(.*)$", line)
        if entry:
            names = [name.strip(" *") for name in re.split("[,/]", entry[1])]
        for name in names:
            result[name] = f"{result.get(name, '')} {entry[2] if entry else line.strip()}"
    return result


# A shape such as (N,), (n, 6), (H+1, O, O) or (∗, 7), or the word "shape".
SHAPE = re.compile(r"\((?:[\w ]|[+−∗·…()])+(?:, ?[^)]*|,)\)|\bshape")


def is_array(annotation):
    return bool(re.search("ndarray|ArrayLike", str(annotation))) and "Callable" not in str(annotation)


@pytest.mark.parametrize("exported", CALLABLES.values(), ids=CALLABLES)
def test_exported_arrays_have_shapes(exported):
    descriptions = []
    for name, function in functions(exported).items():
        doc, signature = docstring(function, exported), inspect.signature(function)
        description_by_name = entries(section(doc, "Args") + section(doc, "Attributes"))
        for argument, parameter in signature.parameters.items():
            if is_array(parameter.annotation):
                descriptions.append((f"{name}({argument})", description_by_name.get(argument, doc)))
        if is_array(signature.return_annotation):
            descriptions.append((f"return value of {name}", doc))
    if dataclasses.is_dataclass(exported):
        doc = inspect.getdoc(exported)
        description_by_name = entries(section(doc, "Attributes") + section(doc, "Args"))
        arrays = [field.name for field in dataclasses.fields(exported) if is_array(field.type)]
        descriptions += [(name, description_by_name.get(name, "")) for name in arrays]
    missing = [name for name, description in descriptions if not SHAPE.search(description)]
    assert not missing, f"{', '.join(missing)}: the shape is not documented"


@pytest.mark.parametrize("exported", CALLABLES.values(), ids=CALLABLES)
def test_exported_names_have_docstrings_with_raises(exported):
    assert (inspect.getdoc(exported) or "").strip()
    for name, function in functions(exported).items():
        doc = docstring(function, exported)
        assert doc.strip(), f"{name} has no docstring"
        if raises_input_error(function):
            assert "InputError" in section(doc, "Raises"), f"{name} has no Raises section for InputError"


@pytest.mark.parametrize("exported", CALLABLES.values(), ids=CALLABLES)
def test_exported_arguments_are_described(exported):
    if dataclasses.is_dataclass(exported):
        doc = inspect.getdoc(exported)
        section_text = section(doc, "Attributes") + section(doc, "Args")
        names = [field.name for field in dataclasses.fields(exported)]
    else:
        function = functions(exported).get("__init__" if inspect.isclass(exported) else exported.__name__)
        section_text = section(docstring(function, exported), "Args") if function else ""
        names = [name for name in inspect.signature(function).parameters if name != "self"] if function else []
    missing = [name for name in names if not re.search(rf"\b{name}\b", section_text)]
    assert not missing, f"{', '.join(missing)}: not described"
