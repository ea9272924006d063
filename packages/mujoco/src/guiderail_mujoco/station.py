"""Gantry station in another physics engine, to evaluate skills with another contact model than Drake's; MuJoCo's."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import Field
from pydrake.geometry import SceneGraph
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import BodyIndex, FixedOffsetFrame, PrismaticJoint, SpatialInertia
from pydrake.systems.framework import Context, DiagramBuilder

from guiderail.diagrams.envs.options import Number
from guiderail.diagrams.stations.gantry import CARRIAGE_INERTIA, CARRIAGE_MASS, GANTRY_JOINTS, joint_damping
from guiderail.diagrams.stations.impedance_control import add_joint_impedance
from guiderail.diagrams.stations.options import ContactOptions
from guiderail.diagrams.stations.registry import register_station
from guiderail.diagrams.stations.station import (
    CONTROL_PERIOD,
    WRENCH_TIME_CONSTANT,
    Impedance,
    Station,
    check_pose,
    exact_periods,
)
from guiderail.diagrams.stations.workcell import Cylinder, Hull, Surface, Workcell
from guiderail.diagrams.wiring import add_system
from guiderail.models.common.errors import InputError, import_extra
from guiderail.models.common.transforms import POSE_SIZE
from guiderail_mujoco.gantry import Engine, EngineGantry, MovedBodies
from guiderail_mujoco.mujoco_engine import MujocoEngine
from guiderail_mujoco.surfaces import prism, surfaces_of

if TYPE_CHECKING:
    import mujoco


FIXTURE, TOOL, WORKPIECE = "fixture", "tool", "workpiece"
"""Names of the model's bodies. The workpiece is the tool's child; the first six joints of the model are the tool's."""

CENTERED: dict[str, Any] = {"ipos": [0.0, 0.0, 0.0], "explicitinertial": True}  # center of mass at a body's origin
MakeEngine = Callable[[list[Surface], list[Surface], SpatialInertia, Impedance, float], Engine]
"""Function from the surfaces of fixture and workpiece, the workpiece's inertia, the impedance and the station's time
step [s] to an engine."""

LONGEST_STEP = CONTROL_PERIOD / 5
"""Longest default time step of a station [s]. The engine integrates the governed spring over it, so that a step from
rest must not make the tool faster than F / c (`slow_down`): v = F (1 − exp(−D h / m)) / D is 0.91 F / c for the
smallest mass m = 1.5 kg and the default damping D. Half of `CONTROL_PERIOD` would permit 1.9 F / c."""

MAX_PAIRS = 31  # number of bits of a contact mask, a signed integer of 32 bits, without the sign


@dataclass(frozen=True)
class MujocoContact:
    """Parameters of MuJoCo's contact and integration, equal for all objects."""

    time_step: float = 0.001  # time step of the engine [s], rounded so that the station's time step is a multiple of it
    time_constant: float = 0.002  # time constant of a contact [s]; the engine needs at least two time steps
    impedance: float = 0.95  # constraint impedance of a contact, between 0 and 1
    # Stiffness of friction relative to the normal direction; reduces creep of sticking contacts.
    friction_ratio: float = 10.0
    # Product of a spring's natural frequency and the time step. It determines the mass of the spring's body, which must
    # be heavy enough for explicit integration.
    spring_step: float = 1.0


