"""Tries to make the pouring template fail: careless, random and malicious inputs.

A collision is counted at every plant step: nothing may touch what it must not, and the thermos must not be commanded
to tilt before that is allowed.
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
    """The greatest tilt [rad] that is commanded while the template is in its first state, where it is upright."""

    def on_episode_end(self, row: Mapping[str, Any]) -> Mapping[str, Any]:
        """`early_tilt` [rad], of all control steps; 0 where the template was never in its first state."""
        trace = self.base.trace
        upright = trace.commanded[trace.signals["state"][:, 0] == 0]
        return {"early_tilt": max(map(_tilt, upright), default=0.0)}


def _tilt(pose: np.ndarray) -> float:
    """The angle between the axis of a thermos with a pose (6,) and what is upwards [rad]."""
    R = pose_to_transform(pose).rotation().matrix()
    return float(np.arctan2(np.hypot(R[0, 2], R[1, 2]), R[2, 2]))


def _three_inputs(make: Callable[[np.random.Generator], Inputs]) -> Choose:
    """The adversary where there are its three inputs; where there are six velocities, full deflection."""
    return lambda rng, size: make(rng) if size == 3 else bang_bang(rng, size)


def campaign() -> Campaign:
    """The template with a mug that is moved, and everyone who is careless or worse; and none, for the physics."""
    return Campaign(
        "Pouring",
        [
            # With the mug far off, random inputs bring the arm to a joint's limit: there the command waits for it.
            Case("sct", {"guidance": "sct", "mug_offset": MAX_MUG_OFFSET}, constrained=True, waits=True),
            Case("none", {"guidance": "none", "mug_offset": MAX_MUG_OFFSET}, constrained=False, limits={}),
        ],
        {"collisions": 0, "early_tilt": TOLERANCE},
        witness=EarlyTilt,
        actions={name: _three_inputs(make) for name, make in ADVERSARIES.items()},
        frames=lambda drawn: {"mug_tip": RigidTransform([*drawn["mug_position"], 0.0])},
    )
