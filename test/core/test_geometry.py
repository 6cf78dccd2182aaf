"""Small geometry that many modules use."""

from __future__ import annotations

import numpy as np
import pytest

from vflatten_ros.core.geometry import distances_m

CORNERS = np.array([[0.0, 0.0, 0.0], [3.0, 4.0, 12.0], [3.0, 0.0, 0.0], [3.0, 4.0, 0.0]])


@pytest.mark.parametrize(("dimensions", "expected"), [(2, [5.0, 4.0, 0.0]), (3, [13.0, 4.0, 12.0])])
def test_distances_between_rows_are_those_of_right_triangles(dimensions, expected):
    i, j = np.array([0, 3, 1]), np.array([1, 2, 3])
    assert distances_m(CORNERS[:, :dimensions], i, j).tolist() == expected
    assert distances_m(CORNERS, i[:0], j[:0]).shape == (0,)
