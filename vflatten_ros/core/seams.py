"""Whether front and back of an item hang together along the seams of its category.

A towel that is folded over, or a leg upon another, may lie in the shape of a skirt. But along a
skirt's sides its front goes over into its back: what lies on either near a seam hangs near too.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from vflatten_ros.core.values import Bool, FlatPoints, Float

STEP_M = 0.01  # along a seam
NEAR_M = 0.03  # from it, for cloth to tell
TORN_M = 0.02  # excess of a chord over the way along the flat cloth that errors make
FEWEST = 20  # places at which both sides were seen


def torn_share(points: FlatPoints, side: Float, outline: Float, seam: Bool) -> float:
    """Share of the seams at which front and back hang farther apart than the cloth is long.

    Parameters
    ----------
    points : FlatPoints
        (n,) that lie flat.
    side : ndarray of shape (n,)
        1 outside up, -1 outside down.
    outline : ndarray of shape (k, 2)
        Corners of the category as it fits them, m.
    seam : ndarray of shape (k,)
        Whether front and back hang together from each corner to the next.

    Returns
    -------
    float
        0 to 1; 0 if hardly anywhere both were seen.
    """
    places = _along(outline, seam)
    faces = [np.flatnonzero((side == up) & ~points.inferred) for up in (1.0, -1.0)]
    if not len(places) or min(map(len, faces)) == 0:
        return 0.0
    lies_m, hangs = np.zeros(len(places)), []
    for rows in faces:
        away, near = cKDTree(points.uv[rows]).query(places, distance_upper_bound=NEAR_M)
        lies_m += away
        hangs.append(points.xyz_hanger[rows[np.minimum(near, len(rows) - 1)]])
    both = np.isfinite(lies_m)
    if both.sum() < FEWEST:
        return 0.0
    chord_m = np.linalg.norm(hangs[0] - hangs[1], axis=1)
    return float((chord_m[both] - lies_m[both] > TORN_M).mean())


def _along(outline: Float, seam: Bool) -> Float:
    """(m, 2) places along the seams, not at their ends."""
    found = [np.zeros((0, 2))]
    for start, end in zip(outline[seam], np.roll(outline, -1, axis=0)[seam]):
        count = int(np.linalg.norm(end - start) / STEP_M)
        share = (np.arange(1, count) / max(count, 1))[:, None]
        found.append(start + share * (end - start))
    return np.vstack(found)
