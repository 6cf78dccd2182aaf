"""Clouds from .ply, .npy and .npz files, and the item in them."""

import struct

import numpy as np
import pytest

from vflatten_ros.cloud_files import cloud_to_view, load_cloud_file
from vflatten_ros.core.errors import EmptyView, InvalidCloud, InvalidInput

ROWS, COLS = 120, 40
TYPES = {"float": "f4", "double": "f8", "uchar": "u1", "int": "i4"}


def sheet():
    """(rows, cols, 3) points of a sheet 4 mm apart, half a metre wide, and its colours."""
    row, col = np.mgrid[:ROWS, :COLS]
    xyz = np.stack([0.004 * (col - 20), 0.004 * row - 0.2, 1 + 0.02 * np.sin(col / 6)], axis=2)
    xyz[3, 4] = np.nan
    rgb = np.stack([row % 256, col % 256, (row + col) % 256], axis=2).astype(np.uint8)
    return xyz, rgb


def write_ply(path, encoding, columns, *, before=(), faces=True):
    """columns: (name, type, values of shape (n,))."""
    count = len(columns[0][2])
    lines = ["ply", f"format {encoding} 1.0", "comment made for a test", *before]
    lines += [f"element vertex {count}"]
    lines += [f"property {kind} {name}" for name, kind, _ in columns]
    if faces:
        lines += ["element face 1", "property list uchar int vertex_indices"]
    text = "\n".join([*lines, "end_header\n"]).encode()
    if encoding == "ascii":
        table = np.stack([np.asarray(values, float) for *_, values in columns], axis=1)
        body = "".join(" ".join(f"{v:.9g}" for v in row) + "\n" for row in table).encode()
        body += b"3 0 1 2\n" * faces
    else:
        order = "<" if encoding == "binary_little_endian" else ">"
        table = np.empty(count, [(name, order + TYPES[kind]) for name, kind, _ in columns])
        for name, _, values in columns:
            table[name] = values
        body = table.tobytes() + struct.pack(order + "Biii", 3, 0, 1, 2) * faces
    path.write_bytes(text + body)
    return path


def ply_columns(kind="float", colour=True, normals=True):
    xyz, rgb = sheet()
    columns = [(name, kind, xyz[..., k].ravel()) for k, name in enumerate("xyz")]
    if normals:
        columns += [(name, "float", np.full(ROWS * COLS, 0.5)) for name in ("nx", "ny", "nz")]
    if colour:
        names = ("red", "green", "blue")
        columns += [(name, "uchar", rgb[..., k].ravel()) for k, name in enumerate(names)]
    return columns


@pytest.mark.parametrize("colour", [True, False])
@pytest.mark.parametrize("normals", [True, False])
@pytest.mark.parametrize("kind", ["float", "double"])
@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_every_kind_of_ply_gives_the_same_points(tmp_path, encoding, kind, normals, colour):
    path = write_ply(tmp_path / "a.ply", encoding, ply_columns(kind, colour, normals))
    cloud = load_cloud_file(path)
    xyz, rgb = sheet()
    np.testing.assert_allclose(cloud.xyz, xyz.reshape(1, -1, 3), atol=1e-7)
    assert not cloud.organised
    if colour:
        np.testing.assert_array_equal(cloud.rgb, rgb.reshape(1, -1, 3))
    else:
        assert cloud.rgb is None


def test_an_organised_ply_keeps_its_rows(tmp_path):
    before = [f"obj_info num_cols {COLS}", f"obj_info num_rows {ROWS}"]
    path = write_ply(tmp_path / "a.ply", "ascii", ply_columns(), before=before)
    cloud = load_cloud_file(path)
    np.testing.assert_allclose(cloud.xyz, sheet()[0], atol=1e-7)
    np.testing.assert_array_equal(cloud.rgb, sheet()[1])


def test_the_grid_in_the_camera_element_of_pcl_is_kept(tmp_path):
    points = ply_columns(normals=False)
    path = write_ply(tmp_path / "a.ply", "binary_little_endian", points, faces=False)
    header, body = path.read_bytes().split(b"end_header\n")
    camera = b"element camera 1\nproperty int viewportx\nproperty int viewporty\n"
    body += struct.pack("<ii", COLS, ROWS)
    path.write_bytes(header + camera + b"end_header\n" + body)
    np.testing.assert_allclose(load_cloud_file(path).xyz, sheet()[0], atol=1e-7)


