"""Reads a template from a YAML file, and says in one sentence what is wrong with one."""

import ast
import math
import operator
from collections.abc import Callable, Iterable, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from guiderail.models.common.errors import InputError, brief
from guiderail.models.common.yaml import load_yaml, parse_yaml
from guiderail.models.templates import constraints as active_constraints
from guiderail.models.templates import mappings as input_mappings
from guiderail.models.templates import transitions as transition_distances
from guiderail.models.templates.geometry import WORLD
from guiderail.models.templates.kinds import (
    ACTIVE_CONSTRAINTS,
    INPUT_MAPPINGS,
    TRANSITION_DISTANCES,
    build,
    did_you_mean,
)
from guiderail.models.templates.mappings import TOOL
from guiderail.models.templates.template import SharedControlTemplate, TemplateState, Transition

# Importing them is what registers the kinds.
KINDS = (active_constraints, input_mappings, transition_distances)

OPERATORS: dict[type, Callable[..., float]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.USub: operator.neg,
}
MOST_STATES = 30
MOST_PARTS = 30  # mappings, constraints or transitions of one state
LONGEST_EXPRESSION = 200  # characters
LARGEST_NUMBER = 1e6  # in any unit of a template: metres, degrees, radians, seconds
TEMPLATE_FIELDS = {
    "name",
    "inputs",
    "frames",
    "parameters",
    "initial_state",
    "max_speed_m_per_s",
    "max_speed_rad_per_s",
    "states",
}


def load_template(source: str | Path, **parameters: float) -> SharedControlTemplate:
    """Reads a template.

    Args:
        source: a file that ends in .yaml or .yml, or the name of one of guiderail's own templates: `pouring`,
            `pouring_aimed`, `grid_clamp` or `end_effector_velocity`.
        **parameters: sizes of the objects at hand, in place of the file's own values under `parameters`.

    Raises:
        InputError: if the file cannot be read, or what it says is not a template.
    """
    path = Path(source)
    if path.suffix not in (".yaml", ".yml"):
        files = _shipped_files()
        if str(source) not in files:
            raise InputError(f"There is no template {brief(str(source))}; {did_you_mean(str(source), files)}")
        path = files[str(source)]
        return _template(_shipped(path), path.name, parameters)
    return _template(load_yaml(path, "template"), path.name, parameters)


def shipped_templates() -> list[str]:
    """The names of guiderail's own templates."""
    return sorted(_shipped_files())


def _shipped_files() -> dict[str, Path]:
    """The files of the shipped templates by name; each is in the folder of its object."""
    return {file.stem: file for file in Path(__file__).parents[1].joinpath("objects").glob("*/*.yaml")}


@lru_cache
def _shipped(path: Path) -> Any:
    """What one of guiderail's own files says: environments are checked and made many times in a study."""
    return load_yaml(path, "template")


def parse_template(text: str, where: str = "template", **parameters: float) -> SharedControlTemplate:
    """Like load_template, from the YAML text itself; `where` names it in messages."""
    return _template(parse_yaml(text, where), where, parameters)


def _template(data: Any, where: str, parameters: Mapping[str, float]) -> SharedControlTemplate:
    data = _mapping(data, where, TEMPLATE_FIELDS, required=TEMPLATE_FIELDS - {"frames", "parameters", "initial_state"})
    number = _Numbers(_parameters(data.get("parameters", {}), parameters, where))

    frames = data.get("frames", [])
    if not isinstance(frames, list) or not all(map(_is_name, frames)) or len({*frames}) < len(frames):
        raise InputError(f"{where}: frames must be a list of different names, not {brief(frames)}.")
    for reserved in (WORLD, TOOL):
        if reserved in frames:
            raise InputError(f"{where}: {reserved} is always there; call that object's frame something else.")
    inputs = data["inputs"]
    if not isinstance(inputs, int) or isinstance(inputs, bool) or not 1 <= inputs <= 6:
        raise InputError(f"{where}: inputs must be a whole number from 1 to 6, not {brief(inputs)}.")
    states = data["states"]
    if not isinstance(states, dict) or not states:
        raise InputError(f"{where}: states must be a mapping from names to states, with at least one.")
    if len(states) > MOST_STATES:
        raise InputError(f"{where}: {len(states)} states are more than {MOST_STATES}; make two templates of it.")
    for name in states:
        if not _is_name(name):
            raise InputError(f"{where}: {brief(name)} can't name a state; take a short word.")
    initial = data.get("initial_state", next(iter(states)))
    if not isinstance(initial, str) or initial not in states:
        raise InputError(
            f"{where}: initial_state {brief(initial)} is not a state; {did_you_mean(str(initial), states)}"
        )
    if not _is_name(data["name"]):
        raise InputError(f"{where}: name must be a short text, not {brief(data['name'])}.")

    speeds = {key: number(data[key], f"{where}, {key}") for key in ("max_speed_m_per_s", "max_speed_rad_per_s")}
    for key, speed in speeds.items():
        if not speed > 0:
            raise InputError(f"{where}: {key} must be positive, not {speed}.")
    built = tuple(_state(name, state, f"{where}, state {name}", number) for name, state in states.items())
    template = SharedControlTemplate(
        name=data["name"],
        inputs=inputs,
        frames=tuple(frames),
        states=built,
        initial_state=list(states).index(initial),
        parameters=dict(number.names),
        **speeds,
    )
    _check_names(template, where)
    return template


