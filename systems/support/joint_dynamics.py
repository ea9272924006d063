"""Inertia and velocity-dependent torques of an arm."""

import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import Context


class JointDynamics:
    """Mass matrix and torques of Coriolis forces and joint damping.

    Args:
        plant: Model of the arm and its payload alone, finalized.
    """

    def __init__(self, plant: MultibodyPlant):
        joints = [plant.get_joint(index) for index in plant.GetJointIndices()]
        self._plant, self._damping = plant, np.concatenate([joint.default_damping_vector() for joint in joints])

    def evaluate(self, plant_context: Context) -> tuple[np.ndarray, np.ndarray]:
        """Return the mass matrix (n, n) and the torques (n,) [Nm] in the state of the plant's context."""
        drag = self._plant.CalcBiasTerm(plant_context) + self._damping * self._plant.GetVelocities(plant_context)
        return self._plant.CalcMassMatrix(plant_context), drag
