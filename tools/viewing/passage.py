"""The narrow passage on paper: its walls, its zone, what stands in the way, and what was demonstrated."""

from matplotlib.axes import Axes
from matplotlib.patches import Circle, Rectangle

from guiderail.models.demonstrations import narrow_passage
from guiderail.models.objects.narrow_passage import NarrowPassage


def draw_world(axis: Axes, demonstrations: bool = True, *, named: bool = False) -> None:
    """Walls, zone, obstacle, goal and, in grey, what was demonstrated; `named`: each has a name for a legend."""
    world = NarrowPassage()
    zone, obstacle, goal, shown = ("forbidden zone", "obstacle", "goal", "demonstrated") if named else 4 * ("",)
    for lower, upper in zip(*world.walls, strict=True):
        axis.add_patch(Rectangle(tuple(lower), *(upper - lower), color="0.45", linewidth=0))
    axis.add_patch(Rectangle((world.zone_x, -1), 2, 3, color="firebrick", alpha=0.12, linewidth=0, label=zone))
    axis.axvline(world.zone_x, color="firebrick", linewidth=0.8)
    axis.add_patch(Circle(world.obstacle, world.obstacle_radius, color="saddlebrown", label=obstacle))
    axis.add_patch(Circle(world.goal, world.goal_radius, color="tab:green", alpha=0.4, label=goal))
    if demonstrations:
        for index, path in enumerate(narrow_passage.load().outputs):
            axis.plot(*path.T, color="0.75", linewidth=0.6, label="" if index else shown)
    axis.set(xlim=(0.1, 0.8), ylim=(0.0, 1.02), aspect="equal", xlabel="x [m]", ylabel="y [m]")
