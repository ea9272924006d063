"""Option models of environments, guidance and resets: each option has a type, a range and a description.

`config.py` resolves them. `assemble.py` passes each guidance option to the argument of the same name, such as a field
of `PrimitiveConfig`, unless its `_CONVERTED_OPTIONS` says otherwise.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Hashable, Mapping
from dataclasses import fields
from typing import Annotated, Any, ClassVar, Literal, TypeVar, get_args

import numpy as np
from annotated_types import Len
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    ValidationError,
    ValidationInfo,
    field_validator,
)
from pydantic import Field as Field
from pydantic.fields import FieldInfo

from guiderail.models.common.errors import InputError, brief
from guiderail.models.common.registry import did_you_mean
from guiderail.models.primitives.kernels import DEFAULT_KERNEL, DEFAULT_LENGTH_SCALE, Kernel, make_kernel

STANDARD = "standard"
"""Default difficulty; every task has it."""


class Options(BaseModel):
    """Base class of option models: immutable; refuses undeclared names, NaN and infinite numbers.

    Attributes:
        entries: Names of the fields that are entries of a structured option, by field. The field `history_variance`
            with the name "history.variance" is the entry "variance" of the option `history`.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, arbitrary_types_allowed=True)
    entries: ClassVar[Mapping[str, str]] = {}

    @classmethod
    def diagram_key(cls, options: Mapping[str, Any]) -> Hashable:
        """Return a key that is equal for equal diagrams; a guidance extends it if values name entries that may change.

        Files that an option names are part of the key of every diagram.
        """
        return None


PRIMARY = {
    "base_policy": "policy",
    "gamma": "value",
    "history": "length",
    "kernel": "name",
    "net_arch": "units",
    "sensing": "profile",
}
"""Entry that a structured option sets if its value is no mapping: history=4 is history={length: 4}."""


def entries_of(option: str, *fields: str) -> dict[str, str]:
    """Return names of fields that are entries of a structured option, such as "sensing.tare" of the field `tare`."""
    return {field: f"{option}.{field}" for field in fields}


def option_fields(model: Any) -> dict[str, str]:
    """Return the fields of a model or a dataclass by the names of their options, such as "history.variance"."""
    entries = getattr(model, "entries", {})
    names = model.model_fields if hasattr(model, "model_fields") else (field.name for field in fields(model))
    return {entries.get(field, field): field for field in names}


def flat_options(options: Mapping[str, Any], plain: Collection[str] = ()) -> dict[str, Any]:
    """Return options with the entries of every structured option as options of their own.

    A mapping as the value of `history`, for example, becomes the options "history", "history.variance", …. Mappings of
    entries, such as "kernel.parameters", and of the options `plain` remain values.

    Raises:
        InputError: If an option is given both in a mapping and by its own name, with different values.
    """
    flat: dict[str, Any] = {}
    for name, value in options.items():
        entries = {name: value}
        if isinstance(value, Mapping) and "." not in str(name) and name not in plain:
            entries = {f"{name}.{entry}": content for entry, content in value.items()}
        for entry, content in entries.items():
            group, _, last = str(entry).partition(".")
            key = group if last and PRIMARY.get(group) == last else entry
            if key in flat and flat[key] != content:
                raise InputError(f"{key} is given as {brief(flat[key])} and as {brief(content)}: give it once")
            flat[key] = content
    return flat


def _split_list(value: Any) -> Any:
    """Return comma-separated text, an array or a single number as a list; return anything else unchanged."""
    if isinstance(value, str):
        return [part for part in value.split(",") if part.strip()]
    if isinstance(value, int | float | np.number) and not isinstance(value, bool):
        return [value]
    return value.tolist() if isinstance(value, np.ndarray) else value


def _reject_bool(value: Any) -> Any:
    """Convert NumPy numbers to Python numbers; raise a `ValueError` for a bool, which Python would accept as 0 or 1."""
    if isinstance(value, bool | np.bool_):
        raise ValueError("give a number")
    return value.item() if isinstance(value, np.number) else value


Integer = Annotated[int, BeforeValidator(_reject_bool)]
Number = Annotated[float, BeforeValidator(_reject_bool)]
Integers = Annotated[tuple[Integer, ...], BeforeValidator(_split_list)]


