"""`guiderail check`: what a file of demonstrations or a template holds, before anything is learned from it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from guiderail.models.common.errors import InputError
from guiderail.models.primitives import Demonstrations, ReferenceTrajectory
from guiderail.models.primitives.fit import ENOUGH, estimated_share
from guiderail.tools.datasets.paths import ENDINGS, is_there, load_demonstrations
from guiderail.tools.files import check_picture


def leaves_demonstrations(task: str, environment: Mapping[str, Any]) -> str | None:
    """A sentence if the zero action leaves the demonstrations' spread; None if it doesn't, or there are none.

    Args:
        task: its name.
        environment: its options.

    Raises:
        InputError: for an unknown task or option.
    """
    from guiderail.diagrams.envs.config import EnvConfig  # Drake takes a second

    config = EnvConfig.resolve(task, environment)
    declared = config.make_task()
    if "demonstrations" not in declared.provides():
        return None
    values = config.options
    chosen = {name: values[name] for name in ("inverse_length", "lambda_", "beta", "horizon")}
    share = estimated_share(declared.reference(), **chosen)
    if share >= ENOUGH:
        return None
    return (
        f"without actions, {share:.0%} of the steps stay within a standard deviation of the demonstrations: let "
        "guiderail check FILE --fit choose inverse_length, lambda_ and beta, and give them by --env"
    )


TEMPLATES = (".yaml", ".yml")
SI = {"m": "m", "deg": "rad"}  # what a distance is in, by the unit that a file gives it in


def check(file: Path, draw: Path | None = None, *, fit: bool = False) -> dict[str, Any]:
    """Reads a file as what its ending says it is.

    Args:
        file: what is read; or the name of one of guiderail's own templates.
        draw: where demonstrations or a state machine are drawn.
        fit: whether a primitive is fitted to demonstrations, which takes seconds.

    Raises:
        InputError: if it is neither, or what it holds makes no sense.
    """
    if not is_there(file):
        from guiderail.models.templates.schema import shipped_templates

        if str(file) in shipped_templates():
            _refuse_fit(fit)
            return check_template(file, draw)
        raise InputError(
            f"there is no file {file}: name demonstrations (.npz, .csv, a folder), a template (.yaml) or one of "
            f"{', '.join(shipped_templates())}"
        )
    if file.suffix in ENDINGS or file.is_dir():
        return check_demonstrations(file, draw) | (fitted(file) if fit else {})
    if file.suffix in TEMPLATES:
        _refuse_fit(fit)
        return check_template(file, draw)
    raise InputError(f"{file} has the ending {file.suffix!r}: demonstrations are .npz or .csv, a template is .yaml")


def _refuse_fit(fit: bool) -> None:
    if fit:
        raise InputError("--fit is of demonstrations, and this is a template: leave it out")


def check_demonstrations(file: Path, draw: Path | None = None) -> dict[str, Any]:
    """What a file of demonstrations holds: how many, how long, and how far they agree with each other.

    Args:
        file: the file, or a folder of files.
        draw: where they are drawn, with their mean, covariance and bounds.

    Raises:
        InputError: if they make no sense, or cannot be drawn.
    """
    if draw is not None:
        check_picture(draw)
    demonstrations = load_demonstrations(file)
    common = demonstrations.resampled()
    outputs = np.stack(common.outputs)
    spread = outputs.std(axis=0) if len(outputs) > 1 else np.zeros(outputs.shape[1:])
    durations = [float(t[-1] - t[0]) for t in demonstrations.times]
    if draw is not None:
        draw_demonstrations(common, draw)
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
    } | ({} if draw is None else {"picture": str(draw)})


def fitted(file: Path) -> dict[str, Any]:
    """What a primitive of these demonstrations should be made with, why, and how the defaults would do.

    Raises:
        InputError: if they are too few for that.
    """
    from guiderail.models.primitives import LcNsKmp
    from guiderail.models.primitives.fit import ENOUGH, fit, share_within_spread

    demonstrations = load_demonstrations(file)
    # What agrees exactly would leave a covariance singular.
    floor = 1e-3 * np.maximum(np.ptp(np.concatenate(demonstrations.outputs), axis=0), 1e-9)
    chosen = fit(demonstrations, floor=floor)
    share = share_within_spread(LcNsKmp(chosen.reference))
    words = "stays with them" if share >= ENOUGH else "LEAVES them: give what is chosen here"
    return {
        "components": chosen.components,
        "inverse_length": float(f"{chosen.kernel.inverse_length:.4g}"),
        "lambda_": float(f"{chosen.lambda_:.4g}"),
        "beta": float(f"{chosen.beta:.4g}"),
        "why": chosen.why,
        "with the defaults": f"λ = β = 6 and inverse_length = 2: {share:.1%} of the steps within; {words}",
    }


def draw_demonstrations(common: Demonstrations, picture: Path) -> None:
    """Draws demonstrations on one clock: each, the reference's mean with two standard deviations, and their bounds."""
    from guiderail.tools.visualization.style import new_figure, save_figure

    outputs = np.stack(common.outputs)
    # What agrees exactly would leave a covariance singular.
    floor = 1e-3 * np.maximum(np.ptp(outputs, axis=(0, 1)), 1e-9)
    reference = ReferenceTrajectory.from_demonstrations(common, floor=floor)
    figure, axes = new_figure(len(common.names), 1, (8.0, 2.2 * len(common.names)))
    for o, (axis, name) in enumerate(zip(axes[:, 0], common.names, strict=True)):
        axis.plot(common.times[0], outputs[..., o].T, color="0.6", linewidth=0.8)
        mean, wide = reference.means[:, o], 2 * reference.standard_deviations[:, o]
        axis.fill_between(reference.times, mean - wide, mean + wide, color="tab:blue", alpha=0.25, linewidth=0)
        axis.plot(reference.times, mean, color="tab:blue")
        for bound in (outputs[..., o].min(), outputs[..., o].max()):
            axis.axhline(bound, color="firebrick", linewidth=0.8, linestyle="--")
        axis.set(ylabel=name, xlabel="time" if o + 1 == len(common.names) else "")
    axes[0, 0].set_title("demonstrations, mean and two standard deviations, lowest and highest", fontsize=9)
    save_figure(figure, picture)


def check_template(file: Path, draw: Path | None = None) -> dict[str, Any]:
    """What a template holds, and what is odd about it; reading it is what finds most of its faults.

    Args:
        file: the template, or the name of one of guiderail's own.
        draw: where its state machine is drawn: .png, .svg, .pdf or .dot.

    Raises:
        InputError: if the template cannot be used.
    """
    from guiderail.models.templates import load_template  # it needs Drake, which demonstrations don't
    from guiderail.models.templates.drawing import draw as draw_template
    from guiderail.models.templates.validate import validate

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
        "transitions": [_in_words(s, t) for s in template.states for t in s.transitions],
        "remarks": [finding.message for finding in findings if not finding.is_error],
    }


def _in_words(state: Any, transition: Any) -> str:
    """A transition with its unit, and where the way back is."""
    unit = SI[state.transition_distance.unit]
    words = f"{state.name} → {transition.to} below {transition.below:g} {unit}"
    if transition.hysteresis is None:
        return f"{words}, no way back"
    return f"{words}, back above {transition.below + transition.hysteresis:g} {unit}"
