"""Fit primitives to six letters and print how each is reproduced: `python tests/models/primitives/letters.py`."""

import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2]))

from guiderail.models.primitives import LcNsKmp, ReferenceTrajectory
from guiderail.models.primitives.fit import fit, motion_without_actions, share_within_spread
from oracles.handwriting import LETTERS, write

if __name__ == "__main__":
    for letter in LETTERS:
        demonstrations = write(letter)
        selection = fit(demonstrations)
        outputs = np.stack(demonstrations.outputs)
        motion = motion_without_actions(selection.primitive())
        near = np.abs(motion - outputs.mean(axis=0)) <= outputs.std(axis=0, ddof=1)
        default = share_within_spread(LcNsKmp(ReferenceTrajectory.from_demonstrations(demonstrations)))
        print(
            f"{letter}: {selection.share:.1%} of steps within the reference's deviation, {near.all(axis=1).mean():.1%} "
            f"within the recordings' own; with the defaults {default:.1%}. {selection.why}",
            flush=True,
        )
