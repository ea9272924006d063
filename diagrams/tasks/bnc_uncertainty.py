"""Where the jack and the plug really are: what a reset of the BNC task draws."""

from __future__ import annotations

import numpy as np

from guiderail.diagrams.tasks.offsets import MM, HiddenOffsets, in_ring

RUN_OFFSET = (1.0 * MM, 1.5 * MM)  # least and largest distance of the jack from where a calibration thinks it is
GRASP_RADIUS = 0.3 * MM  # how exactly a plug is picked up again
DISC_RADIUS = 1.5 * MM
KNOWN_RADIUS = 0.3 * MM


class BncUncertainty(HiddenOffsets):
    """Draws the offsets of jack and plug; `HiddenOffsets` has the options of a reset.

    - "calibration": the jack is off by 1.0 to 1.5 mm in one direction, hidden and the same for a whole run; the plug
      sits in the tool within 0.3 mm of its place, anew every episode. The thesis's case.
    - "disc": the jack is anywhere within 1.5 mm, anew every episode.
    - "known": the jack is within 0.3 mm, anew every episode.

    The option `offset` puts the jack there and the plug in its place.
    """

    task = "BncConnector"
    kinds = ("calibration", "disc", "known")

    def _draw_run(self, rng: np.random.Generator) -> np.ndarray:
        return in_ring(rng, *RUN_OFFSET)

    def _draw_episode(self, rng: np.random.Generator, run: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        if self.kind == "calibration":
            return run, in_ring(rng, 0.0, GRASP_RADIUS)
        radius = DISC_RADIUS if self.kind == "disc" else KNOWN_RADIUS
        return in_ring(rng, 0.0, radius), np.zeros(2)

    def _given(self, offset: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return offset, np.zeros(2)
