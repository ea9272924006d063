"""`guiderail check`: what a file of demonstrations or a skill holds, before anything is learned from it."""

from pathlib import Path
from typing import Any

import numpy as np

from guiderail.models.errors import InputError
from guiderail.models.primitives import Demonstrations

DEMONSTRATIONS = (".npz", ".csv")
SKILLS = (".yaml", ".yml")


def check(file: Path, draw: Path | None = None) -> dict[str, Any]:
    """Reads a file as what its ending says it is; `draw` is where a skill's state machine is drawn.

    Raises:
        InputError: if it is neither, or what it holds makes no sense.
    """
    if not file.is_file():
        raise InputError(f"there is no file {file}: name demonstrations (.npz, .csv) or a skill (.yaml)")
    if file.suffix in DEMONSTRATIONS:
        return check_demonstrations(file)
    if file.suffix in SKILLS:
        return check_skill(file, draw)
    raise InputError(f"{file} has the ending {file.suffix!r}: demonstrations are .npz or .csv, a skill is .yaml")


def check_demonstrations(file: Path) -> dict[str, Any]:
    """What a file of demonstrations holds: how many, how long, and how far they agree with each other."""
    demonstrations = Demonstrations.load(file)
    common = demonstrations.resampled()
    outputs = np.stack(common.outputs)
    spread = outputs.std(axis=0) if len(outputs) > 1 else np.zeros(outputs.shape[1:])
    durations = [float(t[-1] - t[0]) for t in demonstrations.times]
    return {
        "file": str(file),
        "demonstrations": demonstrations.num_demonstrations,
        "outputs": list(demonstrations.names),
        "shortest": min(durations),
        "longest": max(durations),
        "points": [len(t) for t in demonstrations.times],
        "lowest": outputs.min(axis=(0, 1)).round(6).tolist(),
        "highest": outputs.max(axis=(0, 1)).round(6).tolist(),
        "tightest": spread.min(axis=0).round(6).tolist(),
        "widest": spread.max(axis=0).round(6).tolist(),
    }


def check_skill(file: Path, draw: Path | None = None) -> dict[str, Any]:
    """What a skill holds, and what is odd about it; reading it is what finds most of its faults.

    Args:
        file: the skill.
        draw: where its state machine is drawn: .png, .svg, .pdf or .dot.

    Raises:
        InputError: if the skill cannot be used.
    """
    from guiderail.models.skills import load_skill  # it needs Drake, which demonstrations don't
    from guiderail.models.skills.drawing import draw as draw_skill
    from guiderail.models.skills.validate import validate

    skill = load_skill(file)
    findings = validate(skill)
    errors = [finding.message for finding in findings if finding.is_error]
    if errors:
        raise InputError(f"{file}: " + "; ".join(message.rstrip(".") for message in errors))
    if draw is not None:
        draw_skill(skill, draw)
    return {
        "file": str(file),
        "skill": skill.name,
        "inputs": skill.inputs,
        "frames": list(skill.frames),
        "states": [state.name for state in skill.states],
        "transitions": [f"{s.name} → {t.to} below {t.below:g}" for s in skill.states for t in s.transitions],
        "remarks": [finding.message for finding in findings if not finding.is_error],
    }
