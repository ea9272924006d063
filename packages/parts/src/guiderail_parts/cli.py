"""`guiderail create-task` and `guiderail create-tasks`."""

from pathlib import Path
from typing import Annotated

from guiderail.diagrams.tasks.options import COLLISION_FORCE
from guiderail.tools.cli import app as cli
from guiderail.tools.cli.app import argument, command, option, print_message, print_progress, print_result

POSE = "x,y,z,rx,ry,rz"


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
    from guiderail_parts.create_task import ask_unit
    from guiderail_parts.create_task import create_task as create

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
        labels = {"total_s": "CPU time [s]", "hard_seconds": "CPU time of hard [s]"}
        labels |= {"modulus": "modulus [Pa]", "force": "force [N]", "hard_force_limit": "hard force limit [N]"}
        created = {labels.get(name, name): value for name, value in created.items()}
    print_result(created, as_json)
    if not as_json:
        chosen = "--difficulty hard --episodes 40" if hard_episodes else "--episodes 60"
        if hard_episodes and not created.get("hard_calibrated", True):
            print_message(
                "difficulty=hard is not calibrated: compare a policy with the baselines of guiderail evaluate, because "
                "random actions may solve it, or the scripted search may not"
            )
        print_message(f"next: guiderail train {out} {chosen} --out runs/{out.name}")


@command("create-tasks meshes --unit m --out parts --processes 2", "create-tasks")
def create_tasks(
    pairs: Annotated[
        Path,
        argument(
            "CSV table with the columns name, plug and socket, and optionally options of create-task; or folder with "
            "a subfolder for each pair, with files named plug and socket.",
            "TABLE|FOLDER",
        ),
    ],
    out: Annotated[Path, option("Folder of the task folders; the same command continues an interrupted one.")],
    unit: Annotated[str | None, option("Unit of .stl, .obj and .ply meshes: mm, cm, m or inch.")] = None,
    hard_episodes: Annotated[
        int, option("Episodes per baseline policy and setting that calibrate difficulty=hard; 0: no calibration.")
    ] = 10,
    processes: Annotated[int, option("Number of pairs that are prepared at the same time.")] = 1,
    retry: Annotated[bool, option("Prepare refused pairs again.", "--retry")] = False,
    as_json: cli.Json = False,
) -> None:
    """Create insertion tasks from many pairs of meshes.

    Each pair is prepared as by create-task. If the parts overlap, the plug is shrunk by the proposed distance. A
    refused pair does not end the command: its reason is in the table parts.csv and parts.md, and its messages are in
    logs/.
    """
    from guiderail_parts.batch import TABLE
    from guiderail_parts.batch import create_tasks as create
    from guiderail_parts.pairs import find_pairs, read_pairs

    results = create(
        find_pairs(pairs, unit) if pairs.is_dir() else read_pairs(pairs, unit),
        out,
        processes=processes,
        retry=retry,
        hard_episodes=hard_episodes,
        log=(lambda text: None) if as_json else print_progress,
    )
    failures = {name: result["error"] for name, result in results.items() if "error" in result}
    summary = {"pairs": len(results), "created": len(results) - len(failures), "table": str(out / f"{TABLE}.md")}
    print_result(summary | ({"failures": failures} if as_json else {}), as_json)