def satisfies(condition: Callable[[tuple[float, ...]], bool], remedy: str) -> AfterValidator:
    """Return a validator that refuses numbers that do not satisfy a condition; the message ends with the remedy."""

    def check(numbers: tuple[float, ...]) -> tuple[float, ...]:
        if not condition(numbers):
            raise ValueError(remedy)
        return numbers

    return AfterValidator(check)


def increases(lowest: float, highest: float, remedy: str) -> AfterValidator:
    """Return a validator that refuses a pair of numbers unless lowest ≤ first ≤ second ≤ highest; see `satisfies`."""
    return satisfies(lambda pair: lowest <= pair[0] <= pair[1] <= highest, remedy)


Numbers = Annotated[tuple[Number, ...], BeforeValidator(_split_list)]
Pair = Annotated[Numbers, Len(2, 2)]
PositiveNumbers = Annotated[
    Numbers, satisfies(lambda numbers: all(number > 0.0 for number in numbers), "give positive numbers")
]


class CommonOptions(Options):
    """Options of every environment. `EnvConfig.resolve` replaces an empty default by the task's own default."""

    guidance: str = Field("", description="guidance between the policy and the robot")
    station: str = Field("", description="name of the station, a simulated or a real robot")
    difficulty: str = Field(STANDARD, description="one of the difficulties that the task declares")
    action_repeat: Integer = Field(1, ge=1, description="control steps per action")
    control_period: Number | None = Field(
        None, ge=0.005, le=0.5, description="time between commands [s]; default: that of the task's station"
    )


def _only(name: str) -> AfterValidator:
    """Return a validator that accepts only `name`, for tasks that declare no choices."""

    def check(value: str) -> str:
        if value != name:
            raise ValueError(f"the task has only {name!r}")
        return value

    return AfterValidator(check)


class TaskOptions(Options):
    """Options of every task; a task with several rewards or observations declares their names as `Literal`."""

    reward: Annotated[str, _only("sparse")] = Field("sparse", description="name of the reward")
    observation: Annotated[str, _only("state")] = Field("state", description="name of the observation")


class PrimitiveOptions(Options):
    """Options of every guidance built from demonstrations; see `PrimitiveConfig`."""

    entries: ClassVar[Mapping[str, str]] = {
        "history_variance": "history.variance",
        "history_source": "history.source",
        "adaptive_history": "history.adaptive",
        "kernel_parameters": "kernel.parameters",
    }

    action_scale: Number = Field(
        1.0, gt=0, description="κ: a constant action of ±1 moves the outputs by √3 κ standard deviations"
    )
    action_dims: Integers | None = Field(
        None, description="indices of the outputs that an action moves; default: all", examples=[(0, 1)]
    )
    # The factorization of a step takes O(P² + H³) time. With the limits of P and H, the factorizations of a task with
    # six outputs take less than half a minute and 1 GB.
    history: Integer = Field(
        10, ge=1, le=200, description="P, number of past outputs that sKGRL's motion passes through"
    )
    history_variance: Number = Field(1e-6, gt=0, description="ρ [output²], variance of the past outputs")
    history_source: Literal["commanded", "measured"] = Field("commanded", description="poses that form the history")
    adaptive_history: bool = Field(False, description="shorten the history during contact")
    gains: Numbers | None = Field(
        None,
        description="null-space action per unit of the policy's action, for each output; default: computed from κ",
    )
    horizon: Integer = Field(40, ge=0, le=200, description="H, number of future points with constraints")
    lambda_: Number = Field(6.0, ge=0, description="λ, regularization in the thesis's problem 4.5")
    beta: Number = Field(6.0, gt=0, description="β, weight of a null-space action in the thesis's problem 4.5")
    kernel: str = Field(DEFAULT_KERNEL, description="name of a registered kernel k(ζ, ζ')")
    length_scale: Number = Field(
        DEFAULT_LENGTH_SCALE, gt=0, description="ℓ of the kernel [s]; the thesis's l is 1 / (2 ℓ²)"
    )
    kernel_parameters: dict[str, Number] = Field(
        {}, validate_default=True, description="further parameters of a kernel that has more than a length scale"
    )
    via_points: Numbers = Field(
        (), description="via-points of the mean, one after another: control step and all outputs of each via-point"
    )
    max_speed: PositiveNumbers = Field(
        (),
        description="largest speed of the command: one number for positions [m/s], two for positions and angles "
        "[rad/s], or one for each output",
    )
    max_acceleration: PositiveNumbers = Field((), description="largest acceleration of the command, like max_speed")
    joint_margin: Number | None = Field(
        None,
        ge=0,
        le=1,
        description="smallest distance of an arm's commanded joint positions from their limits [rad]; default: no "
        "constraint",
    )
    progress: Literal["clock", "state"] = Field(
        "clock", description="clock: the motion advances with time; state: the motion waits for a robot that lags"
    )

    @field_validator("kernel_parameters")
    @classmethod
    def _check_kernel(cls, parameters: dict[str, float], info: ValidationInfo) -> dict[str, float]:
        if all(name in info.data for name in ("kernel", "length_scale")):
            make_kernel(info.data["kernel"], info.data["length_scale"], parameters)
        return parameters


