"""Fit primitives to six letters and print how well they are reproduced: `python tests/models/primitives/letters.py`."""

import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2]))

from guiderail.models.primitives import ReferenceTrajectory, SquaredExponential
from guiderail.models.primitives.deviation import outputs_at
from guiderail.models.primitives.fit import LONG, fit, share_within_spread
from oracles.handwriting import LETTERS, share_within_deviation, write_letter

if __name__ == "__main__":
    for letter in LETTERS:
        demonstrations = write_letter(letter)
        selection = fit(demonstrations)
        steps = np.arange(selection.reference.num_steps)
        motion = outputs_at(selection.reference, selection.kernel, 2.0 * selection.lambda_, 40, steps)
        share = share_within_deviation(demonstrations, motion)
        reference = ReferenceTrajectory.from_demonstrations(demonstrations)
        default = share_within_spread(reference, SquaredExponential(), 6.0, 6.0, evaluated=LONG)
        print(
            f"{letter}: {selection.share:.1%} of steps are within the standard deviation of the reference, {share:.1%} "
            f"within that of the demonstrations; with the default parameters {default:.1%}. {selection.why}",
            flush=True,
        )
