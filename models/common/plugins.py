"""Plug-ins: one table of names and string targets, for this package, its siblings and installed packages.

`BUILT_IN` has the plug-ins of this package. Another package declares plug-ins in the group "guiderail" of its entry
points, as "KIND:NAME" = "module:attribute":

    [project.entry-points.guiderail]
    "station:mujoco" = "guiderail_mujoco.station:MujocoStation"

The kind learner_config names the class of a learner's settings in a module that does not import PyTorch, so that they
can be checked before this slow import.
"""

from collections.abc import Iterator
from importlib import metadata
from importlib.util import find_spec
from typing import Any

from guiderail.models.common.errors import InputError

GROUP = "guiderail"  # group of the entry points of all plug-ins
SIBLINGS = {
    "hardware": ("deploy", "train-on-robot", "teleoperate", "sim-driver", "safety-monitor"),
    "parts": ("create-task", "create-tasks"),
    "studies": ("study", "robustness", "converge", "certify", "report", "benchmark"),
    "data": ("dataset",),
    "lerobot": (),
    "mujoco": (),
    "cpp": (),
    "calibration": ("calibrate", "probe"),
}
"""Commands of each sibling distribution guiderail-NAME, by NAME, to name the distribution if it is not installed."""


_DIAGRAMS, _LEARNING, _ROBOTS = "guiderail.diagrams", "guiderail.tools.learning", "guiderail.models.robots"
BUILT_IN = {
    "task:BncConnector": f"{_DIAGRAMS}.tasks.bnc_connector:BncConnector",
    "task:GridClamp": f"{_DIAGRAMS}.tasks.grid_clamp:GridClamp",
    "task:NarrowPassage": f"{_DIAGRAMS}.tasks.narrow_passage:NarrowPassage",
    "task:Pouring": f"{_DIAGRAMS}.tasks.pouring:Pouring",
    "station:arm": f"{_DIAGRAMS}.stations.arm:ArmStation",
    "station:gantry": f"{_DIAGRAMS}.stations.gantry:GantryStation",
    "station:plane": f"{_DIAGRAMS}.stations.plane:PlaneStation",
    "station:pouring": f"{_DIAGRAMS}.stations.pouring:PouringStation",
    "guidance:kgrl": f"{_DIAGRAMS}.guidance.primitive:kgrl",
    "guidance:kmp": f"{_DIAGRAMS}.guidance.primitive:kmp",
    "guidance:none": f"{_DIAGRAMS}.guidance.sct:unguided",
    "guidance:residual": f"{_DIAGRAMS}.guidance.primitive:residual",
    "guidance:residual_cbf": f"{_DIAGRAMS}.guidance.primitive:residual_cbf",
    "guidance:residual_covariance": f"{_DIAGRAMS}.guidance.primitive:residual_covariance",
    "guidance:residual_tangent": f"{_DIAGRAMS}.guidance.primitive:residual_tangent",
    "guidance:safe_residual": f"{_DIAGRAMS}.guidance.primitive:safe_residual",
    "guidance:sct": f"{_DIAGRAMS}.guidance.sct:sct",
    "guidance:skgrl": f"{_DIAGRAMS}.guidance.primitive:skgrl",
    "robot:iiwa14": f"{_ROBOTS}.iiwa:IIWA14",
    "robot:panda": f"{_ROBOTS}.panda:PANDA",
    "robot:ur5e": f"{_ROBOTS}.ur5e:UR5E",
    "end_effector:connector_tool": f"{_ROBOTS}.end_effectors:CONNECTOR_TOOL",
    "end_effector:parallel_gripper": f"{_ROBOTS}.end_effectors:PARALLEL_GRIPPER",
    "kernel:matern52": "guiderail.models.primitives.kernels:Matern52",
    "kernel:squared_exponential": "guiderail.models.primitives.kernels:SquaredExponential",
    "learner:bc": f"{_LEARNING}.cloning:BcLearner",
    "learner:crossq": f"{_LEARNING}.off_policy:CrossQLearner",
    "learner:ppo": f"{_LEARNING}.on_policy:PpoLearner",
    "learner:sac": f"{_LEARNING}.off_policy:SacLearner",
    "learner:td3": f"{_LEARNING}.off_policy:Td3Learner",
    "learner:tqc": f"{_LEARNING}.off_policy:TqcLearner",
    "learner:trpo": f"{_LEARNING}.on_policy:TrpoLearner",
    "learner_config:bc": f"{_LEARNING}.learner_config:BcConfig",
    "learner_config:crossq": f"{_LEARNING}.learner_config:OffPolicyConfig",
    "learner_config:ppo": f"{_LEARNING}.learner_config:PpoConfig",
    "learner_config:sac": f"{_LEARNING}.learner_config:OffPolicyConfig",
    "learner_config:td3": f"{_LEARNING}.learner_config:OffPolicyConfig",
    "learner_config:tqc": f"{_LEARNING}.learner_config:OffPolicyConfig",
    "learner_config:trpo": f"{_LEARNING}.learner_config:OnPolicyConfig",
}
"""Plug-ins of this package: "module:attribute" by "kind:name"."""


def find_plugins(kind: str) -> Iterator[tuple[str, metadata.EntryPoint]]:
    """Yield the name and the entry point of each plug-in of a kind, those of this package first, without importing it.

    The entry points of this package belong to no distribution.
    """
    built_in = [metadata.EntryPoint(name, target, GROUP) for name, target in BUILT_IN.items()]
    for point in (*built_in, *metadata.entry_points(group=GROUP)):
        prefix, _, name = point.name.partition(":")
        if prefix == kind and name:
            yield name, point


def load_plugin(kind: str, name: str, sibling: str) -> Any:
    """Import a plug-in and return its object; `sibling` is the distribution that has it.

    Raises:
        MissingSiblingError: If there is no such plug-in.
    """
    for found, point in find_plugins(kind):
        if found == name:
            return point.load()
    raise MissingSiblingError(f"this {kind}", sibling)


def is_packaged(point: metadata.EntryPoint) -> bool:
    """Return True if an entry point belongs to guiderail or to a sibling distribution."""
    return point.dist is None or point.dist.name in {f"guiderail-{name}" for name in SIBLINGS}


def is_sibling_module(module: str) -> bool:
    """Return True if a module, given by its dotted name, belongs to guiderail or to one of its siblings."""
    top = module.partition(".")[0]
    return top == "guiderail" or top in {f"guiderail_{name}" for name in SIBLINGS}


def require_sibling(name: str, what: str) -> None:
    """Raise a MissingSiblingError unless the sibling distribution guiderail-NAME is installed; `what` needs it."""
    if find_spec(f"guiderail_{name}") is None:
        raise MissingSiblingError(what, name)


class MissingSiblingError(InputError):
    """Error for a feature of a sibling distribution that is not installed; the message has the line that installs it.

    Args:
        what: Feature that needs the distribution, such as "guiderail deploy".
        name: Name of the distribution, without "guiderail-".
    """

    def __init__(self, what: str, name: str):
        super().__init__(f'{what} needs guiderail-{name}, which is not installed: pip install "guiderail[{name}]"')
