"""What belongs into a picture of a task besides the robot: demonstrations, constraints, and where to look from."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

Camera = tuple[tuple[float, float, float], tuple[float, float, float]]


@dataclass(frozen=True)
class Scene:
    """How a task is drawn, in metres."""

    to_world: Callable[[np.ndarray], np.ndarray]  # poses (n, O) of a trace or a demonstration to points (n, 3)
    demonstrations: tuple[np.ndarray, ...] = ()  # poses (N, O) of each
    constraint: tuple[np.ndarray, ...] = ()  # corner points (k, 3) of each line that bounds what is allowed
    camera: Camera | None = None  # where to look from, and where to look at
    # The same where a whole arm does it, by name; a page opens with the first and offers them all.
    arm_views: Mapping[str, Camera] = field(default_factory=dict)
    line_radius: float = 0.0015  # of a path


def scene(task: str) -> Scene:
    """The scene of a task; of one that is not known here, the measured positions as they are."""
    return SCENES.get(task, _plain)()


def _plain() -> Scene:
    return Scene(to_world=_in_plane)


def _in_plane(poses: np.ndarray) -> np.ndarray:
    """(x, y) at height zero, or the position of a pose of six numbers."""
    poses = np.asarray(poses)
    if poses.shape[1] >= 3:
        return poses[:, :3]
    return np.column_stack([poses, np.zeros(len(poses))])


def _narrow_passage() -> Scene:
    from guiderail.models.demonstrations import narrow_passage
    from guiderail.models.objects.narrow_passage import NarrowPassage

    world = NarrowPassage()
    edge = np.array([[world.zone_x, -0.1, 0.0], [world.zone_x, 1.1, 0.0]])
    return Scene(
        to_world=_in_plane,
        demonstrations=tuple(narrow_passage.load().outputs),
        constraint=(edge,),
        camera=((0.4, 0.3, 0.85), (0.4, 0.48, 0.0)),
    )


ARM_VIEW: Camera = ((1.05, -0.75, 0.55), (0.42, 0.0, 0.32))
TOOL_VIEW: Camera = ((0.62, -0.085, 0.19), (0.55, 0.0, 0.172))


def _bnc_connector() -> Scene:
    from guiderail.diagrams.stations.bnc_workcell import BncWorkcell
    from guiderail.diagrams.tasks.bnc_connector import ALIGNMENT
    from guiderail.models.demonstrations import bnc_connector

    X_WT = BncWorkcell().X_WT

    def to_world(poses: np.ndarray) -> np.ndarray:
        return X_WT.multiply(np.asarray(poses)[:, :3].T).T

    eye, target = to_world(np.array([[0.025, -0.035, 0.026], [0.0, 0.0, 0.012]]))
    near: Camera = (tuple(eye.tolist()), tuple(target.tolist()))
    return Scene(
        to_world=to_world,
        demonstrations=tuple(bnc_connector.load().outputs),
        constraint=tuple(map(to_world, _cuboid(ALIGNMENT, 0.0, 0.015))),
        camera=near,
        arm_views={"the tool": TOOL_VIEW, "the connector": near, "the arm": ARM_VIEW},
        line_radius=0.0001,
    )


def _grid_clamp() -> Scene:
    from guiderail.diagrams.stations.grid_clamp_workcell import GridClampWorkcell
    from guiderail.diagrams.tasks.grid_clamp import make_skill

    X_WT, parameters = GridClampWorkcell().X_WT, make_skill().parameters

    def to_world(poses: np.ndarray) -> np.ndarray:
        return X_WT.multiply(np.asarray(poses)[:, :3].T).T

    cuboid = _cuboid(0.5 * parameters["width_m"], -parameters["push_m"], 0.025)  # as high as the clamp begins
    eye, target = to_world(np.array([[0.07, -0.1, 0.05], [0.0, 0.0, 0.008]]))
    near: Camera = (tuple(eye.tolist()), tuple(target.tolist()))
    return Scene(
        to_world=to_world,
        constraint=tuple(map(to_world, cuboid)),
        camera=near,
        arm_views={"the clamp": near, "the arm": ARM_VIEW},
        line_radius=0.0001,
    )


def _pouring() -> Scene:
    from guiderail.diagrams.stations.pouring import PouringConfig

    X_WT = PouringConfig().X_WT
    centre = X_WT.translation()

    def to_world(poses: np.ndarray) -> np.ndarray:
        return X_WT.multiply(np.asarray(poses)[:, :3].T).T

    return Scene(to_world, camera=(tuple(centre + [0.25, -0.5, 0.25]), tuple(centre)), line_radius=0.001)


def _cuboid(half_width: float, low: float, high: float) -> list[np.ndarray]:
    """The edges (2, 3) of a cuboid about the z axis: a path that turned sharply would be drawn as a twisted tube."""
    corners = half_width * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]])
    rings = [np.column_stack([corners, np.full(5, height)]) for height in (low, high)]
    sides = [ring[i : i + 2] for ring in rings for i in range(4)]
    return [*sides, *(np.array([[x, y, low], [x, y, high]]) for x, y in corners[:4])]


SCENES: dict[str, Callable[[], Scene]] = {
    "BncConnector": _bnc_connector,
    "GridClamp": _grid_clamp,
    "NarrowPassage": _narrow_passage,
    "Pouring": _pouring,
}
