"""Any legal PointCloud2 layout gives the same points; the others are refused in words."""

import array
import contextlib

import numpy as np
import pytest

from vflatten_ros.core.errors import InvalidCloud
from vflatten_ros.core.pointcloud import PointField, decode_cloud

ROWS, COLS = 4, 5
FORMATS = {2: "u1", 6: "u4", 7: "f4", 8: "f8"}


def known_points():
    xyz = np.arange(ROWS * COLS * 3, dtype=np.float64).reshape(ROWS, COLS, 3) / 8 + 1
    xyz[1, 2] = np.nan
    return xyz


def known_colours():
    return (np.arange(ROWS * COLS * 3).reshape(ROWS, COLS, 3) * 7 % 256).astype(np.uint8)


def packed_colours():
    red, green, blue = np.moveaxis(known_colours().astype(np.uint32), 2, 0)
    return 0xFF000000 | red << 16 | green << 8 | blue


def message(columns, *, rows=ROWS, cols=COLS, order="<", padding=0, row_padding=0):
    """Arguments of decode_cloud. columns: (name, offset, datatype, values)."""
    step = (
        max(offset + np.dtype(FORMATS[kind]).itemsize for _, offset, kind, _ in columns) + padding
    )
    data = np.full((rows, cols * step + row_padding), 0xA5, np.uint8)
    for _, offset, kind, values in columns:
        raw = np.ascontiguousarray(values.reshape(rows, cols), dtype=order + FORMATS[kind])
        raw = raw.view(np.uint8).reshape(rows, cols, -1)
        for col in range(cols):
            start = col * step + offset
            data[:, start : start + raw.shape[2]] = raw[:, col]
    return {
        "stamp_ns": 5,
        "frame_id": "rig",
        "height": rows,
        "width": cols,
        "fields": [PointField(name, offset, kind, 1) for name, offset, kind, _ in columns],
        "is_bigendian": order == ">",
        "point_step": step,
        "row_step": data.shape[1],
        "data": data.tobytes(),
    }


def xyz_columns(kind=7, offsets=(0, 4, 8)):
    xyz = known_points()
    return [(name, at, kind, xyz[..., k]) for k, (name, at) in enumerate(zip("xyz", offsets))]


