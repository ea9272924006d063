"""Reader of shared control templates from YAML files; a faulty file raises an InputError with one sentence."""

import ast
import dataclasses
import math
import operator
import re
from collections.abc import Callable, Iterable, Mapping
from functools import lru_cache, partial
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import numpy as np
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    Field,
    PlainValidator,
    StrictBool,
    StrictInt,
    TypeAdapter,
    ValidationError,
    ValidationInfo,
    create_model,
    field_validator,
    model_validator,
)

from guiderail.models.common.errors import InputError, brief
from guiderail.models.common.registry import did_you_mean
from guiderail.models.common.yaml import load_yaml, parse_yaml
from guiderail.models.templates.active_constraints import ActiveConstraint
from guiderail.models.templates.mappings import TOOL, InputMapping
from guiderail.models.templates.parts import ACTIVE_CONSTRAINTS, INPUT_MAPPINGS, TRANSITION_DISTANCES, WORLD
from guiderail.models.templates.template import SharedControlTemplate, TemplateState, Transition
from guiderail.models.templates.transitions import TransitionDistance

MAX_STATES = 30
MAX_PARTS = 30  # largest number of mappings, of constraints and of transitions of one state
MAX_EXPRESSION = 200  # largest length of an expression [characters]
MAX_NUMBER = 1e6  # largest magnitude of a number, in any unit of a template

_OPERATORS: dict[type, Callable[..., float]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.USub: operator.neg,
}


def load_template(source: str | Path, **parameters: float) -> SharedControlTemplate:
    """Read a template from a file.

    The content of the file is checked, but it is not checked that constraints and transitions can be satisfied. For
    that, guidance refuses constraints that are proven to contradict each other, and `guiderail template validate`
    checks transitions at random poses.

    Args:
        source: Path of a .yaml or .yml file, or the name of a shipped template: `pouring`, `pouring_aimed`,
            `pouring_shielded`, `grid_clamp` or `end_effector_velocity`.
        **parameters: Values, such as sizes of objects, that replace the values under `parameters` in the file.

    Raises:
        InputError: If the file cannot be read or is not a valid template.
    """
    path = Path(source)
    if path.suffix in (".yaml", ".yml"):
        return _read(load_yaml(path, "template"), path.name, parameters)
    files = _shipped_files()
    if str(source) not in files:
        raise InputError(f"There is no template {brief(str(source))}: {did_you_mean(str(source), files)}")
    path = files[str(source)]
    return _read(_load_shipped(path, "template"), path.name, parameters)


def parse_template(text: str, where: str = "template", **parameters: float) -> SharedControlTemplate:
    """Read a template from YAML text.

    Args:
        text: Content of a template file.
        where: Name of the text, for messages.
        **parameters: As in `load_template`.
    """
    return _read(parse_yaml(text, where), where, parameters)


def shipped_templates() -> list[str]:
    """Return the names of the shipped templates, sorted."""
    return sorted(_shipped_files())


def _shipped_files() -> dict[str, Path]:
    """Return the files of the shipped templates by name; each file is in the folder of its object."""
    return {file.stem: file for file in Path(__file__).parents[1].joinpath("objects").glob("*/*.yaml")}


_load_shipped = lru_cache(load_yaml)  # cached, because a study constructs many environments


def _calculate(node: ast.expr, parameters: Mapping[str, float] | None) -> float:
    """Return the value of an arithmetic expression of numbers and names of parameters.

    If `parameters` is None, names are not allowed.
    """
    if isinstance(node, ast.Constant) and type(node.value) in (int, float):
        return float(node.value)  # type: ignore[arg-type]
    if isinstance(node, ast.Name):
        if parameters is None:
            raise InputError(f"{brief(node.id)} is not a number, and a parameter can't be computed from others")
        _check_known("there is no parameter", node.id, parameters)
        return parameters[node.id]
    if isinstance(node, ast.BinOp) and type(node.op) in _OPERATORS:
        return _OPERATORS[type(node.op)](_calculate(node.left, parameters), _calculate(node.right, parameters))
    if isinstance(node, ast.UnaryOp) and type(node.op) in _OPERATORS:
        return _OPERATORS[type(node.op)](_calculate(node.operand, parameters))
    raise InputError(f"{brief(ast.unparse(node))} is not a number; use parameters with + − * / only")


