"""Options of environments and resets: declared with their type and range, and refused in a sentence."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError

from guiderail.models.common.errors import InputError, brief
from guiderail.models.common.registry import did_you_mean

STANDARD = "standard"
"""The difficulty of every task unless another one is asked for."""


class Options(BaseModel):
    """Options by name; what is not declared is refused, and so is a number that is none."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, arbitrary_types_allowed=True)


def _listed(value: Any) -> Any:
    """What a shell or an array gives for several numbers, as a list."""
    if isinstance(value, str):
        return [part for part in value.split(",") if part.strip()]
    return value.tolist() if isinstance(value, np.ndarray) else value


def _no_truth(value: Any) -> Any:
    """True is no number."""
    if isinstance(value, bool | np.bool_):
        raise ValueError("it is a number")
    return value.item() if isinstance(value, np.number) else value


Integer = Annotated[int, BeforeValidator(_no_truth)]
Number = Annotated[float, BeforeValidator(_no_truth)]
Integers = Annotated[tuple[Integer, ...], BeforeValidator(_listed)]
Numbers = Annotated[tuple[Number, ...], BeforeValidator(_listed)]


class PrimitiveOptions(Options):
    """Of every guidance made of demonstrations; see `PrimitiveConfig`."""

    action_scale: Number = Field(1.0, gt=0, description="κ: a constant action of ±1 ends √3 κ standard deviations away")
    action_dims: Integers | None = Field(
        None, description="the outputs that an action moves, by number; none named: all"
    )
    history: Integer = Field(10, ge=1, le=1000, description="P, past outputs that sKGRL's motion passes through")
    history_variance: Number = Field(1e-6, gt=0, description="ρ [output²], how exactly it does")
    history_source: Literal["commanded", "measured"] = Field("commanded", description="what counts as the past")
    adaptive_history: bool = Field(False, description="whether the history shrinks in contact")
    gains: Numbers | None = Field(None, description="raw null-space units per action, instead of those from κ")
    horizon: Integer = Field(40, ge=0, le=1000, description="H, future points at which constraints are kept")
    lambda_: Number = Field(6.0, ge=0, description="λ of problem 4.5")
    beta: Number = Field(6.0, gt=0, description="β of problem 4.5")
    inverse_length: Number = Field(2.0, gt=0, description="of the kernel")
    via_points: Numbers = Field(
        (), description="what the mean passes through: a control step and an output each, one after another"
    )
    solver: Literal["daqp", "osqp", "piqp"] = Field("daqp", description="of the constrained primitive's QP")


class TemplateOptions(Options):
    """Of every guidance made of a shared control template."""

    active_constraints: bool | None = Field(
        None, description="whether commands stay inside the template's active constraints; with sct only unless given"
    )


class ResetOptions(Options):
    """Of every reset."""

    held_out: bool = Field(False, description="draw from conditions that training never draws")


Model = TypeVar("Model", bound=BaseModel)


def validated(model: type[Model], values: Mapping[str, Any], whose: str) -> Model:
    """The options of a model, checked and converted.

    Raises:
        InputError: for an unknown name, a value of another kind or one out of range.
    """
    unknown = [name for name in values if name not in model.model_fields]
    if unknown:
        raise InputError(f"{whose} has no option {brief(unknown[0])}: {did_you_mean(unknown[0], model.model_fields)}")
    try:
        return model(**values)
    except ValidationError as error:
        raise InputError(_sentence(error.errors()[0], values)) from None


def choose(name: str, value: Any, choices: list[str], whose: str) -> str:
    """One of several words.

    Raises:
        InputError: if it is none of them.
    """
    if value not in choices:
        raise InputError(f"{whose} has no {name} {brief(value)}: {did_you_mean(value, choices)}")
    return str(value)


def described(model: type[BaseModel] | None) -> list[dict[str, Any]]:
    """The options of a model for a list: name, type, default, range and words."""
    if model is None:
        return []
    properties = model.model_json_schema()["properties"]
    rows = []
    for name, field in model.model_fields.items():
        schema = properties[name]
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


def _sentence(error: Any, values: Mapping[str, Any]) -> str:
    """What pydantic found, in a sentence that names the option and the remedy."""
    name = str(error["loc"][0])
    value, kind, context = values.get(name), error["type"], error.get("ctx", {})
    if kind == "literal_error":
        choices = [word.strip().strip("'") for word in context["expected"].replace(" or ", ", ").split(",")]
        return f"there is no {name} {brief(value)}: {did_you_mean(value, choices)}"
    bounds = {"greater_than": "more than", "greater_than_equal": "at least", "less_than": "less than"}
    bounds["less_than_equal"] = "at most"
    if kind in bounds:
        (bound,) = context.values()
        return f"{name} must be {bounds[kind]} {bound:g}, not {brief(value)}"
    message = str(error["msg"]).removeprefix("Value error, ")
    return f"{name} cannot be {brief(value)}: {message[:1].lower()}{message[1:]}"