def mujoco_model(
    fixture: list[Surface],
    workpiece: list[Surface],
    inertia: SpatialInertia,
    impedance: Impedance,
    period: float,
    contact: MujocoContact,
) -> mujoco.MjModel:
    """Return the compiled model. Its world frame is the target frame T, so the first six joint positions are the pose.

    The surfaces of a body, and the workpiece's inertia, are in the body's frame. Products of inertia about the center
    of mass are neglected. The engine's time step divides the station's `period` [s].

    Raises:
        InputError: If MuJoCo is not installed, or the surfaces have more pairs than a contact mask has bits.
    """
    mujoco = import_extra("mujoco")
    masks = contact_masks((*fixture, *workpiece))
    spec = mujoco.MjSpec()
    spec.modelname = "workcell"
    spec.compiler.autolimits = True
    spec.compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_FALSE
    option = spec.option
    option.timestep = period / max(round(period / contact.time_step), 1)
    option.gravity = [0.0, 0.0, 0.0]  # as in Drake's gantry station
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    option.impratio = contact.friction_ratio
    option.solver = mujoco.mjtSolver.mjSOL_NEWTON
    option.iterations, option.tolerance = 100, 1e-10
    option.ccd_iterations = 100  # enough for the largest hulls

    # The tool is added first, so that its joints are the first.
    tool = spec.worldbody.add_body(name=TOOL, mass=CARRIAGE_MASS, inertia=[CARRIAGE_INERTIA] * 3, **CENTERED)
    _add_gantry(mujoco, spec, tool, impedance)
    moments = inertia.Shift(inertia.get_com()).CalcRotationalInertia().get_moments()
    workpiece_body = tool.add_body(
        name=WORKPIECE, mass=inertia.get_mass(), inertia=moments, ipos=inertia.get_com(), explicitinertial=True
    )
    fixture_body = spec.worldbody.add_body(name=FIXTURE)
    for surface in workpiece:
        _add_surface(mujoco, spec, workpiece_body, surface, {"contype": masks[surface.pair], "conaffinity": 0}, contact)
    for surface in fixture:
        _add_surface(mujoco, spec, fixture_body, surface, {"contype": 0, "conaffinity": masks[surface.pair]}, contact)
    return spec.compile()


def mujoco_parts(
    fixture: list[Surface], workpiece: list[Surface], contact: MujocoContact
) -> tuple[ET.Element, ET.Element, list[ET.Element]]:
    """Return MJCF elements of fixture and workpiece for another model, and the assets that they need.

    Their contact masks leave the first bit, MuJoCo's default, to the other model.

    Raises:
        InputError: As `mujoco_model`.
    """
    mujoco = import_extra("mujoco")
    masks = contact_masks((*fixture, *workpiece), first_bit=1)
    spec = mujoco.MjSpec()
    spec.option.timestep = contact.time_step
    for name, surfaces, side in ((FIXTURE, fixture, "conaffinity"), (WORKPIECE, workpiece, "contype")):
        body = spec.worldbody.add_body(name=name, mass=1e-3, inertia=[1e-7] * 3, **CENTERED)
        for surface in surfaces:
            bits = {"contype": 0, "conaffinity": 0} | {side: masks[surface.pair]}
            _add_surface(mujoco, spec, body, surface, bits, contact)
    spec.compile()
    root = ET.fromstring(spec.to_xml())
    bodies = {body.get("name"): body for body in root.iter("body")}
    return bodies[FIXTURE], bodies[WORKPIECE], list(root.findall("asset/*"))


def contact_masks(surfaces: Sequence[Surface], first_bit: int = 0) -> dict[str, int]:
    """Return a contact mask of one bit for each pair of surfaces, by the name of the pair."""
    pairs = sorted({surface.pair for surface in surfaces})
    if len(pairs) > (most := MAX_PAIRS - first_bit):
        raise InputError(f"the engines distinguish at most {most} pairs of surfaces, and the workcell has {len(pairs)}")
    return {pair: 1 << bit for bit, pair in enumerate(pairs, first_bit)}


def _add_gantry(mujoco: Any, spec: Any, tool: Any, impedance: Impedance) -> None:
    for (name, joint_type, axis), stiffness, damping, limit in zip(
        GANTRY_JOINTS, impedance.stiffness, joint_damping(impedance), impedance.limits, strict=True
    ):
        slides = joint_type is PrismaticJoint
        tool.add_joint(
            name=name, axis=axis, type=mujoco.mjtJoint.mjJNT_SLIDE if slides else mujoco.mjtJoint.mjJNT_HINGE
        )
        motor = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        motor.gaintype, motor.biastype = mujoco.mjtGain.mjGAIN_FIXED, mujoco.mjtBias.mjBIAS_AFFINE
        motor.gainprm[0] = stiffness  # force = clip(k (u − q) − d q', ± limit)
        motor.biasprm[1], motor.biasprm[2] = -stiffness, -damping
        motor.forcelimited, motor.forcerange = mujoco.mjtLimited.mjLIMITED_TRUE, [-limit, limit]


