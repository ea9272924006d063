"""Fuzzing of pouring: careless, random and adversarial inputs.

Collisions are counted at every plant step. The thermos must not be commanded to tilt before the template allows it.
"""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from pydrake.math import RigidTransform

from guiderail.diagrams.tasks.pouring.options import MAX_MUG_OFFSET
from guiderail.diagrams.tasks.pouring.scripted import ADVERSARIES, Inputs
from guiderail.models.common.poses import pose_to_transform
from guiderail.tools.evaluation.baselines import Choose, bang_bang
from guiderail.tools.evaluation.metrics import TOLERANCE
from guiderail.tools.evaluation.rollout import EnvCallback
from research.action_fuzzing.campaign import Campaign, Case


class EarlyTilt(EnvCallback):
    """Largest commanded tilt [rad] while the template is in its first state, in which the thermos is upright."""

    def on_episode_end(self, row: Mapping[str, Any]) -> Mapping[str, Any]:
        """Return `early_tilt` [rad] over all control steps; 0 if the template was never in its first state."""
        trace = self.base.trace
        upright = trace.commanded[trace.signals["state"][:, 0] == 0]
        return {"early_tilt": max(map(_tilt, upright), default=0.0)}


def _tilt(pose: np.ndarray) -> float:
    """Return the angle [rad] between the axis of a thermos with a pose, (6,), and the vertical."""
    R = pose_to_transform(pose).rotation().matrix()
    return float(np.arctan2(np.hypot(R[0, 2], R[1, 2]), R[2, 2]))


def _three_inputs(make: Callable[[np.random.Generator], Inputs]) -> Choose:
    """Return an adversary of the template's three inputs; where there are six velocities, full deflection."""
    return lambda rng, size: make(rng) if size == 3 else bang_bang(rng, size)


def campaign() -> Campaign:
    """Return the campaign: every adversary with a displaced mug, through the template and without guidance."""
    return Campaign(
        "Pouring",
        [
            # Random inputs bring the arm to a joint limit when the mug is far off; the command waits there.
            Case("sct", {"guidance": "sct", "mug_offset": MAX_MUG_OFFSET}, constrained=True, may_wait=True),
            Case("none", {"guidance": "none", "mug_offset": MAX_MUG_OFFSET}, constrained=False, limits={}),
        ],
        {"collisions": 0, "early_tilt": TOLERANCE},
        make_callback=EarlyTilt,
        actions={name: _three_inputs(make) for name, make in ADVERSARIES.items()},
        frames=lambda sampled: {"mug_tip": RigidTransform([*sampled["mug_position"], 0.0])},
    )
