"""Meshes of the SC and SFP connectors of the AI for Industry Challenge, from the collision shapes of its SDF models.

The models are those of the public toolkit intrinsic-dev/aic (Apache-2.0) and are read from a local path. Only boxes,
cylinders and frames are taken; visual meshes, masses and inertias are not.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pandas as pd
import trimesh
from manifold3d import Manifold, OpType
from scipy.spatial.transform import Rotation

from guiderail.models.common.errors import InputError
from guiderail.tools.files import write_atomically
from guiderail.tools.tables import table_text
from guiderail_parts.geometry.assembly_check import MAX_RESTING_OVERLAP, measure_overlap, measure_side_clearance
from guiderail_parts.geometry.mesh_file import load_part
from guiderail_parts.geometry.solids import to_arrays
from research.command import Parser, print_rows, run_program

MM = 1e3  # millimeters in a meter
SIDES = 24  # number of sides of the prism that replaces a cylinder
GRID = 6  # decimals to which vertices are rounded [mm], so that faces drawn in contact stay in contact
RIGHT_ANGLE = 1e-4  # deviation from a multiple of 90 degrees that counts as rounding of the file [rad]
SEARCH = (2.0, -4.0, 0.1)  # heights above the drawn pose between which contact is searched, and their distance [mm]
PRECISION = 1e-3  # precision of the height of the contact [mm]
FORCE_LIMIT = 20.0  # docs/scoring.md of the toolkit: a larger force for more than 1 s costs points [N]
UP = np.diag([1.0, -1.0, -1.0, 1.0])  # z of the toolkit's frames points into the port, z of the meshes out of it


@dataclass(frozen=True)
class Connector:
    """Models of a plug and its port.

    Attributes:
        plug: Folder of the plug's model.
        port: Folder of the port's model.
        tip: Frame of the plug that coincides with `seat` when the plug is inserted.
        seat: Frame of the port.
        plug_links: Links whose shapes are the plug.
        port_links: Links whose shapes are the socket.
        left_out: Names of shapes that are left out.
    """

    plug: str
    port: str
    tip: str
    seat: str
    plug_links: tuple[str, ...]
    port_links: tuple[str, ...]
    left_out: frozenset[str] = frozenset()


_SFP = ("sfp_tip_link", "sfp_port_0_link", ("sfp_module_link", "sfp_tip_link"), ("nic_card_link",))
# Shapes that the toolkit's own cable (sfp_sc_cable) removes, because the gripper's fingers are there. The head is as
# wide as the narrow cage.
_HELD = {
    f"{name}_collider_box{number}"
    for name, count in (("port", 8), ("latch", 4), ("head", 4))
    for number in ("", *(f".{i:03d}" for i in range(1, count)))
}
_TAB = {"plane001_collider_box.004"}  # tab of the bracket, 64 mm beside the ports; the plug would start above it
_EDGE = {"port_collider_box002_collider_box"}  # edge at the module's rear with 0.02 mm to the narrow cage when seated
CONNECTORS = {
    # The ferrules end on the box contact_collision, a contact sensor that also collides in the toolkit: it is kept.
    "sc": Connector("SC Plug", "SC Port", "sc_tip_link", "sc_port_base_link", ("sc_plug_link",), ("sc_port_link",)),
    # The challenge's own scene. The module's front, shapes of sfp_tip_link, ends on contact sensors in the cage: they
    # are kept. So is the second port, as an obstacle. The mount's link does not reach the cage and is left out.
    "sfp": Connector("SFP Module", "NIC Card Mount", *_SFP, frozenset(_HELD | _TAB)),
    # The model of the card alone has a narrower cage without sensors: the module ends on the cage's rear wall.
    "sfp_narrow": Connector("SFP Module", "NIC Card", *_SFP, frozenset(_HELD | _TAB | _EDGE)),
}


@dataclass(frozen=True)
class Model:
    """Links of an SDF model.

    Attributes:
        poses: Pose of each link in the model's frame, (4, 4), by name [mm].
        shapes: Collision shapes in the frame of their link, by link and name [mm].
        friction: Friction coefficient of the first shape that has one, by link. Bullet uses it for the whole link.
    """

    poses: Mapping[str, np.ndarray]
    shapes: Mapping[str, Mapping[str, Manifold]]
    friction: Mapping[str, float]

    def unite(self, links: Sequence[str], frame: str, left_out: frozenset[str]) -> Manifold:
        """Return the union of the shapes of links, but for `left_out`, in a frame turned by `UP` [mm]."""
        solids = []
        for link in links:
            # Vertices are rounded in the frame of the first link, where most faces are along the axes.
            to_first = np.linalg.inv(self.poses[links[0]]) @ self.poses[link]
            for name, shape in self.shapes[link].items():
                if name not in left_out:
                    solids.append(shape.transform(to_first[:3]).warp_batch(lambda points: np.round(points, GRID)))
        to_frame = UP @ np.linalg.inv(self.poses[frame]) @ self.poses[links[0]]
        return Manifold.batch_boolean(solids, OpType.Add).transform(to_frame[:3])


def read_model(file: Path) -> Model:
    """Return the links of an SDF model.

    Raises:
        InputError: If the file cannot be read, or has a shape other than boxes and cylinders.
    """
    try:
        model = ElementTree.parse(file).find("model")
        if model is None:
            raise ValueError("it has no model")
        links = {str(link.get("name")): link for link in model.findall("link")}
        poses: dict[str, np.ndarray] = {}
        for name, link in links.items():
            # A frame is relative to a link above it in all of the toolkit's files.
            base = link.find("pose[@relative_to]")
            parent = poses[str(base.get("relative_to"))] if base is not None else np.eye(4)
            poses[name] = parent @ _pose_of(link)
        shapes, friction = {}, {}
        for name, link in links.items():
            collisions = link.findall("collision")
            shapes[name] = {str(one.get("name")): _solid_of(one) for one in collisions}
            if (coefficient := link.findtext("collision/surface/friction/bullet/friction")) is not None:
                friction[name] = float(coefficient)
    except (OSError, ElementTree.ParseError, ValueError, KeyError) as error:
        raise InputError(f"{file} cannot be read as an SDF model of boxes and cylinders ({error})") from error
    return Model(poses, shapes, friction)


def _numbers(text: str | None, count: int) -> np.ndarray:
    values = np.array((text or "").split(), dtype=float)
    if values.shape != (count,) or not np.isfinite(values).all():
        raise ValueError(f"{count} numbers are expected, not {text!r}")
    return values


def _pose_of(element: ElementTree.Element) -> np.ndarray:
    """Return the pose of a link or a collision in its parent, (4, 4) [mm]."""
    numbers = _numbers(element.findtext("pose", "0 0 0 0 0 0"), 6)
    quarters = np.round(numbers[3:] / (0.5 * np.pi)) * 0.5 * np.pi
    angles = np.where(np.abs(numbers[3:] - quarters) < RIGHT_ANGLE, quarters, numbers[3:])
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("xyz", angles).as_matrix()
    pose[:3, 3] = MM * numbers[:3]
    return pose


def _solid_of(collision: ElementTree.Element) -> Manifold:
    """Return the shape of a collision in its link [mm]."""
    geometry = collision.find("geometry")
    if geometry is not None and geometry.find("box") is not None:
        solid = Manifold.cube(tuple(MM * _numbers(geometry.findtext("box/size"), 3)), True)
    elif geometry is not None and geometry.find("cylinder") is not None:
        radius, length = (MM * _numbers(geometry.findtext(f"cylinder/{name}"), 1)[0] for name in ("radius", "length"))
        solid = Manifold.cylinder(length, radius, circular_segments=SIDES, center=True)
    else:
        raise ValueError(f"{collision.get('name')} is neither a box nor a cylinder")
    return solid.transform(_pose_of(collision)[:3])


def find_contact(plug: Manifold, socket: Manifold) -> float:
    """Return the height above its drawn pose at which a plug that is lowered first touches the socket [mm].

    Raises:
        InputError: If the plug touches at the start of the search, or not at all.
    """
    high, low, step = SEARCH

    def overlaps(height: float) -> bool:
        return measure_overlap([plug.translate((0.0, 0.0, height))], [socket])[0] > MAX_RESTING_OVERLAP

    while not overlaps(high - step):
        high -= step
        if high <= low:
            raise InputError(f"nothing stops the plug down to {-low:g} mm below its pose")
    if overlaps(high):
        raise InputError(f"the plug overlaps the socket {high:g} mm above its pose: the frames do not fit the shapes")
    low = high - step
    while high - low > PRECISION:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if overlaps(middle) else (low, middle)
    return high


def write_connector(models: Path, connector: Connector, folder: Path) -> dict[str, Any]:
    """Write `plug.stl` and `socket.stl` [mm], assembled and z up, and return measured properties.

    The plug is seated where it first touches the port. In the toolkit contact with the port's sensor counts as success,
    and where its frames coincide, the shapes overlap (SC) or do not touch yet (SFP).
    """
    plug_model, port_model = (read_model(models / name / "model.sdf") for name in (connector.plug, connector.port))
    for model, name, names in (
        (plug_model, connector.plug, (connector.tip, *connector.plug_links)),
        (port_model, connector.port, (connector.seat, *connector.port_links)),
    ):
        for link in names:
            if link not in model.poses:
                raise InputError(f"the model {name} has no link {link}: give models of the toolkit with --models")
    plug = plug_model.unite(connector.plug_links, connector.tip, connector.left_out)
    socket = port_model.unite(connector.port_links, connector.seat, connector.left_out)
    height = find_contact(plug, socket)
    folder.mkdir(parents=True, exist_ok=True)
    for name, solid in (("plug", plug.translate((0.0, 0.0, height))), ("socket", socket)):
        vertices, triangles = to_arrays(solid)
        trimesh.Trimesh(MM * vertices, triangles).export(folder / f"{name}.stl")
    plug_part, socket_part = (load_part(folder / f"{name}.stl", "mm") for name in ("plug", "socket"))
    return {
        "clearance_mm": round(MM * measure_side_clearance(plug_part, socket_part), 4),
        "seated_above_frames_mm": round(height, 3),
        "depth_mm": round(MM * float(socket_part.bounds[1, 2] - plug_part.bounds[0, 2]), 2),
        "friction": port_model.friction.get(connector.port_links[0]),  # without a value, that of create-task
    }


def main(arguments: list[str]) -> None:
    """Run the program."""
    parser = Parser(
        "parts.connectors",
        "Write plug.stl and socket.stl of the SC and SFP connectors of the toolkit intrinsic-dev/aic, and a table "
        "pairs.csv for guiderail create-tasks with the toolkit's friction and force limit.",
        "--models aic/aic_assets/models --out connectors",
    )
    parser.add_argument("--models", type=Path, required=True, help="folder aic_assets/models of the toolkit")
    parser.add_argument("--out", type=Path, required=True, help="folder of the meshes; files in it are replaced")
    parser.add_json()
    args = parser.parse_args(arguments)
    rows: list[dict[str, Any]] = []
    for name, connector in CONNECTORS.items():
        measured = write_connector(args.models, connector, args.out / name)
        rows.append({"name": name, **measured})
    table = args.out / "pairs.csv"
    pairs = [
        {
            "name": row["name"], "plug": f"{row['name']}/plug.stl", "socket": f"{row['name']}/socket.stl", "unit": "mm",
            "friction": row["friction"], "force_limit": FORCE_LIMIT,
        }
        for row in rows
    ]  # fmt: skip
    write_atomically(table, table_text(pd.DataFrame(pairs)).encode())
    print_rows(table, rows, as_json=args.json)


if __name__ == "__main__":
    run_program(main)