def _add_surface(mujoco: Any, spec: Any, body: Any, surface: Surface, masks: Any, contact: MujocoContact) -> None:
    spring = surface.spring
    if spring is not None:
        mass = spring.stiffness * (spec.option.timestep / contact.spring_step) ** 2
        body = body.add_body(name=surface.name, mass=mass, inertia=[1e-7] * 3, **CENTERED)
        body.add_joint(
            name=surface.name,
            type=mujoco.mjtJoint.mjJNT_SLIDE,
            axis=spring.axis,
            stiffness=spring.stiffness,
            damping=np.sqrt(spring.stiffness * mass),
        )
    shape, half = surface.shape, 0.5 * surface.pitch
    if isinstance(shape, Hull | Cylinder):
        mesh = spec.add_mesh(name=surface.name, inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX)
        vertices = shape.vertices if isinstance(shape, Hull) else prism(shape)
        mesh.uservert = vertices.ravel().tolist()
        kind: dict[str, Any] = {"type": mujoco.mjtGeom.mjGEOM_MESH, "meshname": surface.name}
    else:
        kind = {"type": mujoco.mjtGeom.mjGEOM_BOX, "size": [shape.x / 2, shape.y / 2, shape.z / 2]}
    body.add_geom(
        name=surface.name,
        pos=surface.position,
        quat=[np.cos(half), 0.0, np.sin(half), 0.0],
        condim=3,
        friction=[surface.friction, 0.0, 0.0],
        solref=[contact.time_constant, 1.0],
        solimp=[contact.impedance, contact.impedance, 1e-4, 0.5, 2.0],
        **kind,
        **masks,
    )


class EngineOptions(ContactOptions):
    """Options of a station in another physics engine."""

    engine_step: Number | None = Field(
        None, gt=0, description="time step of the physics engine [s], rounded so that it divides time_step"
    )


class EngineStation(Station):
    """`GantryStation` in another physics engine, with the same ports, joints, impedance, watchdog and filter.

    A Drake plant without joints and time step contains the visual geometry and the poses of fixture and workpiece. A
    reset sets these poses in the plant's context.
    """

    def __init__(
        self,
        name: str,
        make_engine: MakeEngine,
        workcell: Workcell,
        impedance: Impedance,
        time_step: float | None,
        control_period: float,
    ):
        """Construct the station `name`; `make_engine` returns its engine.

        The other arguments and errors are those of `MujocoStation`.
        """
        super().__init__()
        time_step = control_period / math.ceil(control_period / LONGEST_STEP - 1e-9) if time_step is None else time_step
        control_period, time_step = exact_periods(control_period, time_step)
        self.control_period = control_period
        surfaces = surfaces_of(workcell)
        builder = DiagramBuilder()
        self.scene_graph = builder.AddSystem(SceneGraph())
        self.plant = plant = builder.AddNamedSystem("plant", MultibodyPlant(0.0))
        moved = _add_workcell(plant, self.scene_graph, workcell, name)
        inertia = moved.workpiece.CalcSpatialInertiaInBodyFrame(plant.CreateDefaultContext())
        engine = make_engine(*surfaces, inertia, impedance, time_step)
        self._time_step = time_step
        self.gantry = gantry = EngineGantry(
            engine, impedance, plant, moved, workcell.X_WT, time_step, WRENCH_TIME_CONSTANT
        )
        add_system(builder, "gantry", gantry, nominal_body_poses=plant.get_body_poses_output_port())
        desired_pose = add_joint_impedance(
            builder,
            impedance,
            damping=joint_damping(impedance),
            mass=CARRIAGE_MASS + inertia.get_mass(),
            time_step=time_step,
            pose=gantry.get_pose_output_port(),
            state=gantry.get_state_output_port(),
            wrench=gantry.get_wrench_output_port(),
            impedance_wrench=gantry.get_impedance_wrench_output_port(),
            control_period=control_period,
        )
        builder.Connect(desired_pose, gantry.get_desired_pose_input_port())
        builder.Connect(
            gantry.get_geometry_poses_output_port(), self.scene_graph.get_source_pose_port(plant.get_source_id())
        )
        builder.ExportOutput(self.scene_graph.get_query_output_port(), "query")
        builder.ExportOutput(gantry.get_body_poses_output_port(), "body_poses")
        builder.BuildInto(self)

    @property
    def time_step(self) -> float:
        """Period of inputs and outputs [s]; the control period is a multiple of it."""
        return self._time_step

    def set_pose(self, context: Context, pose: np.ndarray) -> None:
        """Put the tool at rest at `pose`, (6,); `context` is the root context."""
        self.gantry.set_pose(self.gantry.GetMyMutableContextFromRoot(context), check_pose(pose, POSE_SIZE))

    def set_contact(self, context: Context, friction: float, modulus: float) -> None:
        """Scale friction coefficients by `friction`, and the stiffness of contacts and springs by `modulus`.

        `context` is the root context.
        """
        self.gantry.set_contact(self.gantry.GetMyMutableContextFromRoot(context), friction, modulus)


