"""Six letters, nothing set by hand: `python tests/models/primitives/letters.py` says how each is reproduced."""

import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2]))

from guiderail.models.primitives import LcNsKmp, ReferenceTrajectory
from guiderail.models.primitives.fit import fit, motion_without_actions, share_within_spread
from oracles.handwriting import LETTERS, write

if __name__ == "__main__":
    for letter in LETTERS:
        shown = write(letter)
        selection = fit(shown)
        outputs = np.stack(shown.outputs)
        motion = motion_without_actions(selection.primitive())
        near = np.abs(motion - outputs.mean(axis=0)) <= outputs.std(axis=0, ddof=1)
        untold = share_within_spread(LcNsKmp(ReferenceTrajectory.from_demonstrations(shown)))
        print(
            f"{letter}: {selection.share:.1%} of steps within the reference's deviation, {near.all(axis=1).mean():.1%} "
            f"within the recordings' own; untold {untold:.1%}. {selection.why}",
            flush=True,
        )