def _check_known(message: str, name: str, known: Iterable[str]) -> None:
    if name not in known:
        raise InputError(f"{message} {brief(name)}: {did_you_mean(name, known)}")


def _read_number(entry: Any, info: ValidationInfo) -> float:
    """Return the value of a number or of an expression; `info.context` contains the parameters."""
    context: Any = info.context
    entry = entry.item() if isinstance(entry, np.generic) else entry
    if type(entry) not in (str, int, float):
        raise ValueError(f"must be a number, not {brief(entry)}")
    if isinstance(entry, str) and len(entry) > MAX_EXPRESSION:
        raise ValueError(f"{brief(entry)} is too long; make parts of it parameters")
    try:
        parsed = ast.parse(entry.strip(), mode="eval").body if isinstance(entry, str) else ast.Constant(entry)
        value = _calculate(parsed, context["parameters"])
    except InputError:
        raise
    except (SyntaxError, ValueError, ArithmeticError, RecursionError, MemoryError) as error:
        raise ValueError(f"{brief(entry)} is not arithmetic on the parameters; correct it") from error
    if not math.isfinite(value):
        raise ValueError(f"must be a finite number, not {brief(entry)}")
    if abs(value) > MAX_NUMBER:
        raise ValueError(f"must be at most a million in magnitude, not {brief(entry)}; check its unit")
    return value


def _check_name(text: str) -> str:
    """Return a name; raise a ValueError if it is empty, too long for a figure, or not printable."""
    if not (0 < len(text) <= 100 and text.isprintable()):
        raise ValueError(f"{brief(text)} can't name anything; use a short text")
    return text


def _check_parameter_name(text: str) -> str:
    """Return the name of a parameter; raise a ValueError if it cannot occur in an expression."""
    if not re.fullmatch("[A-Za-z_][A-Za-z0-9_]{0,99}", text):
        raise ValueError(f"{brief(text)} can't name a parameter; use letters from a to z, digits and _, a letter first")
    return text


def _build_part(entry: Any, info: ValidationInfo, registry: dict[str, type]) -> Any:
    """Build a mapping, constraint or distance from an entry with a `kind` and the fields of this kind."""
    return _union(tuple(registry.items())).validate_python(entry, context=info.context)


Number = Annotated[float, BeforeValidator(_read_number)]
Positive = Annotated[Number, Field(gt=0)]
Name = Annotated[str, AfterValidator(_check_name)]
ParameterName = Annotated[str, AfterValidator(_check_parameter_name)]
AnyMapping = Annotated[InputMapping, PlainValidator(partial(_build_part, registry=INPUT_MAPPINGS))]
AnyConstraint = Annotated[ActiveConstraint, PlainValidator(partial(_build_part, registry=ACTIVE_CONSTRAINTS))]
AnyDistance = Annotated[TransitionDistance, PlainValidator(partial(_build_part, registry=TRANSITION_DISTANCES))]
FIELD_TYPES = {
    float: Number, int: StrictInt, bool: StrictBool, str: str,
    InputMapping: AnyMapping, ActiveConstraint: AnyConstraint, TransitionDistance: AnyDistance,
}  # fmt: skip


class _Entry(BaseModel):
    """Base class of the entries of a template file; the error for an unknown field suggests a similar known field."""

    @model_validator(mode="before")
    @classmethod
    def _refuse_unknown(cls, data: Any) -> Any:
        known = [field.alias or name for name, field in cls.model_fields.items()]
        for key in data if isinstance(data, dict) else ():
            _check_known("there is no field", key, known)
        return data

    def build(self, kind: type, **fields: Any) -> Any:
        """Return an instance of the dataclass `kind` with the fields in the file and the further `fields`."""
        return kind(**{key: getattr(self, key) for key in self.model_fields_set - {"kind"}}, **fields)


@lru_cache
def _union(kinds: tuple[tuple[str, type], ...]) -> TypeAdapter[Any]:
    """Return the discriminated union of registered kinds, cached until another kind is registered."""
    models: Any = tuple(_kind_model(name, kind) for name, kind in kinds)
    return TypeAdapter(Annotated[Union[models], Field(discriminator="kind")])  # noqa: UP007  (of a tuple)


