"""A browser view of an environment, which ends with it."""

from pydrake.geometry import Meshcat, MeshcatVisualizer
from pydrake.systems.framework import Context, EventStatus, OutputPort

from guiderail.diagrams.cameras import PUBLISH_PERIOD, open_meshcat


class View:
    """Publishes a scene from beside the diagram that simulates it.

    A diagram with Python in it is never freed, and whatever publishes from inside it would keep its port, its thread
    and its descriptors as long. A view is nobody's subsystem: they are given back when nobody has it any more.

    Attributes:
        meshcat: the page.
    """

    meshcat: Meshcat

    def __init__(self, query: OutputPort, meshcat: Meshcat | None = None):
        """
        Args:
            query: of a scene graph inside a diagram.
            meshcat: a page that is there already; a new one unless given.

        Raises:
            InputError: if the environment forbids Drake to open a port at all.
        """
        self._query = query
        visualizer: MeshcatVisualizer
        self.meshcat, visualizer = open_meshcat(meshcat)
        self._visualizer = visualizer
        self._context = visualizer.CreateDefaultContext()
        self._published = -1.0  # s, when it was last

    def follow(self, context: Context) -> EventStatus:
        """Publishes often enough for the eye; a `Simulator`'s monitor, called with the root context."""
        elapsed = context.get_time() - self._published
        # The clock of an episode begins anew; steps of the simulation are far longer than what rounding makes of them.
        if elapsed < 0 or elapsed > PUBLISH_PERIOD - 1e-6:
            self.publish(context)
        return EventStatus.DidNothing()

    def publish(self, context: Context) -> None:
        """Shows what a root context says."""
        self._published = context.get_time()
        self._context.SetTime(self._published)
        scene = self._query.Eval(self._query.get_system().GetMyContextFromRoot(context))
        self._visualizer.query_object_input_port().FixValue(self._context, scene)
        self._visualizer.ForcedPublish(self._context)
