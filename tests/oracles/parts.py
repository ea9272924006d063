"""Plugs and sockets as STL files [mm], for which no parameter of the package is tuned.

Each pair is modeled assembled, with insertion from above along z. A plug that is turned to lock is modeled locked.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import trimesh
from manifold3d import CrossSection, Manifold, Mesh, OpType

SIDES = 24
CHAMFER = 0.5  # chamfer of a plug's tip and a socket's mouth [mm]


@dataclass(frozen=True)
class Part:
    """A plug and its socket.

    Attributes:
        plug: Solids of the plug.
        socket: Solids of the socket.
        clearance: Clearance between the walls of plug and socket on each side [mm].
        options: Further arguments of `guiderail create-task`.
    """

    plug: list[Manifold]
    socket: list[Manifold]
    clearance: float
    options: list[str] = field(default_factory=list)

    def write(self, folder: Path) -> tuple[Path, Path]:
        """Write both STL files; return their paths."""
        paths = folder / "plug.stl", folder / "socket.stl"
        for path, solids in zip(paths, (self.plug, self.socket), strict=True):
            trimesh.util.concatenate([_mesh(solid) for solid in solids]).export(path)
        return paths


def _mesh(solid: Manifold) -> trimesh.Trimesh:
    mesh = solid.to_mesh()
    return trimesh.Trimesh(np.asarray(mesh.vert_properties)[:, :3], np.asarray(mesh.tri_verts))


def _disc(radius: float, sides: int = SIDES) -> CrossSection:
    return CrossSection.circle(radius, sides)


def _square(width: float, depth: float, x: float = 0.0, y: float = 0.0) -> CrossSection:
    return CrossSection.square((width, depth), True).translate((x, y))


def _prism(outline: CrossSection, low: float, high: float) -> Manifold:
    return Manifold.extrude(outline, high - low).translate((0, 0, low))


def _offset(outline: CrossSection, by: float) -> CrossSection:
    from manifold3d import JoinType

    return outline.offset(by, JoinType.Miter)


def _shaft(outline: CrossSection, low: float, high: float, chamfer: float = CHAMFER) -> Manifold:
    """Return a convex prism with a chamfered lower end."""
    tip = _prism(_offset(outline, -chamfer), low, low + 0.01)
    return Manifold.batch_hull([tip, _prism(outline, low + chamfer, high)])


def _hole(outline: CrossSection, clearance: float, low: float) -> Manifold:
    """Return the volume of a hole below z = 0 with a convex outline and a chamfered mouth."""
    wall = _offset(outline, clearance)
    mouth = [_prism(wall, -CHAMFER, -CHAMFER + 0.01), _prism(_offset(wall, CHAMFER), 0.0, 0.01)]
    return _prism(wall, low, 0.01) + Manifold.batch_hull(mouth)


def _block(width: float, low: float) -> Manifold:
    return _prism(_square(width, width), low, 0.0)


def _peg(outlines: list[CrossSection], clearance: float, low: float) -> Part:
    """Return a peg of several convex prisms that seats on the hole's bottom at the height `low` [mm]."""
    plug = Manifold.batch_boolean([_shaft(outline, low, 8.0) for outline in outlines], OpType.Add)
    holes = [_hole(outline, clearance, low) for outline in outlines]
    return Part([plug], [_block(30.0, low - 4.0) - Manifold.batch_boolean(holes, OpType.Add)], clearance)


def _headed(outlines: list[CrossSection], clearance: float, low: float) -> Part:
    """Return a head on the socket's face with several convex pins, which end at the height `low` [mm]."""
    pins = [_shaft(outline, low, 0.0) for outline in outlines]
    plug = Manifold.batch_boolean([_prism(_square(18.0, 16.0), 0.0, 6.0), *pins], OpType.Add)
    holes = [_hole(outline, clearance, low - 1.0) for outline in outlines]
    return Part([plug], [_block(30.0, low - 5.0) - Manifold.batch_boolean(holes, OpType.Add)], clearance)


def keyed_peg(clearance: float = 0.2) -> Part:
    """Return a round peg with a key and a head that seats on the socket's face."""
    outlines = [_disc(6.0), _square(3.0, 3.0, 6.0)]
    shaft = Manifold.batch_hull([_prism(_offset(_disc(6.0), -CHAMFER), -15, -14.99), _prism(_disc(6.0), -14.5, 0)])
    key = _shaft(outlines[1], -15.0, 0.0)
    plug = shaft + key + _prism(_disc(10.0), 0.0, 8.0)
    socket = _block(30.0, -20.0)
    for outline in outlines:
        socket -= _hole(outline, clearance, -16.0)
    return Part([plug], [socket], clearance)


def square_peg(clearance: float = 0.1) -> Part:
    """Return a square peg that seats on the hole's bottom."""
    outline = _square(10.0, 10.0)
    return Part([_shaft(outline, -15.0, 10.0)], [_block(30.0, -20.0) - _hole(outline, clearance, -15.0)], clearance)


