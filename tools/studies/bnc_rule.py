"""What a BNC policy has to beat, and that it can be beaten: `python -m guiderail.tools.studies.bnc_rule --trials 100`.

Two policies without learning: the demonstrations alone, and a hand-written rule that moves against the contact torque
while the plug stands on the rim. The first must mostly fail where the jack is not where it should be, the second must
not: then there is something to learn, and it can be learned from what a policy sees.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np

from guiderail.diagrams.tasks.bnc_connector import NUM_STEPS, POSE_CENTRE, POSE_SCALE, make_env
from guiderail.models.objects.bnc_motion import MM, RIM
from guiderail.tools.rollouts.judging import HELD_OUT_SEED, mean, trials
from guiderail.tools.rollouts.rollout import standing_still
from guiderail.tools.viewing.film import Shown, outcome, write_film
from guiderail.tools.viewing.replay import write_page

GAIN = 1.5  # of the action per scaled contact torque
# While the demonstrations search the rim, control steps.
SEARCH = (60, 185)
ON_RIM = (RIM - 1.2 * MM - POSE_CENTRE[2]) / POSE_SCALE[2]  # scaled height from which the plug isn't in yet
PUSHING = 0.2  # scaled force along z from which the plug counts as standing on something
# Where [time, pose, wrench] lie in an observation.
TIME, Z, FORCE_Z, TORQUE_X, TORQUE_Y = 0, 3, 9, 10, 11


def reactive_rule(observation: np.ndarray) -> np.ndarray:
    """Moves in x and y against the torque, which says on which side of its mouth the plug stands; (2,)."""
    step = 0.5 * (observation[TIME] + 1.0) * NUM_STEPS
    if not (SEARCH[0] < step < SEARCH[1] and observation[Z] > ON_RIM and observation[FORCE_Z] > PUSHING):
        return np.zeros(2)
    return np.clip(GAIN * np.array([-observation[TORQUE_Y], observation[TORQUE_X]]), -1.0, 1.0)


def show(options: argparse.Namespace) -> None:
    """Writes the page and the picture of one of the rule's episodes, and prints what it came to."""
    episode = Shown(
        task="BncConnector",
        environment={
            "guidance": options.guidance,
            "uncertainty": options.uncertainty,
            "station": options.station,
        },
        act=reactive_rule,
        acting="hand-written rule",
        title=options.uncertainty,
        seed=options.seed,
    )
    for file, write in ((options.replay, write_page), (options.picture, write_film)):
        if file is not None:
            print(json.dumps({"file": str(file), "outcome": outcome(write(file, episode))}), flush=True)


def main(arguments: list[str] | None = None) -> None:
    """Prints the rates; or shows an episode of the rule as a page or a picture."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--trials", type=int, default=40)
    parser.add_argument("--station", default="rails")
    parser.add_argument("--guidance", default="kgrl", help="what the rule acts through")
    parser.add_argument("--replay", type=Path, help="a page (.html) to write of one episode, instead of rates")
    parser.add_argument("--picture", type=Path, help="the same, what a camera sees of it (.png)")
    parser.add_argument("--uncertainty", default="calibration", help="of the episode shown")
    parser.add_argument("--seed", type=int, default=HELD_OUT_SEED, help="of the episode shown")
    options = parser.parse_args(arguments)
    if options.replay is not None or options.picture is not None:
        show(options)
        return
    for uncertainty in ("known", "calibration", "disc"):
        env = make_env(guidance=options.guidance, uncertainty=uncertainty, station=options.station)
        rates = {
            name: mean(trials(env, act, options.trials), "success")
            for name, act in (("demonstration", standing_still(env)), ("rule", reactive_rule))
        }
        print(json.dumps({uncertainty: rates, "trials": options.trials}), flush=True)


if __name__ == "__main__":
    main()
