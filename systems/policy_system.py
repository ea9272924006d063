"""A policy in a diagram, in the place where an environment writes its actions."""

from collections.abc import Callable

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import Context, EventStatus, InputPort, LeafSystem, OutputPort, State

from guiderail.models.common.errors import InputError
from guiderail.systems.support.sampling import check_period


class PolicyError(RuntimeError):
    """A policy returned something that is no action. A robot must stop then: there is nothing safe to guess."""


class PolicySystem(LeafSystem):
    """Runs a policy once a decision period, before everything else that happens at that instant.

        action[k] = clip(policy(observation[k]), −1, 1)

    The observation is that from just before the instant k·period. The action is set by an unrestricted update, which
    Drake performs before the discrete updates of the same instant: a `ZeroOrderHold` of the control period behind it
    holds the new action from that very instant on. So a `Simulator` that runs a task's diagram with this system does
    bit for bit what `GuidedEnv` does with the same policy (see CONTRIBUTING.md, "Rates and the order of events").

    .. pydrake_system::

        name: PolicySystem
        input_ports:
        - observation
        output_ports:
        - action

    ``observation`` is a vector (N,), or an abstract image. The policy is called with what an environment returns: an
    array (N,) of float32, or (h, w, 3) of uint8. ``action`` (A,) is in the units of the action space, [−1, 1]. It is
    state: zero before the first decision and after a reset, and it never feeds through.
    """

    def __init__(
        self,
        policy: Callable[[np.ndarray], np.ndarray],
        observation: int | AbstractValue,
        action_size: int,
        period: float,
    ):
        """
        Args:
            policy: observation to action (A,), a pure function: a reset can't restore a memory of its own. Actions
                beyond [−1, 1] are clipped.
            observation: N, at least 1, or a model value of an image port, `Value(ImageRgba8U(w, h))`.
            action_size: A, at least 1.
            period: between two decisions [s], positive, an integer multiple of the control period.

        Raises:
            InputError: if an argument is out of range.
        """
        super().__init__()
        check_period(period)
        if action_size < 1:
            raise InputError(f"a policy's action has at least one number, not {action_size}")
        self._policy = policy
        self._is_image = isinstance(observation, AbstractValue)
        if isinstance(observation, AbstractValue):
            self._observation_port = self.DeclareAbstractInputPort("observation", observation)
        elif observation >= 1:
            self._observation_port = self.DeclareVectorInputPort("observation", observation)
        else:
            raise InputError(f"a policy's observation has at least one number, not {observation}")
        self._action = self.DeclareDiscreteState(action_size)
        self._action_port = self.DeclareStateOutputPort("action", self._action)
        self.DeclarePeriodicUnrestrictedUpdateEvent(period, 0.0, self._decide)

    def get_observation_input_port(self) -> InputPort:
        """What the policy observes, (N,) or an image."""
        return self._observation_port

    def get_action_output_port(self) -> OutputPort:
        """The policy's last action, (A,), in [−1, 1]."""
        return self._action_port

    def _decide(self, context: Context, state: State) -> EventStatus:
        """Sets the action.

        Raises:
            PolicyError: if the policy returns anything but A finite numbers.
        """
        returned = self._policy(self._observe(context))
        try:
            action = np.asarray(returned, dtype=float)
        except (TypeError, ValueError):
            raise PolicyError(f"the policy returned {returned!r}, which is no action: the robot must stop") from None
        size = self._action_port.size()
        if action.shape != (size,) or not np.isfinite(action).all():
            raise PolicyError(f"the policy returned {action}, not {size} finite numbers: the robot must stop")
        state.get_mutable_discrete_state().set_value(self._action, np.clip(action, -1.0, 1.0))
        return EventStatus.Succeeded()

    def _observe(self, context: Context) -> np.ndarray:
        observation = self._observation_port.Eval(context)
        if self._is_image:
            return observation.data[:, :, :3].copy()
        return observation.astype(np.float32)
