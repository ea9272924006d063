"""Fit primitives to six letters and print how well they are reproduced: `python tests/models/primitives/letters.py`."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2]))

from guiderail.models.primitives import LcNsKmp, ReferenceTrajectory
from guiderail.models.primitives.fit import fit, motion_without_actions, share_within_spread
from oracles.handwriting import LETTERS, share_within_deviation, write_letter

if __name__ == "__main__":
    for letter in LETTERS:
        demonstrations = write_letter(letter)
        selection = fit(demonstrations)
        share = share_within_deviation(demonstrations, motion_without_actions(selection.primitive()))
        default = share_within_spread(LcNsKmp(ReferenceTrajectory.from_demonstrations(demonstrations)))
        print(
            f"{letter}: {selection.share:.1%} of steps are within the standard deviation of the reference, {share:.1%} "
            f"within that of the demonstrations; with the default parameters {default:.1%}. {selection.why}",
            flush=True,
        )
