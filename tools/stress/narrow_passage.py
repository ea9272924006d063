"""Tries to make the narrow passage fail: random, held and saturated actions against walls, obstacle and zone.

    python -m guiderail.tools.stress.narrow_passage --steps 100000 --out stress_passage.csv

Every control step is a decision, or every fifth. Exits with 1 if the simulation failed, anything was not finite, a
prediction failed, a command violated the constraint, or a wall was touched.
"""

from __future__ import annotations

import itertools
import sys
from collections.abc import Sequence
from functools import partial

from guiderail.diagrams.tasks.narrow_passage import make_env
from guiderail.tools.stress.campaign import Case, run


def cases() -> list[Case]:
    """KGRL and sKGRL, whose commands must keep the constraint, at two lengths of a decision."""
    return [
        Case(f"{guidance}, hold {hold}", partial(make_env, guidance=guidance, hold=hold), constrained=True)
        for guidance, hold in itertools.product(("kgrl", "skgrl"), (1, 5))
    ]


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line."""
    return run(str(__doc__).splitlines()[0], cases(), arguments, {"collisions": 0})


if __name__ == "__main__":
    sys.exit(main())