LAYOUTS = {
    "plain": (xyz_columns(), {}),
    "padded points": (xyz_columns(), {"padding": 20}),
    "padded rows": (xyz_columns(), {"row_padding": 7}),
    "one unaligned byte before": (xyz_columns(offsets=(1, 5, 9)), {}),
    "any order": (xyz_columns(offsets=(9, 1, 5)), {}),
    "gaps": (xyz_columns(offsets=(0, 8, 16)), {}),
    "float64": (xyz_columns(8, (0, 8, 16)), {}),
    "big-endian": (xyz_columns(), {"order": ">"}),
    "big-endian float64, padded": (xyz_columns(8, (4, 12, 20)), {"order": ">", "row_padding": 3}),
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_every_layout_gives_the_same_points(layout):
    columns, options = LAYOUTS[layout]
    cloud = decode_cloud(**message(columns, **options))
    np.testing.assert_array_equal(cloud.xyz, known_points().astype(np.float32))
    assert cloud.xyz.dtype == np.float32
    assert (cloud.stamp_ns, cloud.frame_id, cloud.rgb, cloud.organised) == (5, "rig", None, True)


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("name", ["rgb", "rgba"])
@pytest.mark.parametrize("kind", [6, 7])
def test_packed_colours_are_read_from_float32_and_uint32(order, name, kind):
    packed = packed_colours()
    values = packed.view(np.float32) if kind == 7 else packed
    cloud = decode_cloud(**message([*xyz_columns(), (name, 16, kind, values)], order=order))
    np.testing.assert_array_equal(cloud.rgb, known_colours())


def test_separate_colours_are_read():
    rgb = known_colours()
    columns = [(name, 14 - k, 2, rgb[..., k]) for k, name in enumerate("rgb")]
    np.testing.assert_array_equal(decode_cloud(**message([*xyz_columns(), *columns])).rgb, rgb)


def test_an_unorganised_cloud_is_one_row():
    xyz = known_points()
    columns = [(name, 4 * k, 7, xyz[..., k]) for k, name in enumerate("xyz")]
    given = message(columns, rows=1, cols=ROWS * COLS)
    given["row_step"] = 0  # as some drivers write it
    cloud = decode_cloud(**given)
    assert cloud.xyz.shape == (1, ROWS * COLS, 3)
    assert not cloud.organised
    np.testing.assert_array_equal(cloud.xyz.reshape(xyz.shape), xyz.astype(np.float32))


def test_a_point_with_any_bad_coordinate_is_unmeasured_in_all():
    xyz = known_points()
    xyz[0, 0, 1], xyz[0, 1, 2], xyz[0, 2, 0], xyz[0, 3] = np.inf, -np.inf, np.nan, 0.0
    columns = [(name, 8 * k, 8, xyz[..., k]) for k, name in enumerate("xyz")]
    unmeasured = np.isnan(decode_cloud(**message(columns)).xyz).all(axis=2)
    assert unmeasured[0, :4].all()
    assert unmeasured.sum() == 5  # and the one that was unmeasured before
    kept = decode_cloud(**message(columns), zero_is_unmeasured=False).xyz
    np.testing.assert_array_equal(kept[0, 3], 0.0)


def test_a_float64_beyond_float32_is_unmeasured():
    xyz = known_points()
    xyz[2, 2, 0] = 1e300
    columns = [(name, 8 * k, 8, xyz[..., k]) for k, name in enumerate("xyz")]
    assert np.isnan(decode_cloud(**message(columns)).xyz[2, 2]).all()


@pytest.mark.parametrize(
    "kind", [bytes, bytearray, memoryview, lambda b: array.array("B", b), list]
)
def test_data_comes_in_any_buffer_and_is_not_changed(kind):
    given = message(xyz_columns())
    given["data"] = kind(given["data"])
    before = bytes(given["data"])
    cloud = decode_cloud(**given)
    np.testing.assert_array_equal(cloud.xyz, known_points().astype(np.float32))
    assert bytes(given["data"]) == before
    with pytest.raises(ValueError, match="read-only"):
        cloud.xyz[0, 0, 0] = 1.0


@pytest.mark.parametrize("size", [(0, 0), (0, 5), (1, 0)])
def test_no_points_are_no_error(size):
    given = message(xyz_columns())
    given.update(height=size[0], width=size[1], row_step=0, data=b"")
    assert decode_cloud(**given).xyz.shape == (*size, 3)


LIES = {
    "short data": ({"data": b"1234"}, "needs .* bytes .*, got 4"),
    "tall": ({"height": ROWS + 1}, "needs .* bytes"),
    "wide": ({"width": COLS + 1}, "row_step .* less than width"),
    "absurd": ({"height": 2**32 - 1, "width": 2**32 - 1}, "at most"),
    "absurdly many of none": ({"height": 2**32 - 1, "width": 0, "point_step": 4096}, "at most"),
    "large but plausible": ({"height": 6000, "width": 10000, "row_step": 120000}, "needs .* bytes"),
    "negative": ({"height": -1}, "height -1"),
    "point_step 0": ({"point_step": 0}, "point"),
    "point_step short": ({"point_step": 8}, "'z' covers bytes 8 to 12 of a point of 8"),
    "row_step short": ({"row_step": 3}, "row_step 3"),
    "no fields": ({"fields": []}, "no field 'x' .*none"),
    "no z": ({"fields": [PointField("x", 0, 7, 1), PointField("y", 4, 7, 1)]}, "no field 'z'"),
    "overlap": (
        {"fields": [PointField(n, 2 * k, 7, 1) for k, n in enumerate("xyz")]},
        "'x' and 'y' overlap",
    ),
    "beyond the point": (
        {"fields": [PointField(n, 2**31 + 4 * k, 7, 1) for k, n in enumerate("xyz")]},
        "covers bytes",
    ),
    "negative offset": (
        {"fields": [PointField(n, 4 * k - 4, 7, 1) for k, n in enumerate("xyz")]},
        "covers bytes -4",
    ),
    "unknown type": ({"fields": [PointField(n, 0, 99, 1) for n in "xyz"]}, "datatype 99"),
    "integers": ({"fields": [PointField(n, 4 * k, 5, 1) for k, n in enumerate("xyz")]}, "float32"),
    "no buffer": ({"data": 3.5}, "no buffer|object"),
}


@pytest.mark.parametrize("lie", LIES)
def test_a_lying_layout_is_refused(lie):
    change, words = LIES[lie]
    with pytest.raises(InvalidCloud, match=words):
        decode_cloud(**{**message(xyz_columns()), **change})


def test_random_headers_never_do_worse_than_invalid_cloud():
    chance = np.random.default_rng(1)
    sizes = [0, 1, 3, 7, 12, 16, 255, 2**16, 2**31, 2**32 - 1]
    for _ in range(3000):
        height, width, point_step, row_step = (int(n) for n in chance.choice(sizes, 4))
        fields = [
            PointField(str(name), int(chance.choice(sizes)), int(chance.integers(0, 10)), 1)
            for name in chance.choice(["x", "y", "z", "rgb"], 4)
        ]
        given = message(xyz_columns())
        given.update(height=height, width=width, point_step=point_step, row_step=row_step)
        given["data"] = bytes(int(chance.choice([0, 12, 1000])))
        with contextlib.suppress(InvalidCloud):
            decode_cloud(**{**given, "fields": fields})
