"""Summaries of recorded episodes: numbers of poses and wrenches that are aligned in time by the commanded motion."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from guiderail_calibration.recordings import Episode

SEGMENTS = 12  # equal parts of the nominal duration in which signals are averaged
MAX_LAG = 10  # largest lag of a correlation [control steps]
CONTACT = 0.5  # force above which there is contact [N]
# Scales of a pose [m, rad] and a wrench [N, Nm], below which a difference is negligible.
POSE_SCALE = np.array([1e-4, 1e-4, 1e-4, 1e-3, 1e-3, 1e-3])
WRENCH_SCALE = np.array([0.1, 0.1, 0.1, 2e-3, 2e-3, 2e-3])


def summarize(episodes: Sequence[Episode], num_steps: int) -> np.ndarray:
    """Return the summaries of the episodes of one robot: mean and spread over the episodes.

    Args:
        episodes: Episodes, at least one. The spread of a single episode is 0.
        num_steps: Nominal number of control steps, to which the segments refer.
    """
    rows = np.stack([summarize_episode(episode, num_steps) for episode in episodes])
    return np.concatenate([rows.mean(axis=0), rows.std(axis=0)])


def summarize_episode(episode: Episode, num_steps: int) -> np.ndarray:
    """Return the summaries of one episode.

    In each segment: mean tracking error and wrench, their norms in the plane and about its axes, spread of the position
    in the plane (the play in a hole), drag and stiffness as logarithms of ratios. Between segments: change of the
    measured height, which a workpiece at rest on a rim does not change, unless it slips in the grasp. In the whole
    episode: noise, correlations of the motion and of the wrench with the command at several lags, first contact,
    largest force and length.
    """
    desired, pose, wrench = (np.asarray(a, float) for a in (episode.desired, episode.pose, episode.wrench))
    error = (desired - pose) / POSE_SCALE
    force = wrench / WRENCH_SCALE
    edges = np.linspace(0, num_steps, SEGMENTS + 1).round().astype(int)
    values: list[np.ndarray] = []
    heights = []
    for start, end in pairwise(edges):
        # A segment after the end of an episode repeats its last control steps.
        at = (
            slice(start, end) if start < len(desired) - 1 else slice(max(len(desired) - (end - start), 0), len(desired))
        )
        heights.append(pose[at, 2].mean() / POSE_SCALE[2])
        e, f = error[at].mean(axis=0), force[at].mean(axis=0)
        plane_error, plane_force = (np.linalg.norm(v[at, :2], axis=1).mean() for v in (error, force))
        drag = np.log((plane_force + 1.0) / (abs(f[2]) + 1.0))
        stiffness = np.log((np.abs(f[:3]) + 1.0) / (np.abs(e[:3]) + 1.0))
        play = np.linalg.norm(pose[at, :2].std(axis=0)) / POSE_SCALE[0]
        norms = np.array([plane_error, plane_force, np.linalg.norm(f[3:5]), 10.0 * play])
        values.append(np.concatenate([_compress(e), _compress(f), _compress(norms), [drag], stiffness]))
    noise = [np.log(np.std(np.diff(v, n=2, axis=0), axis=0) + 1e-3) for v in (error, force)]
    speed, motion = np.diff(desired / POSE_SCALE, axis=0), np.diff(pose / POSE_SCALE, axis=0)
    lags = [_correlations(speed, motion), _correlations(np.diff(error, axis=0), np.diff(force, axis=0))]
    still = np.mean(np.abs(motion).max(axis=1) < 1e-3)
    contact = np.abs(wrench[:, 2]) > CONTACT
    first = float(np.argmax(contact)) if contact.any() else float(num_steps)
    largest = np.log(np.abs(force).max(axis=0) + 1.0)
    whole = np.array([first / num_steps, contact.mean(), len(desired) / num_steps, still])
    return np.concatenate([*values, _compress(np.diff(heights)), *noise, *lags, largest, whole])


def _compress(values: np.ndarray) -> np.ndarray:
    """Return values on a scale that is linear near 0 and logarithmic far from it."""
    return np.arcsinh(values)


def _correlations(command: np.ndarray, response: np.ndarray) -> np.ndarray:
    """Return the correlations of x, y, z of a response (n, 6) with a command (n, 6), at lags from 0 to `MAX_LAG`."""
    a, b = command[:, :3], response[:, :3]
    norm = float(np.sqrt((a**2).sum() * (b**2).sum())) + 1e-9
    return np.array([(a[: len(a) - lag] * b[lag:]).sum() / norm for lag in range(min(MAX_LAG, len(a) - 1) + 1)])
