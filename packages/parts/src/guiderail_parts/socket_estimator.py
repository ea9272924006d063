"""Histogram filter of the socket's position: `LeafSystem` that compares centers of pressure with a contact map.

After Chhatpar and Branicky, "Particle filtering for localization in robotic assemblies with position uncertainty" (IROS
2005).
"""

from __future__ import annotations

import numpy as np
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem

from guiderail.models.common.arrays import is_finite
from guiderail.models.common.transforms import MM, POSE_SIZE, WRENCH_SIZE
from guiderail.models.control.wrench import center_of_pressure
from guiderail.systems.support import declarations as declare
from guiderail.systems.support.declarations import input_getter, output_getter
from guiderail_parts.contact_map import ContactMap

RADIUS, SPACING = 4.25 * MM, 0.25 * MM  # of the positions of the socket that the filter distinguishes [m]
TICKS = SPACING * np.arange(-round(RADIUS / SPACING), round(RADIUS / SPACING) + 1)
_GRID = np.stack(np.meshgrid(TICKS, TICKS, indexing="ij"), axis=-1)
_INSIDE = np.hypot(_GRID[:, :, 0], _GRID[:, :, 1]) <= RADIUS
POSITIONS = _GRID[_INSIDE]  # positions of the socket relative to its nominal position, (H, 2) [m]
RATE = 0.2  # weight r of one sample: consecutive samples are not independent
FORGETTING = 0.99  # factor γ of the log-probabilities per sample, so that wrong early samples are forgotten


class SocketEstimator(LeafSystem):
    """Estimate the socket's axis relative to the plug with a histogram filter.

        log P(s) ← γ log P(s) + r log p(c | p − s, a)   if f_z ≥ min_force, otherwise unchanged
        socket_offset = (m − p, C_xx, C_xy, C_yy),  m = Σ P(s) s,  C = Σ P(s) (s − m) (s − m)ᵀ

    s is a position of the socket, one of `POSITIONS`; p is that of the plug, a its tilt, and c the center of
    pressure. All positions are initially equally likely.

    ``pose`` is X_TP and ``wrench`` the wrench about P in the axes of T, both (6,) [m, rad, N, Nm]. Samples that are not
    finite are skipped. ``socket_offset`` is (5,) [m, m²]. A sample affects the output from the next control
    step.

    Args:
        contact_map: Map of the parts; None leaves all positions equally likely.
        min_force: Force along z below which a sample is not used [N].
        period: Control period [s], positive.
    """

    def __init__(self, contact_map: ContactMap | None, *, min_force: float, period: float):
        super().__init__()
        self._map, self._min_force = contact_map, min_force
        self._state = self.DeclareDiscreteState(len(POSITIONS))  # log-probabilities, up to a constant
        self._pose_port = self.DeclareVectorInputPort("pose", POSE_SIZE)
        self._wrench_port = self.DeclareVectorInputPort("wrench", WRENCH_SIZE)
        self._estimate = declare.cache(self, "estimate", self._calc_estimate, [self._state])
        declare.output(self, "socket_offset", 5, self._socket_offset, [self._pose_port, self._state])
        declare.update(self, period, self._update, declare.reset_to_default(self))

    get_pose_input_port = input_getter("pose", "pose of the plug, (6,)")
    get_wrench_input_port = input_getter("wrench", "wrench about the tool center, (6,) [N, Nm]")
    get_socket_offset_output_port = output_getter("socket_offset", "x, y and covariances xx, xy, yy, (5,) [m, m²]")

    def _log_probabilities(self, context: Context) -> np.ndarray:
        return context.get_discrete_state().value(self._state)

    def _calc_estimate(self, context: Context) -> np.ndarray:
        log_probabilities = self._log_probabilities(context)
        weights = np.exp(log_probabilities - log_probabilities.max())
        weights /= weights.sum()
        mean = weights @ POSITIONS
        distance = POSITIONS - mean
        covariance = distance.T @ (weights[:, None] * distance)
        return np.array([*mean, covariance[0, 0], covariance[0, 1], covariance[1, 1]])

    def _socket_offset(self, context: Context) -> np.ndarray:
        offset = self._estimate.Eval(context).copy()
        offset[:2] -= self._pose_port.Eval(context)[:2]
        return offset

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        pose, wrench = self._pose_port.Eval(context), self._wrench_port.Eval(context)
        if self._map is None or not (is_finite(pose) and is_finite(wrench)):
            return
        if wrench[2] < self._min_force:
            return
        center = center_of_pressure(wrench, self._min_force)
        change = RATE * self._map.log_likelihood(pose[:3], pose[4:], center, TICKS)[_INSIDE]
        discrete_state.set_value(self._state, FORGETTING * self._log_probabilities(context) + change)
