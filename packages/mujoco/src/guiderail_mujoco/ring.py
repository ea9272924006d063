"""Convex pieces of a ring."""

import numpy as np

from guiderail.models.common.transforms import MM

# If neighbouring convex pieces only touched, their seam would catch a sliding body, because the shortest way out of a
# piece is sideways at the seam. Each piece therefore has a shoulder: it extends by SHOULDER [m] into its neighbours and
# slopes down, by nine degrees, to the depth BELOW [m] under their surface.
SHOULDER, BELOW = 0.3 * MM, 0.05 * MM


def ring_hulls(profile: np.ndarray, num_sides: int) -> list[np.ndarray]:
    """Return the vertices (4 K, 3) [m] of convex pieces of a polygonal ring about z, including shoulders.

    The middle of a side lies on the x axis, as in `sdf.lathe`. `profile` (K, 2) has the corners of the convex
    section as [radius of the circle inside the polygon, height] [m].
    """
    radius, height = np.asarray(profile, dtype=float).T
    radius = radius / np.cos(np.pi / num_sides)
    inwards = BELOW * np.sign(np.mean([radius, height], axis=1)[:, None] - [radius, height])
    hulls = []
    for corner in range(num_sides):
        ends = 2.0 * np.pi * (np.array([corner, corner + 1]) + 0.5) / num_sides
        middle = ends.mean()
        outward = np.array([np.cos(middle), np.sin(middle), 0.0])
        along = np.array([-np.sin(middle), np.cos(middle), 0.0])
        points = []
        for end, side in zip(ends, (-1.0, 1.0), strict=True):
            section = np.stack([radius * np.cos(end), radius * np.sin(end), height], axis=1)
            shoulder = section + side * SHOULDER * along + inwards[0][:, None] * outward
            shoulder[:, 2] += inwards[1]
            points += [section, shoulder]
        hulls.append(np.concatenate(points))
    return hulls
