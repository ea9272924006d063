"""MuJoCo as the physics engine of a gantry."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from guiderail.models.common.errors import import_extra
from guiderail.models.common.transforms import POSE_SIZE
from guiderail_mujoco.gantry import DivergedError, Input

if TYPE_CHECKING:
    import mujoco
    from pydrake.math import RigidTransform


class _Nominal(NamedTuple):
    """Nominal values of the model parameters that `Input` scales; the names are MuJoCo's."""

    timestep: float
    geom_friction: np.ndarray
    jnt_stiffness: np.ndarray
    dof_damping: np.ndarray
    geom_solref: np.ndarray


class MujocoEngine:
    """MuJoCo as an `Engine`. Its state contains positions, velocities and the warm start of the solver.

    The engine's automatic reset after a divergence is disabled, because it would move the tool to the target.
    """

    name = "MuJoCo"

    def __init__(self, model: mujoco.MjModel):
        """Construct the engine.

        Args:
            model: Model with bodies `fixture` and `workpiece`, whose first six joints and motors move the tool; the
                engine writes to it.
        """
        self._mujoco = import_extra("mujoco")
        model.opt.disableflags |= int(self._mujoco.mjtDisableBit.mjDSBL_AUTORESET)
        # Scratch memory: every update first writes all values that it reads, so `_data` keeps no state between updates.
        self.model, self._data = model, self._mujoco.MjData(model)
        # Warnings of divergence and of a full buffer: the engine ignores contacts and constraints that exceed a buffer.
        failures = ("BADQPOS", "BADQVEL", "BADQACC", "BADCTRL", "CONTACTFULL", "CNSTRFULL")
        self._failures = [self._mujoco.mjtWarning.__members__[f"mjWARN_{name}"].value for name in failures]
        # Stored parts of the engine's state, including the warm start, so that a restored state continues identically.
        self._parts = self._mujoco.mjtState.mjSTATE_INTEGRATION
        self._fixture, self._workpiece = (model.body(name).id for name in ("fixture", "workpiece"))
        self.time_step = float(model.opt.timestep)
        self.state_size = self._mujoco.mj_stateSize(model, self._parts)
        # The state of the engine starts with time, positions and velocities.
        self.positions = slice(1, 1 + POSE_SIZE)
        self.speeds = slice(1 + model.nq, 1 + model.nq + model.nv)
        names = _Nominal._fields[1:]
        self._nominal = _Nominal(self.time_step, *(getattr(model, name).copy() for name in names))

    def at_rest(self, pose: np.ndarray) -> np.ndarray:
        """Return the state with the tool at rest at `pose` (6,)."""
        self._mujoco.mj_resetData(self.model, self._data)
        self._data.qpos[:POSE_SIZE] = pose
        return self._engine_state()

    def _engine_state(self) -> np.ndarray:
        state = np.empty(self.state_size)
        self._mujoco.mj_getState(self.model, self._data, state, self._parts)
        return state

    def advance(self, state: np.ndarray, given: Input, num_steps: int) -> tuple[np.ndarray, np.ndarray, float]:
        """Return state, contact wrenches and actual time step; see `Engine`."""
        model, data = self.model, self._data
        self._place(given.X_TFixture, given.X_PWorkpiece)
        num_substeps = self._scale_contact(given.friction, given.modulus)
        self._mujoco.mj_setState(model, data, state, self._parts)
        data.ctrl[:POSE_SIZE] = given.desired_pose
        # Warning counts start at 1, because at 0 the engine would write a log file to the working directory at the
        # first warning.
        for warning in self._failures:
            data.warning[warning].number = 1
        generalized, axes = [], []
        for _ in range(num_substeps * num_steps):
            self._mujoco.mj_step(model, data)
            generalized.append(data.qfrc_constraint[:POSE_SIZE].copy())
            axes.append(data.xaxis[3:POSE_SIZE].copy())
        self._check_warnings()
        return self._engine_state(), _contact_wrenches(np.array(generalized), np.array(axes)), model.opt.timestep

    def _check_warnings(self) -> None:
        numbers = self._data.warning.number[self._failures]
        if numbers.max() > 1:
            warning = self._failures[int(numbers.argmax())]
            about = int(self._data.warning[warning].lastinfo)
            raise DivergedError(f"the simulation failed in MuJoCo: {self._mujoco.mju_warningText(warning, about)}")

    def _place(self, X_TFixture: RigidTransform, X_PWorkpiece: RigidTransform) -> None:
        for body, X in ((self._fixture, X_TFixture), (self._workpiece, X_PWorkpiece)):
            self.model.body_pos[body] = X.translation()
            self.model.body_quat[body] = X.rotation().ToQuaternion().wxyz()

    def _scale_contact(self, friction: float, modulus: float) -> int:
        """Scale the model's contact parameters and return the number of substeps that replace one step.

        With the substeps, the engine can integrate stiffer springs. The time constant of a contact is at least two
        substeps. The damping of stiffer springs is increased so that their damping ratio is constant.
        """
        model, nominal = self.model, self._nominal
        num_substeps = max(math.ceil(math.sqrt(modulus) - 1e-9), 1)
        model.opt.timestep = nominal.timestep / num_substeps
        model.geom_friction[:] = nominal.geom_friction * friction
        model.jnt_stiffness[:] = nominal.jnt_stiffness * modulus
        model.dof_damping[:] = nominal.dof_damping * math.sqrt(max(modulus, 1.0))
        constants = nominal.geom_solref[:, 0] / math.sqrt(modulus)
        model.geom_solref[:, 0] = np.maximum(constants, 2.0 * model.opt.timestep)
        return num_substeps


def _contact_wrenches(generalized: np.ndarray, axes: np.ndarray) -> np.ndarray:
    """Return the wrenches (N, 6) of generalized contact forces (N, 6) on joints with the axes (N, 3, 3) of the hinges.

    The prismatic joints are along the axes of T. For a torque t, the generalized force of a hinge about an axis a is
    a · t.
    """
    return np.hstack([generalized[:, :3], np.linalg.solve(axes, generalized[:, 3:, None])[..., 0]])