class _Numbers:
    """Turns an entry of the file into a number: a literal, or arithmetic on the names of parameters."""

    def __init__(self, names: Mapping[str, float]):
        self.names = names

    def _unknown(self, name: str, where: str) -> InputError:
        return InputError(f"{where}: there is no parameter {brief(name)}; {did_you_mean(name, self.names)}")

    def __call__(self, entry: Any, where: str) -> float:
        try:
            value = self._value(entry, where)
        except (SyntaxError, ValueError, ArithmeticError, RecursionError, MemoryError) as error:
            if isinstance(error, InputError):
                raise
            raise InputError(f"{where}: {brief(entry)} is not arithmetic on the parameters; mend it.") from error
        if not math.isfinite(value):
            raise InputError(f"{where} must be a finite number, not {brief(entry)}.")
        if abs(value) > LARGEST_NUMBER:
            raise InputError(f"{where} must be at most a million, not {brief(entry)}; mind its unit.")
        return value

    def _value(self, entry: Any, where: str) -> float:
        if isinstance(entry, str):
            if len(entry) > LONGEST_EXPRESSION:
                raise InputError(f"{where}: {brief(entry)} is too long; make parts of it parameters.")
            return self._evaluate(ast.parse(entry.strip(), mode="eval").body, where)
        if isinstance(entry, int | float) and not isinstance(entry, bool):
            return float(entry)
        raise InputError(f"{where} must be a number, not {brief(entry)}.")

    def _evaluate(self, node: ast.expr, where: str) -> float:
        if isinstance(node, ast.Constant) and isinstance(node.value, int | float) and not isinstance(node.value, bool):
            return float(node.value)
        if isinstance(node, ast.Name):
            if node.id not in self.names:
                raise self._unknown(node.id, where)
            return self.names[node.id]
        if isinstance(node, ast.BinOp) and type(node.op) in OPERATORS:
            return OPERATORS[type(node.op)](self._evaluate(node.left, where), self._evaluate(node.right, where))
        if isinstance(node, ast.UnaryOp) and type(node.op) in OPERATORS:
            return OPERATORS[type(node.op)](self._evaluate(node.operand, where))
        raise InputError(f"{where}: {brief(ast.unparse(node))} is not a number; use parameters with + − * / only.")


class _OwnNumbers(_Numbers):
    """The same for the parameters themselves, none of which is made of others."""

    def __init__(self, declared: Iterable[Any]):
        super().__init__({})
        self._declared = [str(name) for name in declared]

    def _unknown(self, name: str, where: str) -> InputError:
        return InputError(
            f"{where}: {brief(name)} is no number, and no parameter ({', '.join(self._declared)}) is made of others."
        )


def _is_name(entry: Any) -> bool:
    """A text that can stand in a sentence and in a picture."""
    return isinstance(entry, str) and 0 < len(entry) <= 100 and entry.isprintable()


def _mapping(data: Any, where: str, known: set[str], required: set[str]) -> dict[str, Any]:
    if not isinstance(data, dict):
        raise InputError(f"{where} must be a mapping with {', '.join(sorted(required))}, not {brief(data)}.")
    for key in data:
        if key not in known:
            raise InputError(f"{where}: unknown field {brief(key)}; {did_you_mean(str(key), known)}")
    for key in sorted(required):
        if key not in data:
            raise InputError(f"{where}: {key} is missing; give it a value.")
    return data