def _kind_model(name: str, kind: type) -> Any:
    """Return the type that validates an entry of a kind and converts it to an instance of the kind."""
    hints, types = get_type_hints(kind), {}
    for field in dataclasses.fields(kind):
        is_required = field.default is field.default_factory is dataclasses.MISSING
        types[field.name] = (_field_type(hints[field.name]), ... if is_required else None)
    model: Any = create_model(kind.__name__, __base__=_Entry, kind=(Literal[name], ...), **types)  # type: ignore
    return Annotated[model, AfterValidator(lambda entry: entry.build(kind))]


def _field_type(hint: Any) -> Any:
    """Return the type that reads a field of a kind: expressions for floats, no conversion for other types."""
    if get_origin(hint) is tuple:
        element: Any = _field_type(get_args(hint)[0])
        return tuple[element, ...]
    return FIELD_TYPES.get(hint, hint)


_UNLIMITED: Any = Field(None)


class _State(_Entry):
    """State without the fields whose names end in the unit of its transition distance."""

    transition_distance: AnyDistance
    input_mapping: tuple[AnyMapping, ...] = Field(max_length=MAX_PARTS)
    active_constraints: tuple[AnyConstraint, ...] = Field(max_length=MAX_PARTS)
    max_force_n: Positive = _UNLIMITED
    max_torque_nm: Positive = _UNLIMITED
    max_speed_m_per_s: Positive = _UNLIMITED
    max_speed_rad_per_s: Positive = _UNLIMITED


@lru_cache
def _state_model(unit: str) -> Any:
    """Return the type of a state whose transition distance has the unit "m" or "deg"; values are converted to SI."""
    si = math.pi / 180 if unit == "deg" else 1.0
    number: Any = Annotated[Number, AfterValidator(lambda value: si * value)]
    margin: Any = Annotated[Positive, AfterValidator(lambda value: si * value)]
    weight: Any = Annotated[Positive, AfterValidator(lambda value: value / si)]
    model: Any = create_model(
        "Transition",
        __base__=_Entry,
        to=(str, ...),
        below=(number, Field(alias=f"below_{unit}")),
        hysteresis=(margin, Field(None, alias=f"hysteresis_{unit}")),
    )
    transition: Any = Annotated[model, AfterValidator(lambda entry: entry.build(Transition))]
    return create_model(
        "State",
        __base__=_State,
        starts_at=(number, Field(alias=f"starts_at_{unit}")),
        ends_at=(number, Field(None, alias=f"ends_at_{unit}")),
        weight=(weight, Field(None, alias=f"weight_per_{unit}")),
        transitions=(tuple[transition, ...], Field((), max_length=MAX_PARTS)),
    )


class _StateDistance(BaseModel):
    """Transition distance of a state, which determines the unit of other fields."""

    transition_distance: AnyDistance


def _read_state(entry: Any, info: ValidationInfo) -> Any:
    unit = _StateDistance.model_validate(entry, context=info.context).transition_distance.unit
    state = _state_model(unit).model_validate(entry, context=info.context)
    if state.ends_at is None and not state.transitions:
        raise ValueError(f"ends_at_{unit} is missing; give it a value")
    can_be_negative = state.transition_distance.can_be_negative
    if any(transition.below <= 0.0 and not can_be_negative for transition in state.transitions):
        raise ValueError(f"below_{unit} must be positive, because this transition distance is never negative")
    state.ends_at = state.transitions[0].below if state.ends_at is None else state.ends_at
    if not state.starts_at > state.ends_at:
        raise ValueError(f"starts_at_{unit} must exceed the distance at the phase's end, because distances decrease")
    return state


