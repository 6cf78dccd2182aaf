"""Points of cloth that hangs as it lies, in the plane z = 0."""

from __future__ import annotations

import numpy as np

from vflatten_ros.core.values import FlatPoints


def lying_at(uv, sigma_m=0.002, views=1) -> FlatPoints:
    """Seen points at (n, 2) flat places, m; the views show them in turn."""
    n = len(uv)
    return FlatPoints(
        uv=uv,
        xyz_hanger=np.column_stack([uv, np.zeros(n)]),
        view_id=np.arange(n) % views,
        pixel=np.zeros((n, 2), dtype=np.int64),
        sigma_m=np.full(n, sigma_m),
        stress=np.zeros(n),
        inferred=np.zeros(n, dtype=bool),
    )