def test_lines_may_end_as_windows_writes_them(tmp_path):
    path = write_ply(tmp_path / "a.ply", "ascii", ply_columns())
    path.write_bytes(path.read_bytes().replace(b"\n", b"\r\n"))
    assert load_cloud_file(path).xyz.shape == (1, ROWS * COLS, 3)


def test_numpy_files_are_read_organised_or_not(tmp_path):
    xyz, rgb = sheet()
    np.save(tmp_path / "grid.npy", xyz)
    np.save(tmp_path / "rows.npy", np.concatenate([xyz, rgb / 255], axis=2).reshape(-1, 6))
    np.savez(tmp_path / "named.npz", points=xyz.astype(np.float32), rgb=rgb)
    np.savez(
        tmp_path / "other.npz", xyz=xyz.reshape(-1, 3), colors=rgb.reshape(-1, 3).astype("u2") << 8
    )
    for name in ("grid.npy", "rows.npy", "named.npz", "other.npz"):
        cloud = load_cloud_file(tmp_path / name)
        assert cloud.organised == (name in ("grid.npy", "named.npz"))
        np.testing.assert_array_equal(cloud.xyz.reshape(xyz.shape), xyz.astype(np.float32))
        if name != "grid.npy":
            np.testing.assert_allclose(cloud.rgb.reshape(rgb.shape).astype(int), rgb, atol=1)


