"""Reference window of a movement primitive, predicted by a base policy."""

import numpy as np
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem

from guiderail.models.common.arrays import as_whole
from guiderail.models.common.errors import InputError
from guiderail.models.primitives import ReferenceTrajectory
from guiderail.systems.policy_system import PolicyError
from guiderail.systems.support import declarations as declare
from guiderail.systems.support.declarations import input_getter, output_getter
from guiderail_lerobot.base_policy import BasePolicy, chunk_samples, mean_and_variance


class ChunkReference(LeafSystem):
    """Predict the reference window of H+1 control steps with a base policy.

        mean = mean of the chunks;  covariance = diag(variance of the chunks) + covariance_floor · Σ_n

    Every ``replan_steps`` control steps, the policy predicts chunks from the observation just before that step. Between
    two predictions, the window advances along the chunks. Σ_n are the covariances of a reference trajectory of O
    outputs. Before the first prediction, the output is the window of this trajectory.

    .. pydrake_system::

        name: ChunkReference
        input_ports:
        - observation
        output_ports:
        - reference_window

    ``observation`` is (n,). ``reference_window`` is ((H+1)(O + O²),): means (H+1, O) and covariances (H+1, O, O),
    row-major, in the units of the outputs; the first point is the current control step. The output depends only on
    state, so that a policy that observes the command does not cause an algebraic loop.

    Args:
        policy: Base policy (`models.policy`), a pure function. If it is None, the output is always the window of
            `reference`.
        observation_size: Size n of the observation, at least 1.
        reference: Reference trajectory with one point per control step, for Σ_n and the first window.
        horizon: Number H of points after the current one, at least 0.
        replan_steps: Number of control steps from one prediction to the next, at least 1.
        covariance_floor: Factor of Σ_n in the covariance, positive, finite.
        period: Control period [s], positive.

    Raises:
        InputError: If an argument is out of range.
        PolicyError: At an update, if the policy does not return finite chunks of O outputs.
    """

    def __init__(
        self,
        policy: BasePolicy | None,
        observation_size: int,
        reference: ReferenceTrajectory,
        *,
        horizon: int,
        replan_steps: int,
        covariance_floor: float,
        period: float,
    ):
        super().__init__()
        observation_size = as_whole(observation_size, "observation_size", 1)
        horizon, replan_steps = as_whole(horizon, "horizon", 0), as_whole(replan_steps, "replan_steps", 1)
        if not (np.isfinite(covariance_floor) and covariance_floor > 0):
            raise InputError(f"covariance_floor must be positive and finite, not {covariance_floor}")
        self._policy, self._reference, self._horizon = policy, reference, horizon
        self._replan_steps, self._floor = replan_steps, covariance_floor
        self._num_points, outputs = horizon + replan_steps, reference.num_outputs
        self._observation_port = self.DeclareVectorInputPort("observation", observation_size)
        # [means and variances of the chunk (2, H + replan_steps, O); number of the control step, −1 before the first]
        self._state = self.DeclareDiscreteState(np.append(np.zeros(2 * self._num_points * outputs), -1.0))
        declare.output(self, "reference_window", (horizon + 1) * (outputs + outputs**2), self._window, [self._state])
        declare.update(self, period, self._update, declare.reset_to_default(self))

    get_observation_input_port = input_getter("observation", "observation of the base policy, (n,)")
    get_reference_window_output_port = output_getter("reference_window", "means and covariances, ((H+1)(O + O²),)")

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        """Advance by one control step.

        Raises:
            PolicyError: If the base policy does not return chunks.
        """
        state = context.get_discrete_state().value(self._state).copy()
        state[-1] += 1.0
        if self._policy is not None and state[-1] % self._replan_steps == 0:
            observation = self._observation_port.Eval(context).astype(np.float32)
            try:
                samples = chunk_samples(self._policy, observation, self._reference.num_outputs)
            except (TypeError, ValueError) as error:
                raise PolicyError(f"{error}: the robot must stop") from None
            state[:-1] = np.concatenate(mean_and_variance(samples, self._num_points)).ravel()
        discrete_state.set_value(self._state, state)

    def _window(self, context: Context) -> np.ndarray:
        state = context.get_discrete_state().value(self._state)
        step, outputs = int(state[-1]), self._reference.num_outputs
        indices = np.minimum(max(step, 0) + np.arange(self._horizon + 1), self._reference.num_steps - 1)
        if step < 0 or self._policy is None:
            means, covariances = self._reference.means[indices], self._reference.covariances[indices]
        else:
            first = step % self._replan_steps
            chunk = state[:-1].reshape(2, self._num_points, outputs)[:, first : first + self._horizon + 1]
            means = chunk[0]
            covariances = self._floor * self._reference.covariances[indices] + chunk[1][:, :, None] * np.eye(outputs)
        return np.concatenate([means.ravel(), covariances.ravel()])
