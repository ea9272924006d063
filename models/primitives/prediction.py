"""Results of a movement primitive: an output at one step, outputs of a batch, and a modified part of the motion."""

from dataclasses import dataclass

import numpy as np

from guiderail.models.primitives.window import StepFactor


@dataclass(slots=True, eq=False)
class Prediction:
    """Output of a primitive at one step.

    Attributes:
        output: Output to execute (O,).
        factor: Factor of the step.
        x: History and null-space action of the prediction ((P + 1) O,).
        correction: Smallest correction v (r,) with which the window satisfies the constraints, or None if it satisfies
            them uncorrected; `LcNsKmp.output_sizes` bounds the displacement of the output.
        signed_multipliers: Multipliers (m,) of `LcNsKmp.free_constraints`, positive at an upper and negative at a lower
            bound, or None.
    """

    output: np.ndarray
    factor: StepFactor
    x: np.ndarray
    correction: np.ndarray | None = None
    signed_multipliers: np.ndarray | None = None

    @property
    def constrained(self) -> bool:
        """True if a constraint of the window is active."""
        return self.correction is not None

    @property
    def multipliers(self) -> np.ndarray:
        """Multipliers α (H+1, F) ≥ 0, zero where a constraint is slack; computed at each access."""
        if self.signed_multipliers is None:
            return np.zeros(self.factor.multipliers_shape)
        return self.factor.multipliers(self.signed_multipliers)

    @property
    def trajectory(self) -> np.ndarray:
        """Modified window (H+1, O); computed at each access."""
        return self.factor.trajectory(self.x, self.correction)


@dataclass(frozen=True)
class BatchPrediction:
    """Outputs of a primitive for several steps, actions and histories.

    Attributes:
        outputs: Outputs to execute (B, O); NaN where `is_solved` is false.
        is_constrained: True where a constraint of the window is active (B,).
        is_solved: False where no window within the constraints was found (B,); repeat the last safe command there.
    """

    outputs: np.ndarray
    is_constrained: np.ndarray
    is_solved: np.ndarray


@dataclass(frozen=True)
class Modification:
    """Part of a motion, modified by null-space actions at several of its points.

    Attributes:
        steps: Steps of the reference (n,), including steps past its end.
        trajectory: Outputs (n, O), within the constraints.
        multipliers: Multipliers α (n, F) ≥ 0, zero where a constraint is slack.
    """

    steps: np.ndarray
    trajectory: np.ndarray
    multipliers: np.ndarray

    @property
    def constrained(self) -> bool:
        """True if a constraint is active."""
        return bool(self.multipliers.any())
