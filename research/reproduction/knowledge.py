"""Counts of the prior knowledge in a template's file and in a hand-shaped reward function (table 3.3)."""

import ast
import inspect
import textwrap
from typing import Any

from guiderail.diagrams.tasks import pouring as task
from guiderail.models.templates import load_template

REWARD_CONSTANTS = ("TERMINAL", "APPROACH", "NEAR_BONUS", "TILT", "NEAR")  # constants of equations 3.5 to 3.10


def count_knowledge() -> dict[str, dict[str, int]]:
    """Return the numbers of parts of the template of pouring and of its hand-shaped reward function, by name."""
    template = load_template("pouring")
    states = template.states
    constants = [value for name in REWARD_CONSTANTS for value in _numbers(getattr(task, name))]
    return {
        "template": {
            "states": len(states),
            "input mappings": sum(len(state.input_mapping) for state in states),
            "active constraints": sum(len(state.active_constraints) for state in states),
            "transitions": sum(len(state.transitions) for state in states),
            "parameters": len(template.parameters),
        },
        "reward": {
            "terms": 4,
            "constants": len(constants),
            "cases": _branches(task._tilting) + 1,
        },
    }


def _numbers(value: Any) -> list[float]:
    return list(value.values()) if isinstance(value, dict) else [value]


def _branches(function: Any) -> int:
    """Return the number of conditional statements and expressions of a function."""
    tree = ast.parse(textwrap.dedent(inspect.getsource(function)))
    return sum(isinstance(node, ast.If | ast.IfExp) for node in ast.walk(tree))
