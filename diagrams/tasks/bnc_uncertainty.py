"""Where the jack and the plug really are: what a reset of the BNC task draws."""

from __future__ import annotations

import numpy as np

from guiderail.diagrams.tasks.offsets import HiddenOffsets, in_ring
from guiderail.models.units import DEGREE, MM

RUN_OFFSET = (1.0 * MM, 1.5 * MM)  # least and largest distance of the jack from where a calibration thinks it is
GRASP_RADIUS = 0.3 * MM  # how exactly a plug is picked up again
DISC_RADIUS = 1.5 * MM
KNOWN_RADIUS = 0.3 * MM
LARGEST_GRASP_ANGLE = 2.0  # degrees; beyond it the plug would hang askew enough to be a fault and no uncertainty


class BncUncertainty(HiddenOffsets):
    """Draws the offsets of jack and plug; `HiddenOffsets` has the options of a reset.

    - "calibration": the jack is off by 1.0 to 1.5 mm in one direction, hidden and the same for a whole run; the plug
      sits in the tool within 0.3 mm of its place, anew every episode. The thesis's case.
    - "disc": the jack is anywhere within 1.5 mm, anew every episode.
    - "known": the jack is within 0.3 mm, anew every episode.

    The plug may also sit tilted in the tool, anew every episode: its offset then has two angles [rad] about x and y
    after x and y. The option `offset` puts the jack there and the plug straight in its place.
    """

    def __init__(self, kind: str, grasp_angle: float = 0.0):
        """
        Args:
            kind: "calibration", "disc" or "known".
            grasp_angle: the largest tilt of the plug in the tool [degrees].
        """
        super().__init__()
        self.kind = kind
        self.grasp_angle = grasp_angle * DEGREE

    def _draw_run(self, rng: np.random.Generator) -> np.ndarray:
        return in_ring(rng, *RUN_OFFSET)

    def _draw_episode(self, rng: np.random.Generator, run: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        if self.kind == "calibration":
            jack, plug = run, in_ring(rng, 0.0, GRASP_RADIUS)
        else:
            jack, plug = in_ring(rng, 0.0, DISC_RADIUS if self.kind == "disc" else KNOWN_RADIUS), np.zeros(2)
        return jack, self._tilted(plug, in_ring(rng, 0.0, self.grasp_angle))

    def _given(self, offset: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return offset, self._tilted(np.zeros(2), np.zeros(2))

    def _tilted(self, plug: np.ndarray, angles: np.ndarray) -> np.ndarray:
        return np.concatenate([plug, angles]) if self.grasp_angle > 0.0 else plug
