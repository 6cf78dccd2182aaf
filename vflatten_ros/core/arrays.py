"""Shape and type checks of arrays, made once at the door of every public function."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vflatten_ros.core.errors import InvalidInput

Array = NDArray[Any]


def as_points(values: ArrayLike, name: str, dimensions: int = 3) -> NDArray[np.float64]:
    """Finite coordinates as a float64 array.

    Parameters
    ----------
    values : array_like of shape (n, dimensions)
        Coordinates in metres.
    name : str
        What to call the argument in an error.
    dimensions : int
        Columns expected.

    Returns
    -------
    ndarray of shape (n, dimensions), float64

    Raises
    ------
    InvalidInput
        Wrong shape, or a value that is not finite.
    """
    points = np.asarray(values, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != dimensions:
        raise InvalidInput(f"{name}: expected shape (n, {dimensions}), got {points.shape}")
    if not np.isfinite(points).all():
        bad = int((~np.isfinite(points).all(axis=1)).sum())
        raise InvalidInput(f"{name}: {bad} of {len(points)} rows are not finite; remove them first")
    return points


def as_vector(values: ArrayLike, name: str, length: int = 3) -> NDArray[np.float64]:
    """A finite float64 vector of a given length; raises InvalidInput otherwise."""
    vector = np.asarray(values, dtype=np.float64)
    if vector.shape != (length,) or not np.isfinite(vector).all():
        raise InvalidInput(f"{name}: expected {length} finite numbers, got {np.asarray(values)!r}")
    return vector


def frozen(array: Array) -> Array:
    """The same array, marked read-only."""
    array.setflags(write=False)
    return array
