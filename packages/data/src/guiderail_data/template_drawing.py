"""Drawings of a shared control template's state machine, as Graphviz text or as a picture."""

import io
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.figure import Figure

from guiderail.models.common.errors import InputError
from guiderail.models.common.files import write_atomically
from guiderail.models.templates.template import SharedControlTemplate, TemplateState


def state_lines(state: TemplateState) -> list[str]:
    """Return a description of a state in short lines: mappings, constraints, limits and transition distance."""
    mappings = [f"{type(m).__name__} ← {', '.join(f'u{i + 1}' for i in m.used_inputs)}" for m in state.input_mapping]
    constraints = [f"{i + 1}. {type(c).__name__}" for i, c in enumerate(state.active_constraints)]
    limits = (
        ("|f|", state.max_force_n, "N"),
        ("|τ|", state.max_torque_nm, "Nm"),
        ("|v|", state.max_speed_m_per_s, "m/s"),
        ("|ω|", state.max_speed_rad_per_s, "rad/s"),
    )
    bounds = [f"{sign} ≤ {value:g} {unit}" for sign, value, unit in limits if value is not None]
    return [*mappings, *constraints, *bounds, f"d: {type(state.transition_distance).__name__}"]


def list_edges(template: SharedControlTemplate) -> list[tuple[str, str, str]]:
    """Return (from, to, condition) of every transition and every return."""
    edges = []
    for state in template.states:
        unit = state.transition_distance.unit
        scale = 1.0 if unit == "m" else math.degrees(1.0)
        for transition in state.transitions:
            edges.append((state.name, transition.to, f"d < {scale * transition.below:.3g} {unit}"))
            if transition.hysteresis is not None:
                back = scale * (transition.below + transition.hysteresis)
                edges.append((transition.to, state.name, f"d({state.name}) > {back:.3g} {unit}"))
    return edges


def to_dot(template: SharedControlTemplate) -> str:
    """Return the state machine as text in Graphviz's DOT language."""
    lines = [f"digraph {_quote(template.name)} {{", "  rankdir=LR;", "  node [shape=box, style=rounded];"]
    for number, state in enumerate(template.states):
        label = "\n".join([state.name.upper(), *state_lines(state)])
        emphasis = ", penwidth=2" if number == template.initial_state else ""
        lines.append(f"  {_quote(state.name)} [label={_quote(label)}{emphasis}];")
    lines += [f"  {_quote(a)} -> {_quote(b)} [label={_quote(condition)}];" for a, b, condition in list_edges(template)]
    return "\n".join([*lines, "}"]) + "\n"


def _quote(text: str) -> str:
    """Quote a name or a label for Graphviz."""
    escaped = text.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n")
    return f'"{escaped}"'


def draw(template: SharedControlTemplate, path: str | Path) -> None:
    """Write the state machine to a .dot or .gv file as text, or to a .png, .svg or .pdf file as a picture.

    Raises:
        InputError: If the file has another extension, or it cannot be written.
    """
    path = Path(path)
    if path.suffix in (".dot", ".gv"):
        write_atomically(path, to_dot(template).encode())
        return
    if path.suffix not in (".png", ".svg", ".pdf"):
        raise InputError(
            f"A state machine can't be drawn to '{path.name}': use the ending .png, .svg, .pdf, .dot or .gv."
        )
    content = io.BytesIO()
    draw_figure(template).savefig(content, format=path.suffix[1:], dpi=120)
    write_atomically(path, content.getvalue())


def draw_figure(template: SharedControlTemplate) -> "Figure":
    """Return the state machine as a Matplotlib figure, for a notebook."""
    from matplotlib.figure import Figure

    width, gap = 1.8, 1.7
    tallest = max(len(state_lines(state)) for state in template.states)
    size = (len(template.states) * (width + gap) + 0.4, 0.2 * tallest + 1.0)
    figure = Figure(figsize=size, layout="constrained")
    axes = figure.add_subplot()
    axes.set_axis_off()
    axes.set_xlim(-width / 2 - 0.2, (len(template.states) - 1) * (width + gap) + width / 2 + 0.2)
    axes.set_ylim(-1.4, 1.4)
    plain: Any = {"parse_math": False}  # otherwise a dollar sign in a name would start a formula
    x = {state.name: i * (width + gap) for i, state in enumerate(template.states)}
    for number, state in enumerate(template.states):
        box = {
            "boxstyle": "round,pad=0.5",
            "facecolor": "#eef3f8",
            "edgecolor": "#33506b",
            "linewidth": 2.2 if number == template.initial_state else 1.0,
        }
        text = "\n".join([state.name.upper(), *state_lines(state)])
        axes.text(x[state.name], 0.0, text, ha="center", va="center", fontsize=8, linespacing=1.4, bbox=box, **plain)
    for start, end, condition in list_edges(template):
        side = 1.0 if x[end] > x[start] else -1.0
        tail, head = (x[start] + side * width / 2, 0.25 * side), (x[end] - side * width / 2, 0.25 * side)
        axes.annotate("", xy=head, xytext=tail, arrowprops={"arrowstyle": "-|>", "color": "#33506b"})
        axes.annotate(
            condition,
            xy=((tail[0] + head[0]) / 2, tail[1]),
            xytext=(0, 4 * side),
            textcoords="offset points",
            ha="center",
            va="bottom" if side > 0.0 else "top",
            fontsize=8,
            color="#33506b",
        )
    axes.set_title(f"{template.name}: {template.inputs} inputs", fontsize=10, **plain)
    return figure
