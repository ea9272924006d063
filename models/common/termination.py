"""Reasons for the end of an episode."""

from enum import StrEnum


class Termination(StrEnum):
    """Reason for the end of an episode; equal to its text, as in `info["termination"]` and in tables.

    A ``termination`` port outputs the index of a reason in the order of this class. `TIME_LIMIT` and the reasons
    after it do not come from a port: the environment or the program that runs the episode sets them.
    """

    CONTINUES = ""  # the episode continues
    SUCCESS = "success"  # the goal of the task was reached
    COLLISION = "collision"  # a force exceeded the limit of the task, or an obstacle was touched
    SPILL = "spill"  # a ball was spilled
    BLOCKED = "blocked"  # no progress for a number of steps
    VIOLATION = "violation"  # a constraint was violated
    TIME_LIMIT = "time_limit"  # the maximum number of steps was reached
    SIMULATION_FAILURE = "simulation_failure"  # the simulation failed, and the episode was truncated
    STOPPED = "stopped"  # a robot was stopped
    DID_NOT_HOLD = "did_not_hold"  # a robot's workpiece came off after a success
    FAILURE = "failure"  # a supervisor labeled the episode as failed
    STOP = "stop"  # a supervisor stopped the episode
    TERMINATED = "terminated"  # an environment of another package terminated the episode

    @property
    def index(self) -> int:  # type: ignore[override]  # hides the method of text
        """Index of the reason, which a ``termination`` port outputs."""
        return list(type(self)).index(self)


TERMINATIONS = tuple(Termination)
"""All reasons in the order of their indices."""
EVALUATED = TERMINATIONS[Termination.SUCCESS.index : Termination.TIME_LIMIT.index]
"""Reasons that a condition on the signals of a control step can have."""