@register_station("mujoco", workcell_kind="insertion", options=EngineOptions)
class MujocoStation(EngineStation):
    """`GantryStation` in MuJoCo, with the same ports, joints, impedance, watchdog and filter."""

    def __init__(
        self,
        workcell: Workcell,
        impedance: Impedance = Impedance(),  # noqa: B008 (frozen)
        time_step: float | None = None,
        contact: MujocoContact = MujocoContact(),
        control_period: float = CONTROL_PERIOD,
        engine_step: float | None = None,
    ):
        """Construct the station.

        Args:
            workcell: Fixture in the world and held workpiece.
            impedance: Impedance at the tool center.
            time_step: Period of inputs and outputs [s]; at most `LONGEST_STEP` by default. The engine steps faster.
            contact: Parameters of contact and integration.
            control_period: Time between commands [s], a whole multiple of the time step.
            engine_step: Time step of the engine [s] instead of that of `contact`.

        Raises:
            InputError: If MuJoCo is not installed, the workcell is not described by convex solids, its fixture has more
                than one body, its surfaces have more than `MAX_PAIRS` pairs, or the control period is no multiple of
                the time step.
        """
        contact = contact if engine_step is None else replace(contact, time_step=engine_step)
        super().__init__(
            "mujoco",
            lambda fixture, held, inertia, impedance, period: MujocoEngine(
                mujoco_model(fixture, held, inertia, impedance, period, contact)
            ),
            workcell, impedance, time_step, control_period,
        )  # fmt: skip


def constraint_torques(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    """Return the generalized force of contacts and joint limits on the model (nv,), without joint friction.

    MuJoCo's own sum, `qfrc_constraint`, includes joint friction.
    """
    engine = import_extra("mujoco")
    force = np.where(data.efc_type == engine.mjtConstraint.mjCNSTR_FRICTION_DOF, 0.0, data.efc_force)
    result = np.zeros(model.nv)
    engine.mj_mulJacTVec(model, data, result, force)
    return result


def _add_workcell(plant: MultibodyPlant, scene_graph: SceneGraph, workcell: Workcell, station: str) -> MovedBodies:
    """Add fixture, tool and workpiece to a plant without joints, and finalize it."""
    plant.RegisterAsSourceForSceneGraph(scene_graph)
    workcell.add_fixture(plant)
    if plant.num_bodies() != 2:  # world and fixture
        raise InputError(
            f"station={station!r} needs a fixture of one body, and that of {type(workcell).__name__} has "
            f"{plant.num_bodies() - 1}"
        )
    fixture = plant.get_body(BodyIndex(1))
    target = plant.AddFrame(FixedOffsetFrame("target", plant.world_frame(), workcell.X_WT))
    model = plant.AddModelInstance("gantry")
    tool = plant.AddRigidBody("tool_center", model, SpatialInertia.SolidSphereWithMass(1.0, 0.01))
    plant.WeldFrames(target, tool.body_frame())
    workpiece = workcell.add_workpiece(plant, tool.body_frame())
    plant.Finalize()
    return MovedBodies(fixture, tool, workpiece)
