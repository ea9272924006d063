"""Policy as a system, for simulations of a task diagram without an environment, and its observation of images."""

from collections.abc import Callable

import numpy as np
from pydrake.common.value import AbstractValue, Value
from pydrake.systems.framework import Context, LeafSystem, State, System
from pydrake.systems.sensors import ImageRgba8U

from guiderail.models.common.errors import InputError
from guiderail.systems.support import declarations as declare
from guiderail.systems.support.declarations import input_getter, output_getter


class PolicyError(RuntimeError):
    """Error for a policy that does not return an action; the robot must stop, because no action is known to be safe."""


class PolicySystem(LeafSystem):
    """Evaluate a policy once per action period, before all other updates of the same instant.

        action[k] = clip(policy(observation[k]), −1, 1)

    observation[k] is the value just before the instant k·period. An unrestricted update sets the action. Drake performs
    this update before the discrete updates of the same instant, so that a `ZeroOrderHold` of the control period outputs
    the new action from that instant on. The results of a `Simulator` of a task diagram with this system are therefore
    bit-identical to those of `DiagramEnv` with the same policy (see docs/concepts/rates.md).

    ``observation`` is a vector (N,) or an abstract image. The policy's argument is an array as returned by an
    environment: (N,) of float32 or (h, w, 3) of uint8. ``action`` is (A,), in [−1, 1]. It is state without direct
    feedthrough: zero before the first evaluation and after a reset.

    Args:
        policy: Function from observation to action (A,), which is clipped to [−1, 1]. It must be pure, because a reset
            cannot restore internal memory.
        observation: Size N of the observation, at least 1, or a model value of an image, `Value(ImageRgba8U(w, h))`.
        action_size: Size A of the action, at least 1.
        period: Action period [s], positive, an integer multiple of the control period.

    Raises:
        PolicyError: At an update, if the policy does not return A finite numbers.
    """

    def __init__(
        self,
        policy: Callable[[np.ndarray], np.ndarray],
        observation: int | AbstractValue,
        action_size: int,
        period: float,
    ):
        super().__init__()
        self._policy = policy
        self._is_image = isinstance(observation, AbstractValue)
        if isinstance(observation, AbstractValue):
            self._observation_port = self.DeclareAbstractInputPort("observation", observation)
        else:
            self._observation_port = self.DeclareVectorInputPort("observation", observation)
        self._action = self.DeclareDiscreteState(action_size)
        self._action_port = self.DeclareStateOutputPort("action", self._action)
        self.DeclarePeriodicUnrestrictedUpdateEvent(period, 0.0, self._update)

    get_observation_input_port = input_getter("observation", "observation, (N,) or an image")
    get_action_output_port = output_getter("action", "last action, (A,), in [−1, 1]")

    def _update(self, context: Context, state: State) -> None:
        returned = self._policy(self._observe(context))
        try:
            action = np.asarray(returned, dtype=float)
        except (TypeError, ValueError):
            raise PolicyError(f"the policy returned {returned!r} instead of an action: the robot must stop") from None
        size = self._action_port.size()
        if action.shape != (size,) or not np.isfinite(action).all():
            raise PolicyError(f"the policy returned {action}, not {size} finite numbers: the robot must stop")
        state.get_mutable_discrete_state().set_value(self._action, np.clip(action, -1.0, 1.0))

    def _observe(self, context: Context) -> np.ndarray:
        observation = self._observation_port.Eval(context)
        if self._is_image:
            return observation.data[:, :, :3].copy()
        return observation.astype(np.float32)


def check_policy_ports(policy: System, observation_size: int, action_size: int, task_name: str) -> None:
    """Check that the ports of a policy fit the observation (N,) and the action (A,) of a task.

    Raises:
        InputError: If the input `observation` or the output `action` is missing or has another size.
    """
    if not (policy.HasInputPort("observation") and policy.HasOutputPort("action")):
        raise InputError(
            f"a policy of {task_name} that is a system needs an input 'observation' and an output 'action', unlike "
            f"{type(policy).__name__}: rename or export its ports"
        )
    observation, action = policy.GetInputPort("observation"), policy.GetOutputPort("action")
    if observation.size() != observation_size or action.size() != action_size:
        raise InputError(
            f"a policy of {task_name} needs an observation of size {observation_size} and an action of size "
            f"{action_size}, not {observation.size()} and {action.size()}: use the options with which it was trained"
        )


class ImageObservation(LeafSystem):
    """Concatenate a camera image and a vector.

        observation = [image / 255, state]

    The image is stored channel by channel (red, green, blue), each row by row.

    ``image`` is an abstract `ImageRgba8U` whose alpha channel is ignored. ``state`` is (n,). ``observation`` is
    (3 · height · width + n,).

    Args:
        width: Width of the image, at least 1 [pixels].
        height: Height of the image, at least 1 [pixels].
        state_size: Size n of the state, at least 1.
    """

    def __init__(self, width: int, height: int, state_size: int):
        super().__init__()
        self._image_port = self.DeclareAbstractInputPort("image", Value(ImageRgba8U(width, height)))
        self._state_port = self.DeclareVectorInputPort("state", state_size)
        size = 3 * height * width + state_size
        sources = [self._image_port, self._state_port]
        declare.output(self, "observation", size, self._observation, sources)

    get_image_input_port = input_getter("image", "color image, an abstract `ImageRgba8U`")
    get_state_input_port = input_getter("state", "further entries of the observation, (n,)")
    get_observation_output_port = output_getter("observation", "image in [0, 1] and state, (3 · height · width + n,)")

    def _observation(self, context: Context) -> np.ndarray:
        image = self._image_port.Eval(context).data[:, :, :3]
        pixels = np.moveaxis(image, -1, 0).ravel() / 255.0
        return np.concatenate([pixels, self._state_port.Eval(context)])
