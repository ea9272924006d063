"""Where the table and the clamp really are: what a reset of the grid-clamp task draws."""

from __future__ import annotations

import numpy as np

from guiderail.diagrams.tasks.offsets import HiddenOffsets, in_ring
from guiderail.models.units import MM

NUM_PLACES = 6  # where clamps are picked up
# Parallel jaws centre what they close on; along the jaws, which is x, a clamp stays where it happened to be.
ALONG_JAWS = 1.0 * MM  # the six places' offsets spread over ± this
ACROSS_JAWS = 0.2 * MM
CALIBRATION = (1.8 * MM, 2.2 * MM)  # least and largest error of the hole's place
REPEATABILITY = 0.1 * MM  # of one pick-up place
KNOWN_RADIUS = 0.15 * MM


class GridClampUncertainty(HiddenOffsets):
    """Draws the offsets of table and clamp; `HiddenOffsets` has the options of a reset.

    - "calibration": the table is off by 1.8 to 2.2 mm in one direction, and each of six pick-up places has a grasp
      offset of its own, all hidden and the same for a whole run. An episode picks up at one of the places, drawn, with
      a repeatability of 0.1 mm. The thesis's case.
    - "disc": the error of the table and the six grasp offsets are drawn anew every episode.
    - "known": the clamp is within 0.15 mm of where it is thought to be.

    The option `offset` puts the clamp there in the tool and the table in its place.
    """

    def __init__(self, kind: str):
        """
        Args:
            kind: "calibration", "disc" or "known".
        """
        super().__init__()
        self.kind = kind

    def _draw_run(self, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """The table's offset (2,) and the grasp offsets (6, 2) of the places."""
        step = 2 * ALONG_JAWS / NUM_PLACES
        along = -ALONG_JAWS + step * (np.arange(NUM_PLACES) + rng.uniform(0.0, 1.0, NUM_PLACES))
        across = rng.uniform(-ACROSS_JAWS, ACROSS_JAWS, NUM_PLACES)
        return in_ring(rng, *CALIBRATION), np.column_stack([along, across])

    def _draw_episode(
        self, rng: np.random.Generator, run: tuple[np.ndarray, np.ndarray]
    ) -> tuple[np.ndarray, np.ndarray]:
        if self.kind == "known":
            return np.zeros(2), in_ring(rng, 0.0, KNOWN_RADIUS)
        table, grasps = self._draw_run(rng) if self.kind == "disc" else run
        return table, grasps[rng.integers(NUM_PLACES)] + in_ring(rng, 0.0, REPEATABILITY)

    def _given(self, offset: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return np.zeros(2), offset
