"""One cloud from a file, without a robot: .npz, .npy and .ply."""

from __future__ import annotations

import dataclasses
import zipfile
from collections.abc import Sequence
from pathlib import Path
from tokenize import TokenError
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vflatten_ros.core.arrays import as_vector
from vflatten_ros.core.config import SegmentationConfig
from vflatten_ros.core.errors import EmptyView, InvalidCloud, InvalidInput
from vflatten_ros.core.geometry import Float
from vflatten_ros.core.pieces import pieces
from vflatten_ros.core.segmentation import has_support, point_spacing, view_at
from vflatten_ros.core.values import Bool, Byte, Calibration, Cloud, View
from vflatten_ros.ply import read_ply

FRAME = "cloud_file"
COLOUR_KEYS = ("rgb", "colors", "colours", "color")
POINT_KEYS = ("xyz", "points", "arr_0")
NEAREST_M = 0.05  # of the axis to the camera
BROKEN = (
    OSError,
    ValueError,
    EOFError,
    KeyError,
    MemoryError,
    SyntaxError,
    TokenError,
    zipfile.BadZipFile,
)  # fmt: skip  what numpy's and zip files' readers raise
FARTHEST_M = 1e4  # beyond, no camera has measured anything
LARGEST_M = 20.0  # clouds of indoor cameras stay below; millimetres do not


def load_cloud_file(path: str | Path) -> Cloud:
    """Read a cloud, in metres.

    .ply: vertices with x, y, z and perhaps colours; ASCII or binary; organised where the header
    says so (`obj_info num_cols`, `num_rows`, or the camera element that PCL writes). .npy: (n, 3),
    (n, 6) with colours, or the same as (rows, cols, ...). .npz: 'xyz' or 'points' alike, and
    perhaps 'rgb'. Points that are not finite or are (0, 0, 0) are unmeasured.

    Returns
    -------
    Cloud
        frame_id 'cloud_file', stamp 0.

    Raises
    ------
    InvalidCloud
        The file is missing, of another kind, or damaged.
    """
    path = Path(path)
    try:
        if path.suffix.lower() == ".ply":
            xyz, rgb = read_ply(path)
        elif path.suffix.lower() in (".npy", ".npz"):
            xyz, rgb = _read_numpy(path)
        else:
            raise InvalidCloud(f"expected .ply, .npy or .npz, got {path.suffix or 'no suffix'!r}")
        return _cloud(xyz, rgb)
    except FileNotFoundError as error:
        raise InvalidCloud(f"{path}: no such file") from error
    except InvalidCloud as error:
        raise InvalidCloud(f"{path}: {error}") from error
    except BROKEN as error:
        reason = " ".join(str(error).split())
        raise InvalidCloud(f"{path}: cannot be read ({reason}); is it complete?") from error


def cloud_to_view(
    cloud: Cloud,
    up: Sequence[float] = (0.0, -1.0, 0.0),
    crop_box: Sequence[float] | None = None,
    config: SegmentationConfig | None = None,
) -> View:
    """The item in one cloud, as if it hung from a wrist at angle 0.

    The cloud's own frame is the rig frame, so the camera is at its origin. The hanger frame's
    origin is the item's highest point, z is up, and x points horizontally towards the camera.

    Parameters
    ----------
    cloud : Cloud
    up : three numbers
        Upward direction in the cloud's frame; (0, -1, 0) in an upright camera's optical frame.
    crop_box : six numbers, optional
        Least x, y, z, then greatest x, y, z of the item, m, in the cloud's frame.
    config : SegmentationConfig, optional
        How noise is told from cloth.

    Raises
    ------
    InvalidInput
        `up` has no length, or the box no volume.
    EmptyView
        No points are left in the box.
    InvalidCloud
        The camera is not at the origin.
    """
    config = config or SegmentationConfig()
    up_unit = _unit(up)
    index = np.flatnonzero(_inside(cloud.xyz.reshape(-1, 3), crop_box))
    if len(index) < config.min_points:
        raise EmptyView(
            f"{len(index)} points in the crop box, expected {config.min_points} or more"
        )
    spacing = point_spacing(cloud, index)
    index = index[has_support(cloud, index, spacing, up_unit, config)]
    points = cloud.xyz.reshape(-1, 3)[index]
    if len(points):
        voxel, label = pieces(points, max(config.link_m, 3.0 * spacing))
        area = np.bincount(label[voxel]) * spacing**2
        index = index[(area > config.piece_area_m2)[label[voxel]]]
    if len(index) < config.min_points:
        raise EmptyView(f"{len(index)} points left without noise, expected {config.min_points}")
    pixel = np.stack(np.divmod(index, cloud.xyz.shape[1]), axis=1).astype(np.int32)
    calibration = _standing(cloud.xyz.reshape(-1, 3)[index].astype(np.float64), up_unit, cloud)
    return view_at(0, cloud, pixel, calibration, 0.0)