KERNEL_OPTIONS = {"kernel": DEFAULT_KERNEL, "length_scale": DEFAULT_LENGTH_SCALE, "kernel.parameters": None}
"""Options of the kernel, with their defaults."""


def kernel_from_options(options: Mapping[str, Any]) -> Kernel:
    """Build the kernel given by `KERNEL_OPTIONS`; a missing option has its default.

    Raises:
        InputError: As `make_kernel`.
    """
    return make_kernel(*(options.get(name, default) for name, default in KERNEL_OPTIONS.items()))


class TemplateOptions(Options):
    """Options of every guidance built from a shared control template."""

    active_constraints: bool | None = Field(
        None,
        description="keep commands inside the template's active constraints; default: true, but false with guidance "
        "none",
    )


class ResetOptions(Options):
    """Options of every reset."""

    held_out: bool = Field(
        False,
        description="sample held-out conditions with random numbers that training never uses; their range is that of "
        "training, unless the task defines another range",
    )


Model = TypeVar("Model", bound=BaseModel)


def validate_options(model: type[Model], values: Mapping[str, Any], context: str) -> Model:
    """Validate and convert options by their model; `context` is the subject of an error message.

    Raises:
        InputError: If a name is unknown, or a value has the wrong type or is out of range.
    """
    fields = option_fields(model)
    unknown = [name for name in values if name not in fields]
    if unknown:
        raise InputError(f"{context} has no option {brief(unknown[0])}: {did_you_mean(unknown[0], fields)}")
    try:
        return model(**{fields[name]: value for name, value in values.items()})
    except ValidationError as error:
        raise InputError(_format_error(model, error.errors()[0], values, context)) from None


def validate_tree(models: Mapping[str, type[Options]], values: Mapping[str, Any], context: str) -> dict[str, Options]:
    """Validate and convert the options of all parts, in the order of `models`; see `validate_options`.

    Args:
        models: Model of each part. A part takes the values whose names it declares.
        values: Options by name, in which no entry of a structured option is in a mapping; see `flat_options`.
        context: Subject of an error message.

    Raises:
        InputError: If a value has the wrong type or is out of range.
    """
    return {
        part: validate_options(model, {name: values[name] for name in option_fields(model) if name in values}, context)
        for part, model in models.items()
    }


def check_choice(name: str, value: Any, choices: list[str], context: str) -> str:
    """Return `value`; raise an InputError if it is not one of `choices`."""
    if value not in choices:
        raise InputError(f"{context} has no {name} {brief(value)}: {did_you_mean(value, choices)}")
    return str(value)


def choices_of(model: type[BaseModel], name: str) -> tuple[str, ...]:
    """Return the values of a field of text: those of its `Literal`, otherwise its default only."""
    field = model.model_fields[name]
    return tuple(get_args(field.annotation)) or (field.default,)


def describe_options(model: type[BaseModel] | None) -> list[dict[str, Any]]:
    """Return a row for each option of a model: name, type, default, choices, range and description."""
    if model is None:
        return []
    properties = model.model_json_schema()["properties"]
    rows = []
    for name, key in option_fields(model).items():
        field, schema = model.model_fields[key], properties[key]
        bounds = {
            key: schema[key] for key in ("minimum", "maximum", "exclusiveMinimum", "exclusiveMaximum") if key in schema
        }
        kinds = [schema] if "type" in schema or "enum" in schema else schema.get("anyOf", [])
        row = {
            "name": name,
            "type": " or ".join(str(kind.get("type", "any")) for kind in kinds),
            "default": field.default,
        }
        choices = schema.get("enum")
        rows.append(row | ({"choices": choices} if choices else {}) | bounds | {"description": field.description or ""})
    return rows


