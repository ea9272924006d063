"""Figure 2.2: the shared control template of pouring."""

from pathlib import Path
from typing import Any

from guiderail.diagrams.stations.pouring import PouringConfig
from guiderail.diagrams.tasks.pouring import make_template
from guiderail.tools.tables import write_table
from guiderail_data.template_drawing import draw, list_edges, state_lines


def figure_2_2(out: Path) -> dict[str, Any]:
    """Draw the template: states, input mappings, transitions, and constraints in the order of their application."""
    template = make_template(PouringConfig())
    rows = []
    for state in template.states:
        following = [f"{to} if {condition}" for start, to, condition in list_edges(template) if start == state.name]
        lines = "; ".join(state_lines(state))
        rows.append({"state": state.name, "mappings and constraints": lines, "transitions": "; ".join(following)})
    picture = out / "figure_2_2.png"
    table = write_table(out / "figure_2_2", rows)
    draw(template, picture)
    states = ", ".join(state.name for state in template.states)
    return {"picture": str(picture), "table": str(table), "states": states, "inputs": template.inputs}
