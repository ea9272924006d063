"""Where the jack and the plug really are: what a reset of the BNC task draws."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from guiderail.models.errors import InputError

MM = 1e-3
KINDS = ("calibration", "disc", "known")
RUN_OFFSET = (1.0 * MM, 1.5 * MM)  # least and largest distance of the jack from where a calibration thinks it is
GRASP_RADIUS = 0.3 * MM  # how exactly a plug is picked up again
DISC_RADIUS = 1.5 * MM
KNOWN_RADIUS = 0.3 * MM
OPTIONS = ("held_out", "offset", "new_run")
# Held-out offsets come from streams of their own: no seed of a training run leads to them.
_HELD_OUT_STREAM = 0x8E1D


class BncUncertainty:
    """Draws the offsets of jack and plug, in the xy plane of the target frame.

    - "calibration": the jack is off by 1.0 to 1.5 mm in one direction, hidden and the same for a whole run; the plug
      sits in the tool within 0.3 mm of its place, anew every episode. The thesis's case.
    - "disc": the jack is anywhere within 1.5 mm, anew every episode.
    - "known": the jack is within 0.3 mm, anew every episode.

    A run begins with the first reset, and with every one that has the option `new_run`. Other options: `held_out` draws
    from a stream that training never draws from, with the run's hidden offset; `offset` (x, y) [m] puts the jack there
    and the plug in its place.
    """

    def __init__(self, kind: str):
        """
        Args:
            kind: one of `KINDS`.

        Raises:
            InputError: if there is no such kind.
        """
        if kind not in KINDS:
            raise InputError(f"there is no uncertainty '{kind}': use 'calibration', 'disc' or 'known'")
        self.kind = kind
        self._run_offset: np.ndarray | None = None

    def draw(self, rng: np.random.Generator, options: Mapping[str, Any]) -> tuple[np.ndarray, np.ndarray]:
        """Offsets (2,) [m] of the jack and of the plug in the tool."""
        unknown = set(options) - set(OPTIONS)
        if unknown:
            raise InputError(f"BncConnector knows no reset option {sorted(unknown)}: it knows {', '.join(OPTIONS)}")
        # Every reset draws the same numbers, used or not, so that a seed means the same at the first reset and later.
        hidden, key = _in_ring(rng, *RUN_OFFSET), int(rng.integers(2**62))
        stream = _HELD_OUT_STREAM if options.get("held_out") else 0
        episode = np.random.default_rng([key, stream])
        if self._run_offset is None or options.get("new_run"):
            self._run_offset = hidden
        if "offset" in options:
            return _checked_offset(options["offset"]), np.zeros(2)
        if self.kind == "calibration":
            return self._run_offset, _in_ring(episode, 0.0, GRASP_RADIUS)
        radius = DISC_RADIUS if self.kind == "disc" else KNOWN_RADIUS
        return _in_ring(episode, 0.0, radius), np.zeros(2)


def _in_ring(rng: np.random.Generator, inner: float, outer: float) -> np.ndarray:
    """A point (2,) whose density is the same everywhere between two circles."""
    radius = np.sqrt(rng.uniform(inner**2, outer**2))
    angle = rng.uniform(0.0, 2.0 * np.pi)
    return radius * np.array([np.cos(angle), np.sin(angle)])


def _checked_offset(offset: Any) -> np.ndarray:
    try:
        offset = np.array(offset, dtype=float)
    except (TypeError, ValueError):
        offset = np.empty(0)
    if offset.shape != (2,) or not np.isfinite(offset).all():
        raise InputError(f"the reset option 'offset' is (x, y) in metres, not {offset}")
    return offset
