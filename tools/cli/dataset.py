"""`guiderail dataset`, `guiderail template` and `guiderail create-task`."""

from pathlib import Path
from typing import Annotated

from guiderail.diagrams.tasks.options import COLLISION_FORCE
from guiderail.tools.cli import app as cli
from guiderail.tools.cli.app import argument, command, option, print_progress, print_result

dataset = cli.command_group("dataset", "Import, export and validate demonstrations, and fit bounds to them.")
template = cli.command_group("template", "Validate shared control templates.")

POSE = "x,y,z,rx,ry,rz"


@command("dataset import bag --out demonstrations.npz --target 0.5,0,0.2,0,0,0", "import", dataset)
def import_(
    source: Annotated[
        Path, argument("LeRobot v3 dataset, ROS 2 bag, .mcap or .csv file, or a folder of them.", "SOURCE")
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
    from guiderail.tools.datasets.convert import import_recording

    pose = None if target is None else cli.parse_floats(target, 6, "--target")
    csv_options = {"unit": unit, "time_unit": time_unit, "quaternion": quaternion, "angles": angles}
    print_result(import_recording(source, out, signal=signal, target=pose, rate=rate, **csv_options), as_json)


@command("dataset export demonstrations.npz --to lerobot --out dataset", None, dataset)
def export(
    file: cli.Demonstrations,
    out: Annotated[Path, option("Folder to write; it must not exist.")],
    to: Annotated[str, option("Format: lerobot or mcap.")],
    rate: Annotated[float | None, option("Resample to this rate [1/s].")] = None,
    as_json: cli.Json = False,
) -> None:
    """Export demonstrations to a LeRobot v3 dataset, or to ROS 2 bags in MCAP."""
    from guiderail.tools.datasets.convert import export_demonstrations

    print_result(export_demonstrations(file, out, to, rate), as_json)


@command("dataset validate demonstrations.csv --draw demonstrations.png", None, dataset)
def validate(
    file: cli.Demonstrations,
    draw: Annotated[Path | None, option("Picture of the demonstrations to write: {pictures}.")] = None,
    fit: Annotated[
        bool,
        option("Choose components, length_scale, lambda_ and beta that reproduce the demonstrations.", "--fit"),
    ] = False,
    as_json: cli.Json = False,
) -> None:
    """Validate and summarize demonstrations before they are used."""
    from guiderail.tools.datasets.validate import validate_demonstrations

    print_result(validate_demonstrations(file, draw, fit=fit), as_json)


@command("dataset fit-bounds demonstrations.npz --phases 4 --draw bounds.png --task ./peg", "fit-bounds", dataset)
def fit_bounds(
    file: cli.Demonstrations,
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
    from guiderail.tools.datasets.validate import fit_bounds as fit

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
    imports: cli.TemplateImports = None,
    as_json: cli.Json = False,
) -> None:
    """Validate and summarize a shared control template before it is used."""
    from guiderail.tools.datasets.validate import validate_template as check

    cli.import_files(imports)
    print_result(check(file, draw), as_json)


@command("create-task plug.stl socket.stl --unit mm --out ./peg", "create-task")
def create_task(
    plug: Annotated[Path, argument("Mesh of the part in the tool: .stl, .obj, .ply, .glb, .step.", "PLUG")],
    socket: Annotated[Path, argument("Mesh of the part in the world.", "SOCKET")],
    out: Annotated[Path, option("Folder of the task; it must not exist.")],
    unit: Annotated[str | None, option("Unit of .stl, .obj and .ply meshes: mm, cm, m or inch.")] = None,
    plug_pose: Annotated[
        str, option(f"{POSE}: transform of the plug's mesh to the assembled pose [unit of the socket, degrees].")
    ] = "0,0,0,0,0,0",
    axis: Annotated[str, option("Direction in which the plug is removed: +x, -x, +y, -y, +z or -z.")] = "+z",
    center: Annotated[
        str | None, option("x,y,z of a point on the axis [unit of the socket].  [default: the plug's center of mass]")
    ] = None,
    turn: Annotated[
        float,
        option("Rotation at the bottom [degrees], counterclockwise from outside; the mesh shows the plug after it."),
    ] = 0.0,
    pitch: Annotated[
        float, option("Advance of a screw per full turn during --turn [mm], positive if it is right-handed.")
    ] = 0.0,
    search_turn: Annotated[
        float, option("Largest unknown turn of the socket [degrees]; above 0, actions also turn the plug.")
    ] = 0.0,
    shrink: Annotated[float, option("Distance by which the plug's surface is moved inwards [mm].")] = 0.0,
    force_limit: Annotated[float, option("Contact force that ends an episode as a collision [N].")] = COLLISION_FORCE,
    friction: Annotated[float, option("Friction coefficient of all surfaces.")] = 0.2,
    scenario: Annotated[
        list[Path] | None, option("Drake model directives (.dmd.yaml) of the surroundings; repeatable.")
    ] = None,
    hard_episodes: Annotated[
        int, option("Episodes per baseline policy and setting that calibrate difficulty=hard; 0: no calibration.")
    ] = 10,
    as_json: cli.Json = False,
) -> None:
    """Create an insertion task from two mesh files.

    The meshes show the parts assembled, or --plug-pose moves the plug to the assembled pose. The command checks them,
    selects a contact geometry that is fast and stiff enough, inserts the plug by a script, aligned and misaligned,
    records demonstrations and writes a task folder for guiderail train ./peg. Parameters are in its task.yaml;
    preview.html shows the task.
    """
    from guiderail.tools.parts.create_task import ask_unit
    from guiderail.tools.parts.create_task import create_task as create

    created = create(
        plug,
        socket,
        out,
        unit=ask_unit((plug, socket), unit),
        plug_pose=cli.parse_floats(plug_pose, 6, "--plug-pose"),
        axis=axis,
        center=None if center is None else cli.parse_floats(center, 3, "--center"),
        turn=turn,
        pitch=1e-3 * pitch,
        search_turn=search_turn,
        shrink=1e-3 * shrink,
        force_limit=force_limit,
        friction=friction,
        scenario=scenario or (),
        hard_episodes=hard_episodes,
        log=(lambda text: None) if as_json else print_progress,
    )
    if not as_json:
        created |= {f"hard_{name}": value for name, value in created.pop("hard", {}).items()}
        labels = {"modulus": "modulus [Pa]", "force": "force [N]", "hard_force_limit": "hard force limit [N]"}
        created = {labels.get(name, name): value for name, value in created.items()}
    print_result(created, as_json)