def d_connector(clearance: float = 0.15) -> Part:
    """Return a D-shaped shell around a D-shaped tongue."""
    outline = _disc(7.0) ^ _square(20.0, 20.0, -6.0)
    core, wall = _offset(outline, -1.5), 1.5
    cavity = _prism(core, -8.0, -1.5) + Manifold.batch_hull(
        [_prism(core, -7.5, -7.49), _prism(_offset(core, CHAMFER), -8.01, -8.0)]
    )
    plug = _shaft(outline, -8.0, 6.0) - cavity
    tongue_outline = _offset(core, -clearance)
    tongue = Manifold.batch_hull(
        [_prism(tongue_outline, -9.0, -2.0 - CHAMFER), _prism(_offset(tongue_outline, -CHAMFER), -2.01, -2.0)]
    )
    socket = _block(26.0, -12.0) - _hole(outline, clearance, -8.0) + tongue
    assert wall > 2 * clearance
    return Part([plug], [socket], clearance)


def bayonet(clearance: float = 0.2) -> Part:
    """Return a round peg with three lugs that pass through slots and turn by 40 degrees under a ring."""
    lugs = [_square(3.0, 3.0, 6.0).rotate(120.0 * i) for i in range(3)]
    plug = _shaft(_disc(6.0), -12.0, 8.0)
    for lug in lugs:
        plug += _prism(lug, -11.0, -8.5)
    socket = _block(30.0, -14.0) - _hole(_disc(6.0), clearance, -12.2)
    half = np.rad2deg(np.arcsin((1.5 + clearance) / 6.0))
    arc = np.deg2rad(np.linspace(-40.0 - half, half, 13))
    sector = CrossSection(
        [[(0.0, 0.0), *((np.hypot(7.5, 1.5) + 2 * clearance) * np.stack([np.cos(arc), np.sin(arc)], axis=1))]]
    )
    for i, lug in enumerate(lugs):
        socket -= _hole(lug.rotate(-40.0), clearance, -11.0 - clearance)
        socket -= _prism(sector.rotate(120.0 * i), -11.0 - clearance, -8.5 + clearance)
    return Part([plug], [socket], clearance, ["--turn", "40"])


def snap_fit(clearance: float = 0.2) -> Part:
    """Return a square peg with two elastic noses, which are separate bodies and snap under the socket's lips."""
    outline = _square(8.0, 8.0)
    noses = [
        Manifold.hull_points(
            [(s * x, y, z) for y in (-2.0, 2.0) for x, z in ((3.0, -8), (4.0, -8), (4.4, -7.0), (4.0, -6), (3.0, -6))]
        )
        for s in (-1.0, 1.0)
    ]
    socket = _block(26.0, -16.0) - _hole(outline, clearance, -12.0)
    for s in (-1.0, 1.0):
        socket -= _prism(_square(2.0, 6.0, s * 4.5), -12.0, -5.0)
    return Part([_shaft(outline, -12.0, 8.0), *noses], [socket], clearance)


def dovetail(clearance: float = 0.15) -> Part:
    """Return a dovetail tongue and its slot, whose walls are at 60 degrees to the open side."""
    # Walls at 60 degrees that are offset by w along their normal move by 2 w along y, so that half a chamfer suffices.
    chamfer = 0.5 * CHAMFER
    wide = 3.0 + 5.0 / np.sqrt(3.0)
    tongue = CrossSection([[(-3.0, 0.0), (3.0, 0.0), (wide, 5.0), (-wide, 5.0)]])
    slot = _offset(tongue, clearance)
    plug = _shaft(tongue, -15.0, 8.0, chamfer) + _prism(_square(14.0, 5.0, 0.0, -2.4), -15.0, 8.0)
    # The slot is open to the side of the plug's plate.
    block = _prism(_square(24.0, 12.0, 0.0, 6.0 + 0.1 + clearance), -19.0, 0.0)
    block -= _prism(slot, -15.0, 0.01)
    block -= Manifold.batch_hull(
        [_prism(slot, -chamfer, -chamfer + 0.01), _prism(_offset(tongue, clearance + chamfer), 0.0, 0.01)]
    )
    return Part([plug], [block], clearance)


