"""`guiderail dataset` and `guiderail template`."""

from importlib import import_module
from pathlib import Path
from typing import Annotated

from guiderail.tools.cli import app as cli
from guiderail.tools.cli.app import argument, command, import_option, option, print_progress, print_result

dataset = cli.command_group("dataset", "Import, export and validate demonstrations, and fit bounds to them.")
template = cli.command_group("template", "Validate shared control templates.")

POSE = "x,y,z,rx,ry,rz"
Demonstrations = Annotated[Path, argument("Demonstrations: .npz, .csv or a folder of them.", "FILE")]
cli.CHOICES["templates"] = lambda: import_module("guiderail.models.templates.schema").shipped_templates()


@command("dataset import bag --out demonstrations.npz --target 0.5,0,0.2,0,0,0", "import", dataset)
def import_(
    source: Annotated[
        Path, argument("LeRobot v3 dataset, ROS bag, .mcap or .csv file, or a folder of them.", "SOURCE")
    ],
    out: Annotated[Path, option("File of demonstrations to write, .npz or .csv.")],
    signal: Annotated[
        str | None, option("Topic or feature to import.  [default: the only one, or the only commanded one]")
    ] = None,
    target: Annotated[
        str | None, option(f"{POSE}: pose of the task's target in the recording's frame [m, degrees].")
    ] = None,
    rate: Annotated[float | None, option("Resample to this rate [1/s].")] = None,
    unit: Annotated[str | None, option("Unit of positions in a CSV file that does not state it: m, cm or mm.")] = None,
    time_unit: Annotated[str | None, option("Unit of time in a CSV file: s, ms, us or ns.")] = None,
    quaternion: Annotated[
        str | None, option("Order of a quaternion with numbered columns in a CSV file: xyzw or wxyz.")
    ] = None,
    angles: Annotated[str | None, option("Unit of roll, pitch and yaw in a CSV file: deg or rad.")] = None,
    as_json: cli.Json = False,
) -> None:
    """Import demonstrations from another format.

    The assumptions made are printed. If a file does not state a unit, the error message names the option that sets it.
    Without --target, poses stay in the frame of the recording.
    """
    from guiderail_data.convert import import_recording

    pose = None if target is None else cli.parse_floats(target, 6, "--target")
    csv_options = {"unit": unit, "time_unit": time_unit, "quaternion": quaternion, "angles": angles}
    print_result(import_recording(source, out, signal=signal, target=pose, rate=rate, **csv_options), as_json)


@command("dataset export demonstrations.npz --to lerobot --out dataset", None, dataset)
def export(
    file: Demonstrations,
    out: Annotated[Path, option("Folder to write; it must not exist.")],
    to: Annotated[str, option("Format: lerobot or mcap.")],
    rate: Annotated[float | None, option("Resample to this rate [1/s].")] = None,
    as_json: cli.Json = False,
) -> None:
    """Export demonstrations to a LeRobot v3 dataset, or to ROS 2 bags in MCAP."""
    from guiderail_data.convert import export_demonstrations

    print_result(export_demonstrations(file, out, to, rate), as_json)


@command("dataset record runs/connector --to lerobot --episodes 50 --out connector_episodes", "record", dataset)
def record(
    policy: Annotated[
        str, argument("Folder of a run, pretrained:NAME ({pretrained}), or with --task a policy's name.", "POLICY")
    ],
    out: Annotated[str, option("LeRobot: folder to write. Minari: identifier, such as guiderail/clamp/scripted-v0.")],
    to: Annotated[str, option("Format: lerobot or minari.")],
    task: cli.PolicyTask = None,
    env: cli.Env = None,
    episodes: Annotated[int, option("Number of episodes.")] = 50,
    seed: Annotated[int, option("Seed of the first episode; episode i has this seed + i.")] = 0,
    as_json: cli.Json = False,
) -> None:
    """Run a policy and write its episodes as a data set of LeRobot or Minari.

    The demonstrations of a task are the episodes of its scripted policy. LeRobot has the commanded pose as action, and
    the measured pose and wrench as observation.state and observation.wrench; Minari has observations, actions and
    rewards, in the folder that the variable MINARI_DATASETS_PATH names.
    """
    from guiderail_data.episodes import record_episodes

    name = None if task is None else cli.find_task(task, None)[0]
    environment = cli.parse_environment(env)
    result = record_episodes(policy, out, to, task=name, environment=environment, episodes=episodes, seed=seed)
    print_result(result, as_json)


@command("dataset validate demonstrations.csv --draw demonstrations.png", None, dataset)
def validate(
    file: Demonstrations,
    draw: Annotated[Path | None, option("Picture of the demonstrations to write: {pictures}.")] = None,
    fit: Annotated[
        bool,
        option("Choose components, length_scale, lambda_ and beta that reproduce the demonstrations.", "--fit"),
    ] = False,
    as_json: cli.Json = False,
) -> None:
    """Validate and summarize demonstrations before they are used."""
    from guiderail_data.validate import validate_demonstrations

    log = None if as_json else print_progress
    print_result(validate_demonstrations(file, draw, fit=fit, log=log), as_json)


@command("dataset fit-bounds demonstrations.npz --phases 4 --draw bounds.png --task ./peg", "fit-bounds", dataset)
def fit_bounds(
    file: Demonstrations,
    phases: Annotated[int, option("Number of phases of the motion, each with its own bounds.")] = 1,
    margin: Annotated[float, option("Margin beyond the demonstrations, as a fraction of their range.")] = 0.1,
    min_margin: Annotated[float, option("Smallest margin, in the outputs' unit.")] = 0.0,
    outputs: Annotated[str | None, option("Indices of the bounded outputs, such as 0,1.  [default: all]")] = None,
    draw: Annotated[Path | None, option("Picture of the demonstrations and bounds to write: {pictures}.")] = None,
    out: Annotated[Path | None, option("YAML file of the bounds to write.")] = None,
    task: Annotated[Path | None, option("Folder of a task; the bounds in its task.yaml are replaced.")] = None,
    as_json: cli.Json = False,
) -> None:
    """Fit bounds of the commanded pose to demonstrations, phase by phase."""
    from guiderail_data.validate import fit_bounds as fit

    result = fit(
        file,
        phases=phases,
        margin=margin,
        min_margin=min_margin,
        outputs=cli.parse_integers(outputs, "--outputs"),
        draw=draw,
        out=out,
        task=task,
    )
    print_result(result, as_json)


@command("template validate pouring --draw pouring.svg", "validate", template)
def validate_template(
    file: Annotated[Path, argument("Template (.yaml), or one of {templates}.", "FILE")],
    draw: Annotated[Path | None, option("Picture of the states to write: .png, .svg, .pdf or .dot.")] = None,
    imports: Annotated[list[str] | None, import_option("parts of templates")] = None,
    as_json: cli.Json = False,
) -> None:
    """Validate and summarize a shared control template before it is used."""
    from guiderail_data.template_validation import describe_template

    cli.import_files(imports)
    print_result(describe_template(file, draw), as_json)