def _standing(points: Float, up: Float, cloud: Cloud) -> Calibration:
    """A calibration whose axis goes up through the item's highest point."""
    top = points[int((points @ up).argmax())]
    level = points - np.outer(points @ up, up)
    away = float(np.linalg.norm(level.mean(axis=0)))
    reach = float(np.linalg.norm(level - level.mean(axis=0), axis=1).max())
    if away < reach or np.linalg.norm(top - (top @ up) * up) < NEAREST_M:
        raise InvalidCloud(
            f"the item's middle is {away:.3f} m beside the origin, where the camera is expected, "
            f"and the item reaches {reach:.3f} m; give the cloud and --up in the camera's frame"
        )
    x, y, z = top.tolist()
    a, b, c = up.tolist()
    return Calibration(cloud.frame_id, (x, y, z), (a, b, c), (x, y, z), "none", 1.0, 0.0)


def _unit(up: Sequence[float]) -> Float:
    direction = as_vector(up, "up")
    length = np.linalg.norm(direction)
    if length < 1e-9:
        raise InvalidInput("up: expected a direction, got zero; in an optical frame it is 0,-1,0")
    unit: Float = direction / length
    return unit


def _inside(points: NDArray[np.float32], crop_box: Sequence[float] | None) -> Bool:
    inside: Bool = np.isfinite(points).all(axis=1)
    if crop_box is None:
        return inside
    box = as_vector(crop_box, "crop box", 6)
    low, high = box[:3], box[3:]
    if not (low < high).all():
        raise InvalidInput(
            f"crop box: expected least x, y, z, then greatest x, y, z, got {box.tolist()}"
        )
    within: Bool = inside & (points >= low).all(axis=1) & (points <= high).all(axis=1)
    return within


def _read_numpy(path: Path) -> tuple[NDArray[Any], NDArray[Any] | None]:
    loaded = np.load(path, allow_pickle=False)
    if isinstance(loaded, np.ndarray):
        return _split(loaded)
    with loaded:
        name = next((key for key in POINT_KEYS if key in loaded), None)
        if name is None:
            raise InvalidCloud(f"expected an array 'xyz', got {', '.join(loaded.files) or 'none'}")
        xyz, rgb = _split(loaded[name])
        colour = next((key for key in COLOUR_KEYS if key in loaded), None)
        return xyz, rgb if colour is None else loaded[colour]


def _split(array: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any] | None]:
    if array.ndim not in (2, 3) or array.shape[-1] not in (3, 6) or array.dtype.kind not in "fiu":
        raise InvalidCloud(
            f"expected numbers of shape (n, 3), (n, 6) or (rows, cols, 3 or 6), got "
            f"{array.dtype} {array.shape}"
        )
    return array[..., :3], array[..., 3:] if array.shape[-1] == 6 else None


def _cloud(xyz: NDArray[Any], rgb: NDArray[Any] | None) -> Cloud:
    with np.errstate(over="ignore", invalid="ignore"):
        points = np.array(xyz, dtype=np.float32)
        if points.ndim == 2:
            points = points[np.newaxis]
        bad = ~np.isfinite(points).all(axis=2) | (points == 0).all(axis=2)
    points[bad] = np.nan
    if bad.all():
        raise InvalidCloud("no measured points")
    away = np.where(bad, 0.0, np.abs(np.where(bad[..., None], 0.0, points)).max(axis=2))
    largest = float(np.median(away[~bad]))
    if largest > LARGEST_M:
        raise InvalidCloud(f"half of the points are {largest:.0f} m away or more; give metres")
    points[away > FARTHEST_M] = np.nan
    cloud = Cloud(0, FRAME, points, None)
    return cloud if rgb is None else dataclasses.replace(cloud, rgb=_colours(rgb, points.shape))


def _colours(rgb: NDArray[Any], shape: tuple[int, ...]) -> Byte:
    if rgb.size != np.prod(shape):
        raise InvalidCloud(f"{rgb.size // 3} colours for {shape[0] * shape[1]} points")
    if rgb.dtype.kind not in "biuf":
        raise InvalidCloud(f"colours are {rgb.dtype}; expected numbers")
    values = rgb.reshape(shape)
    if values.dtype == np.uint16:
        values = values >> 8
    elif values.dtype.kind == "f" and np.nanmax(values, initial=0.0) <= 1.0:
        values = values * 255.0
    return np.clip(np.nan_to_num(values), 0, 255).astype(np.uint8)