def screw(clearance: float = 0.3, pitch: float = 8.0) -> Part:
    """Return a shaft with a quarter turn of a right-handed thread, which is in its groove for the last half turn."""

    def ridge(start: float, end: float, offset: float) -> Manifold:
        angles = np.deg2rad(np.linspace(start, end, round((end - start) / 15.0) + 1))[:, None]
        r = np.array([4.0, 7.0 + offset, 7.0 + offset, 4.0])
        z = np.array([-1.2 - offset, -0.5 - offset, 0.5 + offset, 1.2 + offset]) + pitch * angles / (2.0 * np.pi)
        vertices = np.stack([r * np.cos(angles), r * np.sin(angles), z], axis=2).reshape(-1, 3)
        a = 4 * np.arange(len(angles) - 1)[:, None] + np.arange(4)
        b = 4 * (a // 4) + (a + 1) % 4
        sides = np.stack([a, a + 4, b, b, a + 4, b + 4], axis=2).reshape(-1, 3)
        last = len(vertices) - 4
        ends = [[0, 1, 2], [0, 2, 3], [last, last + 2, last + 1], [last, last + 3, last + 2]]
        return Manifold(Mesh(vertices.astype(np.float32), np.concatenate([sides, ends]).astype(np.uint32)))

    plug = _shaft(_disc(5.0), -14.0, 8.0, 0.2) + ridge(0.0, 90.0, 0.0).translate((0.0, 0.0, -4.0))
    socket = _block(30.0, -16.0) - _hole(_disc(5.0), clearance, -14.0)
    socket -= ridge(-15.0, 360.0, clearance).translate((0.0, 0.0, -4.0))
    return Part([plug], [socket], clearance, ["--turn", "-180", "--pitch", f"{pitch:g}"])


def hexagon(clearance: float = 0.15) -> Part:
    """Return a hexagonal peg that seats on the hole's bottom."""
    return _peg([_disc(6.0, 6)], clearance, -12.0)


def reuleaux_triangle(clearance: float = 0.15) -> Part:
    """Return a peg with the outline of a Reuleaux triangle, which has the same width in every direction."""
    corners = 7.0 / np.sqrt(3.0) * np.array([(np.cos(a), np.sin(a)) for a in np.deg2rad((90.0, 210.0, 330.0))])
    discs = [_disc(7.0, 2 * SIDES).translate(tuple(corner)) for corner in corners]
    return _peg([discs[0] ^ discs[1] ^ discs[2]], clearance, -12.0)


def oval(clearance: float = 0.1) -> Part:
    """Return a peg with two flat and two round sides and a head that seats on the socket's face."""
    outline = CrossSection.batch_hull([_disc(3.0, 16).translate((x, 0.0)) for x in (-4.0, 4.0)])
    plug = _shaft(outline, -10.0, 0.0) + _prism(_square(20.0, 12.0), 0.0, 6.0)
    return Part([plug], [_block(30.0, -14.0) - _hole(outline, clearance, -11.0)], clearance)


def cross(clearance: float = 0.2) -> Part:
    """Return a peg with the outline of a plus."""
    return _peg([_square(14.0, 4.0), _square(4.0, 14.0)], clearance, -12.0)


def l_profile(clearance: float = 0.2) -> Part:
    """Return a peg with the outline of an L, whose axis is near its inner corner."""
    return _peg([_square(12.0, 4.0, 2.0, -2.0), _square(4.0, 12.0, -2.0, 2.0)], clearance, -12.0)


def two_prongs(clearance: float = 0.2) -> Part:
    """Return a head with two flat prongs, of which one is wider."""
    return _headed([_square(2.0, 6.0, -6.0), _square(2.0, 8.0, 6.0)], clearance, -12.0)


def four_pins(clearance: float = 0.2) -> Part:
    """Return a head with four round pins, of which one is off the corner of a square."""
    pins = [_disc(1.5, 12).translate(center) for center in ((5.0, 5.0), (-5.0, 5.0), (-5.0, -5.0), (3.5, -5.0))]
    return _headed(pins, clearance, -9.0)


def shell_connector(clearance: float = 0.15) -> Part:
    """Return a trapezoidal shell with an off-center key, around a tongue; socket and tongue have wide lead-ins."""
    outline = CrossSection([[(-5.0, -3.0), (5.0, -3.0), (7.0, 3.0), (-7.0, 3.0)]])
    key, core = _square(2.0, 2.0, 3.0, 3.0), _offset(outline, -1.2)
    shell = _shaft(outline, -9.0, 6.0) + _shaft(key, -9.0, 6.0)
    widened = Manifold.batch_hull([_prism(core, -8.4, -8.39), _prism(_offset(core, 0.6), -9.01, -9.0)])
    plug = shell - _prism(core, -9.01, -1.0) - widened
    tongue_outline = _offset(core, -clearance)
    tip = _prism(_offset(tongue_outline, -0.8), -2.01, -2.0)
    tongue = Manifold.batch_hull([_prism(tongue_outline, -9.5, -2.8), tip])
    cavity = _hole(outline, clearance, -9.0) + _hole(key, clearance, -9.0)
    return Part([plug], [_block(28.0, -13.0) - cavity + tongue], clearance)


PARTS: dict[str, Callable[[], Part]] = {
    "keyed_peg": keyed_peg,
    "square_peg": square_peg,
    "d_connector": d_connector,
    "bayonet": bayonet,
    "snap_fit": snap_fit,
    "dovetail": dovetail,
    "hexagon": hexagon,
    "reuleaux_triangle": reuleaux_triangle,
    "oval": oval,
    "cross": cross,
    "l_profile": l_profile,
    "two_prongs": two_prongs,
    "four_pins": four_pins,
    "shell_connector": shell_connector,
}
"""Functions that return the parts, by name; `screw` is used separately."""
