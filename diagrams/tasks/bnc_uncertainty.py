"""Where the jack and the plug really are: what a reset of the BNC task draws."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from guiderail.diagrams.tasks.offsets import HiddenOffsets, in_ring
from guiderail.models.units import DEGREE, MM

# Least and largest distance of the jack from where it is thought to be.
OFFSET_RANGES = {
    "calibration": (1.0 * MM, 1.5 * MM),
    "disc": (0.0, 1.5 * MM),
    "known": (0.0, 0.3 * MM),
}
GRASP_RADIUS = 0.3 * MM  # how exactly a plug is picked up again
LARGEST_GRASP_ANGLE = 2.0  # degrees; beyond it the plug would hang askew enough to be a fault and no uncertainty


class BncUncertainty(HiddenOffsets):
    """Draws the offsets of jack and plug; `HiddenOffsets` has the options of a reset.

    - "calibration": the jack is off by 1.0 to 1.5 mm in one direction, hidden and the same for a whole run; the plug
      sits in the tool within 0.3 mm of its place, anew every episode. The thesis's case.
    - "disc": the jack is anywhere within 1.5 mm, anew every episode.
    - "known": the jack is within 0.3 mm, anew every episode.

    The plug may also sit tilted in the tool, anew every episode: its offset then has two angles [rad] about x and y
    after x and y. The jack may be turned about its axis, as often as its place is drawn: its offset then has an angle
    [rad] after x and y. The option `offset` puts the jack there and the plug straight in its place.
    """

    def __init__(
        self,
        kind: str,
        grasp_angle: float = 0.0,
        *,
        offset_range: Sequence[float] | None = None,
        jack_turn: float = 0.0,
    ):
        """
        Args:
            kind: "calibration", "disc" or "known".
            grasp_angle: the largest tilt of the plug in the tool [degrees].
            offset_range: least and greatest distance of the jack from where it should be [m], instead of the kind's.
            jack_turn: the largest turn of the jack about its axis [degrees].
        """
        super().__init__()
        self.kind = kind
        self.grasp_angle = grasp_angle * DEGREE
        self.jack_turn = jack_turn * DEGREE
        self.offset_range = OFFSET_RANGES[kind] if offset_range is None else tuple(offset_range)

    def _draw_run(self, rng: np.random.Generator) -> np.ndarray:
        # Drawn of every kind, used or not; what "known" and "disc" draw of an episode came after it from the beginning.
        return self._turned(in_ring(rng, *self.offset_range), rng)

    def _draw_episode(self, rng: np.random.Generator, run: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        if self.kind == "calibration":
            jack, plug = run, in_ring(rng, 0.0, GRASP_RADIUS)
        else:
            jack, plug = in_ring(rng, *self.offset_range), np.zeros(2)
        plug = self._tilted(plug, in_ring(rng, 0.0, self.grasp_angle))
        return (jack if self.kind == "calibration" else self._turned(jack, rng)), plug

    def _given(self, offset: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        jack = np.append(offset, 0.0) if self.jack_turn > 0.0 else offset
        return jack, self._tilted(np.zeros(2), np.zeros(2))

    def _turned(self, jack: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        return np.append(jack, rng.uniform(-self.jack_turn, self.jack_turn)) if self.jack_turn > 0.0 else jack

    def _tilted(self, plug: np.ndarray, angles: np.ndarray) -> np.ndarray:
        return np.concatenate([plug, angles]) if self.grasp_angle > 0.0 else plug