def _parameters(defaults: Any, given: Mapping[str, float], where: str) -> dict[str, float]:
    if not isinstance(defaults, dict):
        raise InputError(f"{where}: parameters must be a mapping from names to numbers, not {brief(defaults)}.")
    plain = _OwnNumbers(defaults)
    for name in defaults:
        if not (_is_name(name) and name.isascii() and name.isidentifier()):
            raise InputError(f"{where}: {brief(name)} can't name a parameter; take letters, digits and underscores.")
    values = {name: plain(value, f"{where}, parameter {name}") for name, value in defaults.items()}
    for name, value in given.items():
        if name not in values:
            raise InputError(f"{where} has no parameter {brief(name)}; {did_you_mean(name, values)}")
        values[name] = plain(_plain(value), f"{where}, parameter {name}")
    return values


def _plain(value: Any) -> Any:
    """A number of NumPy's as one of Python's."""
    return value.item() if isinstance(value, np.generic) else value


def _state(name: str, data: Any, where: str, number: _Numbers) -> TemplateState:
    if not isinstance(data, dict) or "transition_distance" not in data:
        raise InputError(f"{where} must be a mapping with input_mapping, active_constraints and transition_distance.")
    distance = build(TRANSITION_DISTANCES, data["transition_distance"], f"{where}, transition_distance", number)
    unit = distance.unit
    start, end, weight = f"starts_at_{unit}", f"ends_at_{unit}", f"weight_per_{unit}"
    required = {"input_mapping", "active_constraints", "transition_distance", start}
    if not data.get("transitions"):
        required = required | {end}
    data = _mapping(data, where, required | {end, weight, "transitions"}, required)
    si = math.pi / 180 if unit == "deg" else 1.0

    def quantity(key: str) -> float:
        return si * number(data[key], f"{where}, {key}")

    transitions = tuple(
        _transition(entry, unit, si, f"{where}, transition {i + 1}", number)
        for i, entry in enumerate(_list(data, "transitions", where))
    )
    state = TemplateState(
        name=name,
        input_mapping=tuple(
            build(INPUT_MAPPINGS, entry, f"{where}, input_mapping {i + 1}", number)
            for i, entry in enumerate(_list(data, "input_mapping", where))
        ),
        active_constraints=tuple(
            build(ACTIVE_CONSTRAINTS, entry, f"{where}, active_constraint {i + 1}", number)
            for i, entry in enumerate(_list(data, "active_constraints", where))
        ),
        transition_distance=distance,
        starts_at=quantity(start),
        ends_at=quantity(end) if end in data else transitions[0].below,
        weight=number(data[weight], f"{where}, {weight}") / si if weight in data else 1.0,
        transitions=transitions,
    )
    if not state.starts_at > state.ends_at:
        raise InputError(f"{where}: {start} must be greater than where the phase ends; distances decrease.")
    if not state.weight > 0:
        raise InputError(f"{where}: {weight} must be positive.")
    return state


def _list(data: Mapping[str, Any], key: str, where: str) -> list:
    entries = data.get(key, [])
    if not isinstance(entries, list):
        raise InputError(f"{where}: {key} must be a list, not {brief(entries)}.")
    if len(entries) > MOST_PARTS:
        raise InputError(f"{where}: {len(entries)} {key} are more than {MOST_PARTS}; make two states of it.")
    return entries


def _transition(data: Any, unit: str, si: float, where: str, number: _Numbers) -> Transition:
    below, hysteresis = f"below_{unit}", f"hysteresis_{unit}"
    data = _mapping(data, where, {"to", below, hysteresis}, {"to", below})
    margin = si * number(data[hysteresis], f"{where}, {hysteresis}") if hysteresis in data else None
    if margin is not None and not margin > 0:
        raise InputError(f"{where}: {hysteresis} must be positive, or left out where there is no way back.")
    if not isinstance(data["to"], str):
        raise InputError(f"{where}: to must be the name of a state, not {brief(data['to'])}.")
    return Transition(data["to"], si * number(data[below], f"{where}, {below}"), margin)


def _check_names(template: SharedControlTemplate, where: str) -> None:
    """Refuses states, frames and inputs that are named but not there."""
    states = [state.name for state in template.states]
    for state in template.states:
        place = f"{where}, state {state.name}"
        for transition in state.transitions:
            if transition.to not in states:
                raise InputError(
                    f"{place}: there is no state {brief(transition.to)}; {did_you_mean(transition.to, states)}"
                )
        for frame in sorted(state.frame_names):
            if frame not in template.frames:
                known = (*template.frames, WORLD)
                raise InputError(f"{place}: there is no frame {brief(frame)}; {did_you_mean(frame, known)}")
        for mapping in state.input_mapping:
            for used in mapping.used_inputs:
                if not 0 <= used < template.inputs:
                    raise InputError(f"{place}: there is no input {used}; they are 0 to {template.inputs - 1}.")