class TemplateFile(_Entry):
    """Content of a template file."""

    # This field must be first, because the expressions in the other fields need the values of the parameters.
    parameters: dict[ParameterName, Number] = Field({}, validate_default=True)
    name: Name
    inputs: StrictInt = Field(ge=1, le=6)
    frames: tuple[Name, ...] = ()
    max_speed_m_per_s: Positive
    max_speed_rad_per_s: Positive
    states: dict[Name, Annotated[Any, PlainValidator(_read_state)]] = Field(min_length=1, max_length=MAX_STATES)
    initial_state: str | None = None

    @field_validator("parameters")
    @classmethod
    def _replace_defaults(cls, declared: dict[str, float], info: ValidationInfo) -> dict[str, float]:
        context: Any = info.context
        for name in context["overrides"]:
            _check_known("there is no parameter", name, declared)
        overrides = TypeAdapter(dict[str, Number]).validate_python(context["overrides"], context=context)
        context["parameters"] = declared | overrides
        return declared | overrides

    @field_validator("frames")
    @classmethod
    def _check_frames(cls, frames: tuple[str, ...]) -> tuple[str, ...]:
        if len({*frames, WORLD, TOOL}) < len(frames) + 2:
            raise ValueError(f"frames need different names, and {WORLD} and {TOOL} exist already")
        return frames


def _read(data: Any, where: str, overrides: Mapping[str, float]) -> SharedControlTemplate:
    """Build a template from the content of its file."""
    try:
        file = TemplateFile.model_validate(data, context={"overrides": overrides, "parameters": None})
        states = tuple(state.build(TemplateState, name=name) for name, state in file.states.items())
        first = states[0].name if file.initial_state is None else file.initial_state
        _check_known("initial_state: there is no state", first, file.states)
        initial = list(file.states).index(first)
        template = SharedControlTemplate(**{**dict(file), "states": states, "initial_state": initial})
        for state in states:
            _check_references(template, state)
    except ValidationError as error:
        raise InputError(f"{where}: {_describe_error(error)}") from None
    except InputError as error:
        raise InputError(f"{where}: {error}") from None
    return template


def _check_references(template: SharedControlTemplate, state: TemplateState) -> None:
    """Raise an InputError if a state uses an unknown name, or has a higher speed limit than the template."""
    for name in ("max_speed_m_per_s", "max_speed_rad_per_s"):
        speed, largest = getattr(state, name), getattr(template, name)
        if speed is not None and speed > largest:
            raise InputError(f"states.{state.name}.{name} must be at most the template's, {largest:g}, not {speed:g}")
    for transition in state.transitions:
        names = [candidate.name for candidate in template.states]
        _check_known(f"states.{state.name}: there is no state", transition.to, names)
        if transition.to == state.name:
            raise InputError(
                f"states.{state.name}: a transition must lead to another state, not to {state.name} itself"
            )
    for frame in sorted(state.frame_names):
        _check_known(f"states.{state.name}: there is no frame", frame, [*template.frames, WORLD])
    for used in (used for mapping in state.input_mapping for used in mapping.used_inputs):
        if not 0 <= used < template.inputs:
            raise InputError(
                f"states.{state.name}: there is no input {brief(used)}; they are 0 to {template.inputs - 1}"
            )


def _describe_error(error: ValidationError) -> str:
    """Return the first error and its place in the file as a sentence."""
    first: Any = error.errors()[0]
    location = first["loc"][:-2] if first["loc"][-1:] == ("[key]",) else first["loc"]  # the message names the key
    names = (key if isinstance(key, int) or key.isidentifier() else brief(key) for key in location)
    place = "".join(f"[{name}]" if isinstance(name, int) else f".{name:.60}" for name in names)
    place = place.lstrip(".") or "the file"
    if first["type"] == "value_error":
        return f"{place}: {first['ctx']['error']}"
    if first["type"] == "missing":
        return f"{place} is missing; give it a value"
    if first["type"] == "union_tag_not_found" or (tag := first.get("ctx", {}).get("tag")) == "None":
        return f"{place} has no kind; give it one"
    if first["type"] == "union_tag_invalid":
        known = [tag.strip(" '") for tag in first["ctx"]["expected_tags"].split(",")]
        return f"{place}: unknown kind {brief(tag)}: {did_you_mean(tag, known)}"
    message = re.sub(r"valid dictionary.*", "mapping", first["msg"]).replace("tuple", "list").replace("Tuple", "List")
    if message.startswith("Input "):
        return f"{place} {message.removeprefix('Input ')}, not {brief(first['input'])}"
    return f"{place}: {message[0].lower()}{message[1:]}"