_NUMBER_ERRORS = dict.fromkeys(("int_type", "int_parsing", "int_from_float"), "whole number")
_NUMBER_ERRORS |= dict.fromkeys(("float_type", "float_parsing"), "number")


def _format_error(model: type[BaseModel], error: Any, values: Mapping[str, Any], subject: str) -> str:
    """Convert a pydantic error to a sentence that names the option and the remedy."""
    kind, context = error["type"], error.get("ctx", {})
    if isinstance(context.get("error"), InputError):
        return str(context["error"])
    name, field, value = _locate(model, error["loc"], values)
    name = name or subject
    if kind == "missing":
        return f"{name} is missing: give it"
    if kind == "extra_forbidden":
        known = model.model_fields if field is None else _models_of(field)[0].model_fields
        return f"{name} has no option {brief(error['loc'][-1])}: {did_you_mean(error['loc'][-1], known)}"
    if kind == "literal_error":
        choices = [word.strip().strip("'") for word in context["expected"].replace(" or ", ", ").split(",")]
        return f"there is no {name} {brief(value)}: {did_you_mean(value, choices)}"
    bounds = {"greater_than": "more than", "greater_than_equal": "at least", "less_than": "less than"}
    bounds["less_than_equal"] = "at most"
    if kind in bounds:
        (bound,) = context.values()
        return f"{name} must be {bounds[kind]} {bound:g}, not {brief(value)}"
    examples = ("tuple_type", "too_short", "too_long", *_NUMBER_ERRORS)
    if field is not None and kind in examples and (example := _example(field)):
        return f"{name} must be {example}, not {brief(value)}"
    if kind in _NUMBER_ERRORS:
        return f"{name} must be a {_NUMBER_ERRORS[kind]}, not {brief(value)}"
    message = str(error["msg"]).removeprefix("Value error, ")
    return f"{name} cannot be {brief(value)}: {message[:1].lower()}{message[1:]}"


def _locate(
    model: type[BaseModel], location: tuple[int | str, ...], values: Mapping[str, Any]
) -> tuple[str, FieldInfo | None, Any]:
    """Return the path, field and value of the innermost option at the location of a pydantic error.

    A path is, for example, motion.push. An index into a list of option models is part of the path, as in
    plug.pieces[0].friction; an index into a list of numbers is not. For an error of the whole model, the path is empty
    and the field is None.
    """
    name, field, models = "", None, [model]
    value: Any = values
    for part in location:
        if isinstance(part, int) and models:
            name, value = f"{name}[{part}]", value[part]
        elif models and part in models[0].model_fields:
            field, option = models[0].model_fields[str(part)], getattr(models[0], "entries", {}).get(part, part)
            value = value.get(option) if isinstance(value, Mapping) else getattr(value, str(part), None)
            name, models = f"{name}.{option}" if name else str(option), _models_of(field)
        else:
            break
    return name, field, value


def _models_of(field: FieldInfo) -> list[type[BaseModel]]:
    """Return the option models that are the type of a field or of its entries; empty for any other field."""
    annotations = (field.annotation, *get_args(field.annotation))
    return [each for each in annotations if isinstance(each, type) and issubclass(each, BaseModel)]


def _example(field: FieldInfo) -> str:
    """Return the number of entries of a field of numbers as text, with an example; "" for any other field."""
    annotations = repr(field.annotation)
    if "tuple" not in annotations or ("float" not in annotations and "int" not in annotations):
        return ""
    of_parts = (item for part in get_args(field.annotation) for item in getattr(part, "__metadata__", ()))
    lengths = {getattr(item, "min_length", None) for item in (*field.metadata, *of_parts)}
    (number,) = (lengths - {None}) or {0}
    default = () if field.is_required() else field.default
    example = (field.examples or [default or tuple(0.001 * (index + 1) for index in range(number or 2))])[0]
    return f"{number or 'several'} numbers, such as {','.join(f'{entry:g}' for entry in example)}"
