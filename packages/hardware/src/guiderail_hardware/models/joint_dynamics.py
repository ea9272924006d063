"""Joint dynamics of an arm's model."""

import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import Context


class JointDynamics:
    """Mass matrix of an arm, and its joint torques of Coriolis forces and joint damping.

    Args:
        plant: Finalized model of only the arm and its payload.
    """

    def __init__(self, plant: MultibodyPlant):
        self._plant, self._damping = plant, np.zeros(plant.num_velocities())
        for joint in (plant.get_joint(index) for index in plant.GetJointIndices()):
            start = joint.velocity_start()  # the order of velocities can differ from the order of joints
            self._damping[start : start + joint.num_velocities()] = joint.default_damping_vector()

    def evaluate(self, plant_context: Context) -> tuple[np.ndarray, np.ndarray]:
        """Return the mass matrix (n, n) and the torques of Coriolis forces and damping (n,) [Nm]."""
        drag = self._plant.CalcBiasTerm(plant_context) + self._damping * self._plant.GetVelocities(plant_context)
        return self._plant.CalcMassMatrix(plant_context), drag