def test_bad_files_are_named_with_what_is_wrong(tmp_path):
    def refused(name, content, words):
        path = tmp_path / name
        if isinstance(content, bytes):
            path.write_bytes(content)
        with pytest.raises(InvalidCloud, match=words) as refusal:
            load_cloud_file(path)
        assert name in str(refusal.value) and "\n" not in str(refusal.value)

    whole = write_ply(tmp_path / "a.ply", "binary_little_endian", ply_columns()).read_bytes()
    text = write_ply(tmp_path / "a.ply", "ascii", ply_columns()).read_bytes()
    np.savez(tmp_path / "a.npz", nothing=np.zeros(3))
    np.save(tmp_path / "a.npy", np.zeros((5, 4)))
    np.save(tmp_path / "nan.npy", np.full((5, 3), np.nan))
    np.save(tmp_path / "mm.npy", np.full((5, 3), 900.0))
    np.save(tmp_path / "text.npy", np.array([["a", "b", "c"]]))
    refused("gone.ply", None, "no such file")
    refused("a.pcd", b"", r"expected \.ply, \.npy or \.npz, got '\.pcd'")
    refused("short.ply", whole[:-2000], "ends within its 4800 vertex rows")
    refused("short2.ply", text[: len(text) // 2], "ends within its 4800 vertex rows|numbers each")
    refused("header.ply", whole[:100], "header is damaged")
    refused("b.ply", b"PK\x03\x04", "no .ply file")
    refused("c.ply", text.replace(b"float x", b"float q"), "vertices have no 'x'")
    refused("d.ply", text.replace(b"float x", b"quad x"), "unknown type 'quad'")
    refused(
        "e.ply", text.replace(b"vertex 4800", b"vertex 99999999999"), "ends within|cannot be read"
    )
    refused("f.ply", b"ply\nformat ascii 1.0\nelement face 0\nend_header\n", "no vertices")
    refused("a.npz", None, "expected an array 'xyz', got nothing")
    refused("a.npy", None, r"expected numbers of shape .*\(5, 4\)")
    refused("text.npy", None, "expected numbers")
    refused("nan.npy", None, "no measured points")
    refused("mm.npy", None, "give metres")
    for k, line in enumerate((b"format", b"element vertex", b"property float", b"property")):
        header = text.replace(b"element vertex", line + b"\nelement vertex", 1)
        refused(f"words{k}.ply", header, "says too little")
    refused("rows.ply", text.replace(b"vertex 4800", b"vertex -5"), "'-5' rows")
    lists = text.replace(b"property float x", b"property list uchar int k\nproperty float x")
    refused("lists.ply", lists, "property that is a list")
    np.savez(tmp_path / "names.npz", xyz=np.ones((5, 3)), rgb=np.full((5, 3), "red"))
    refused("names.npz", None, "colours are <U3")
    plain = (tmp_path / "a.npy").read_bytes()
    refused("header.npy", plain.replace(b"'shape': (5, 4)", b"'shape': (5, 4'"), "cannot be read")
    huge = plain.replace(b"(5, 4), }      ", b"(999999999999, 4), }"[:15] + b"   ")
    assert huge != plain
    refused("huge.npy", huge, "cannot be read")
    refused("cut.npz", (tmp_path / "a.npz").read_bytes()[:50], "cannot be read")


def sheet_file(tmp_path, extra=None):
    xyz, rgb = sheet()
    points, colours = xyz.reshape(-1, 3), rgb.reshape(-1, 3)
    if extra is not None:
        points = np.concatenate([points, extra])
        colours = np.concatenate([colours, np.zeros((len(extra), 3), np.uint8)])
    np.savez(tmp_path / "sheet.npz", xyz=points, rgb=colours)
    return load_cloud_file(tmp_path / "sheet.npz")


def test_points_where_no_camera_measures_are_none(tmp_path):
    cloud = sheet_file(tmp_path, np.full((30, 3), 1e10))
    assert np.isnan(cloud.xyz[0, -30:]).all()
    np.testing.assert_allclose(cloud.xyz[0, :-30], sheet()[0].reshape(-1, 3), atol=1e-7)


def test_a_view_of_a_cloud_stands_below_its_highest_point(tmp_path):
    view = cloud_to_view(sheet_file(tmp_path))
    assert len(view.points_rig) == ROWS * COLS - 1
    seen = view.points_view  # x right, y up, z towards the camera
    assert seen[:, 1].max() == pytest.approx(0.0, abs=1e-9)
    assert seen[:, 1].min() == pytest.approx(-0.004 * (ROWS - 1), abs=1e-6)
    assert np.ptp(seen[:, 0]) == pytest.approx(0.004 * (COLS - 1), abs=0.01)  # seen from the top
    right = view.points_rig[:, 0].argmax()
    assert seen[right, 0] == seen[:, 0].max()
    np.testing.assert_allclose(view.points_hanger[:, [1, 2, 0]], seen, atol=1e-12)


def test_up_is_any_direction(tmp_path):
    upright = sheet_file(tmp_path)
    view = cloud_to_view(upright)
    turned = type(upright)(0, upright.frame_id, upright.xyz[..., [2, 0, 1]].copy(), upright.rgb)
    other = cloud_to_view(turned, up=(0, 0, -7.0))  # y down became z down
    np.testing.assert_allclose(other.points_view, view.points_view, atol=1e-6)


def test_the_crop_box_and_the_noise_filter_leave_the_item(tmp_path):
    floating = np.array([[0.0, 0.0, 0.9], [0.01, 0.1, 1.2]])
    wall = np.stack(
        [*np.meshgrid(np.arange(-1, 1, 0.02), np.arange(-1, 1, 0.02)), np.full((100, 100), 2.0)], 2
    )
    cloud = sheet_file(tmp_path, np.concatenate([floating, wall.reshape(-1, 3)]))
    view = cloud_to_view(cloud, crop_box=(-0.5, -0.5, 0.5, 0.5, 0.5, 1.5))
    assert len(view.points_rig) == ROWS * COLS - 1
    with pytest.raises(EmptyView, match="0 points in the crop box"):
        cloud_to_view(cloud, crop_box=(5, 5, 5, 6, 6, 6))


def test_wrong_directions_boxes_and_frames_are_refused(tmp_path):
    cloud = sheet_file(tmp_path)
    with pytest.raises(InvalidInput, match="up: expected a direction, got zero"):
        cloud_to_view(cloud, up=(0, 0, 0))
    with pytest.raises(InvalidInput, match="up: expected 3 finite numbers"):
        cloud_to_view(cloud, up=(0, 1))
    with pytest.raises(InvalidInput, match="expected least x, y, z, then greatest"):
        cloud_to_view(cloud, crop_box=(1, 0, 0, 0, 1, 1))
    around = cloud.xyz - np.nanmean(cloud.xyz, axis=(0, 1))
    with pytest.raises(InvalidCloud, match="the origin, where the camera is expected"):
        cloud_to_view(type(cloud)(0, "file", around, None))
