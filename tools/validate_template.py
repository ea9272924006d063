"""Validation of shared control templates before they are used: `guiderail template validate`.

The command is in `tools/cli/template.py`; the checks of a template are in `models/templates/validate.py`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from guiderail.models.common.errors import InputError
from guiderail.tools.files import path_exists

TEMPLATE_ENDINGS = (".yaml", ".yml")
SI_UNITS = {"m": "m", "deg": "rad"}  # unit of a loaded transition distance, by the unit in the template file


def validate_template(file: Path, draw: Path | None = None) -> dict[str, Any]:
    """Read a template file or a shipped template and return its inputs, frames, states and transitions, with remarks.

    With `draw`, its state machine is drawn to a .png, .svg, .pdf, .dot or .gv file.

    Raises:
        InputError: If there is no such template, it has an error, or the drawing cannot be written.
    """
    from guiderail.models.templates import load_template
    from guiderail.models.templates.drawing import draw as draw_template
    from guiderail.models.templates.schema import shipped_templates
    from guiderail.models.templates.validate import validate

    if not path_exists(file) and str(file) not in shipped_templates():
        raise InputError(
            f"there is no file {file}: name a template (.yaml), or one of {', '.join(shipped_templates())}"
        )
    if path_exists(file) and file.suffix not in TEMPLATE_ENDINGS:
        raise InputError(f"{file} has the ending {file.suffix!r}: a template is .yaml")
    template = load_template(file)
    findings = validate(template)
    errors = [finding.message for finding in findings if finding.is_error]
    if errors:
        raise InputError(f"{file}: " + "; ".join(message.rstrip(".") for message in errors))
    if draw is not None:
        draw_template(template, draw)
    return {
        "file": str(file),
        "template": template.name,
        "inputs": template.inputs,
        "frames": list(template.frames),
        "states": [state.name for state in template.states],
        "transitions": [_describe_transition(s, t) for s in template.states for t in s.transitions],
        "remarks": [finding.message for finding in findings if not finding.is_error],
    }


def _describe_transition(state: Any, transition: Any) -> str:
    """Return a transition as text, with its unit and the threshold of the transition back."""
    unit = SI_UNITS[state.transition_distance.unit]
    text = f"{state.name} → {transition.to} below {transition.below:g} {unit}"
    if transition.hysteresis is None:
        return f"{text}, no way back"
    return f"{text}, back above {transition.below + transition.hysteresis:g} {unit}"
