"""The item is told from gripper, wall, table and flying pixels, at any resolution."""

import json
from pathlib import Path

import numpy as np
import pytest

from vflatten_ros.bag import RecordedCloud, open_recording
from vflatten_ros.core.calibration import calibration_from
from vflatten_ros.core.config import SegmentationConfig
from vflatten_ros.core.errors import EmptyView
from vflatten_ros.core.segmentation import make_view, segment
from vflatten_ros.core.values import Cloud
from vflatten_ros.files import load_calibration

BAGS = Path(__file__).parents[2] / "bags"
ITEM, GRIPPER, SCENE, FLYING = 1, 2, 3, 4
TIP = np.array([0.0, -0.4, 1.3])
DEFAULT = SegmentationConfig()


def calibration(tip=TIP, up=(0.0, -1.0, 0.0)):
    return calibration_from(
        {
            "frame": "rig",
            "axis_point": list(tip),
            "axis_direction": list(up),
            "gripper_tip": list(tip),
            "joint": "wrist",
            "joint_sign": 1,
            "joint_zero": 0.0,
        }
    )


class Scene:
    """Ray-cast depth image of surfaces z(x, y), nearest first; label of each pixel."""

    def __init__(self, rows=480, cols=360, focal=520.0):
        row, col = np.mgrid[:rows, :cols]
        self.x = (col - (cols - 1) / 2) / focal
        self.y = (row - (rows - 1) / 2) / focal
        self.z = np.full((rows, cols), np.inf)
        self.label = np.zeros((rows, cols), int)

    def add(self, depth, where, label):
        """Surface at depth(x, y) wherever where(x, y) holds, in metres."""
        z = np.full(self.z.shape, 1.3)
        for _ in range(12):  # a contraction: the rays are steeper than the surfaces
            z = depth(self.x * z, self.y * z)
        hit = where(self.x * z, self.y * z) & (z < self.z)
        self.z[hit], self.label[hit] = z[hit], label
        return self

    def cloud(self, noise=0.001, flying=0.0, seed=0):
        chance = np.random.default_rng(seed)
        z = self.z + chance.normal(0, noise, self.z.shape)
        off = (chance.random(z.shape) < flying) & (self.label == ITEM)
        z[off] += chance.uniform(0.03, 0.1, off.sum()) * chance.choice([-1, 1], off.sum())
        self.label[off] = FLYING
        z[~np.isfinite(z)] = np.nan
        xyz = np.stack([self.x * z, self.y * z, z], axis=2).astype(np.float32)
        return Cloud(0, "rig", xyz, None)


def hanging_item(**camera):
    """A wavy triangle that hangs from the tip down 0.75 m, and the gripper above it."""
    scene = Scene(**camera)
    scene.add(
        lambda x, y: 1.3 + 0.03 * np.sin(25 * x),
        lambda x, y: (y > -0.4) & (y < 0.35) & (np.abs(x) < 0.02 + 0.25 * (y + 0.4)),
        ITEM,
    )
    return scene.add(
        lambda x, y: 1.29 + 0 * x, lambda x, y: (y < -0.394) & (np.abs(x) < 0.012), GRIPPER
    )


def wall(scene, depth, slope=0.0):
    return scene.add(lambda x, y: depth + slope * x, lambda x, y: np.isfinite(x), SCENE)


def kept(cloud, tip=TIP, up=(0.0, -1.0, 0.0), config=DEFAULT):
    pixel = segment(cloud, calibration(tip, up), config)
    mask = np.zeros(cloud.xyz.shape[:2], bool)
    mask[pixel[:, 0], pixel[:, 1]] = True
    assert mask.sum() == len(pixel), "a pixel was given twice"
    return mask


def recall(mask, label):
    return mask[label == ITEM].mean()


def foreign(mask, label):
    return np.isin(label[mask], [0, GRIPPER, SCENE]).sum()


CAMERAS = {
    "240 x 180": {"rows": 240, "cols": 180, "focal": 260.0},
    "480 x 360": {},
    "960 x 1280": {"rows": 960, "cols": 1280, "focal": 1040.0},
}
SURROUNDINGS = {
    "nothing": lambda scene: scene,
    "wall far behind": lambda scene: wall(scene, 2.0),
    "wall within the radius": lambda scene: wall(scene, 1.6),
    "wall close behind": lambda scene: wall(scene, 1.42),
    "oblique wall": lambda scene: wall(scene, 1.7, slope=0.7),
    "table below": lambda scene: scene.add(
        # y = 0.45 seen from above: z where the ray reaches that height
        lambda x, y: np.where(scene.y > 0.2, 0.45 / np.maximum(scene.y, 0.2), 50.0),
        lambda x, y: scene.y > 0.2,
        SCENE,
    ),
}


@pytest.mark.parametrize(
    ("camera", "surrounding"),
    [("480 x 360", name) for name in SURROUNDINGS]
    + [("240 x 180", "wall close behind"), ("240 x 180", "table below")]
    + [("960 x 1280", "wall within the radius"), ("960 x 1280", "nothing")],
)
def test_the_item_is_kept_and_nothing_else(camera, surrounding):
    scene = SURROUNDINGS[surrounding](hanging_item(**CAMERAS[camera]))
    cloud = scene.cloud()
    mask = kept(cloud)
    assert recall(mask, scene.label) > 0.99
    assert foreign(mask, scene.label) == 0


@pytest.mark.parametrize("noise", [0.0, 0.002, 0.003])
def test_noise_of_the_depth_costs_no_points(noise):
    scene = wall(hanging_item(), 1.7)
    mask = kept(scene.cloud(noise=noise))
    assert recall(mask, scene.label) > 0.99
    assert foreign(mask, scene.label) == 0


def test_flying_pixels_are_removed():
    scene = hanging_item()
    mask = kept(scene.cloud(flying=0.01))
    assert recall(mask, scene.label) > 0.99
    # All lie 3 cm or more off; a few of them by chance beside one another.
    assert mask[scene.label == FLYING].mean() < 0.05


def test_an_unorganised_cloud_gives_the_same_points():
    scene = wall(hanging_item(), 1.7)
    organised = scene.cloud(flying=0.01)
    mask = kept(organised)
    measured = np.isfinite(organised.xyz[..., 0])
    order = np.random.default_rng(0).permutation(measured.sum())
    points = organised.xyz[measured][order][np.newaxis]
    unorganised = kept(Cloud(0, "rig", points, None))
    label = scene.label[measured][order][np.newaxis]
    assert recall(unorganised, label) > 0.99
    assert foreign(unorganised, label) == 0
    assert unorganised[label == FLYING].mean() < 0.05
    assert (unorganised[0] == mask[measured][order]).mean() > 0.995


def test_a_camera_on_its_side_makes_no_difference():
    scene = wall(hanging_item(), 1.7)
    upright = scene.cloud(flying=0.01)
    xyz = np.ascontiguousarray(np.swapaxes(upright.xyz, 0, 1)[..., [1, 0, 2]])
    mask = kept(Cloud(0, "rig", xyz, None), tip=TIP[[1, 0, 2]], up=(-1.0, 0.0, 0.0))
    np.testing.assert_array_equal(mask.T, kept(upright))


def test_a_tilted_axis_cuts_at_its_own_tip():
    up = np.array([0.1, -1.0, 0.05]) / np.linalg.norm([0.1, -1.0, 0.05])
    scene = hanging_item()
    cloud = scene.cloud()
    mask = kept(cloud, up=up)
    below = (TIP - cloud.xyz[mask]) @ up
    assert below.min() > DEFAULT.tip_clearance_m - 1e-6
    assert recall(mask, scene.label) > 0.99


def test_pieces_that_the_item_hides_from_the_tip_belong_to_it():
    scene = Scene()
    parts = {
        "body": (1.25, lambda x, y: (np.abs(x) < 0.05) & (y > -0.4) & (y < 0.2)),
        "sleeve beside and behind it": (1.38, lambda x, y: (abs(x - 0.12) < 0.04) & (abs(y) < 0.1)),
        "hem below an edge-on strip": (1.3, lambda x, y: (abs(x) < 0.05) & (abs(y - 0.4) < 0.05)),
    }
    for depth, where in parts.values():
        scene.add(lambda x, y, depth=depth: depth + 0 * x, where, ITEM)
    assert recall(kept(scene.cloud()), scene.label) > 0.99


def test_an_edge_on_start_does_not_lose_the_item():
    scene = Scene().add(
        lambda x, y: 1.3 + 0 * x, lambda x, y: (np.abs(x) < 0.1) & (y > -0.15) & (y < 0.3), ITEM
    )
    assert recall(kept(scene.cloud()), scene.label) > 0.99  # nothing seen for 0.25 m below the tip


def test_patches_of_depth_by_chance_are_left_out():
    """As of stereo that has nothing to match: more and larger than an item's own pieces."""
    scene = hanging_item()
    chance = np.random.default_rng(4)
    for _ in range(150):
        row, col = chance.integers(0, 470), chance.integers(40, 310)
        patch = np.s_[row : row + 4, col : col + chance.integers(6, 14)]
        here = np.zeros(scene.z.shape, bool)
        here[patch] = True
        here &= scene.label == 0
        scene.z[here], scene.label[here] = chance.uniform(1.0, 1.7), SCENE
    mask = kept(scene.cloud())
    assert recall(mask, scene.label) > 0.99
    assert foreign(mask, scene.label) < 0.02 * mask.sum()


def test_another_thing_in_the_cylinder_is_left_out():
    scene = hanging_item().add(
        lambda x, y: 1.75 + 0 * x, lambda x, y: (np.abs(x) < 0.5) & (np.abs(y) < 0.1), SCENE
    )
    mask = kept(scene.cloud())
    assert foreign(mask, scene.label) == 0
    assert recall(mask, scene.label) > 0.99


def test_an_item_that_touches_the_wall_loses_only_what_touches():
    scene = wall(hanging_item(), 1.31)  # the wall runs through the folds
    cloud = scene.cloud()
    mask = kept(cloud)
    clear = (scene.label == ITEM) & (cloud.xyz[..., 2] < 1.31 - DEFAULT.wall_m - 0.003)
    assert mask[clear].mean() > 0.98
    assert foreign(mask, scene.label) < 0.01 * (scene.label == ITEM).sum()


def test_a_flat_item_is_not_taken_for_a_wall():
    scene = Scene().add(
        lambda x, y: 1.3 + 0 * x, lambda x, y: (np.abs(x) < 0.3) & (y > -0.4) & (y < 0.35), ITEM
    )
    assert recall(kept(scene.cloud()), scene.label) > 0.98


def test_an_item_wider_than_the_radius_is_cut_there():
    scene = hanging_item()
    cloud = scene.cloud()
    mask = kept(cloud, config=SegmentationConfig(radius_m=0.1))
    radius = np.hypot(cloud.xyz[..., 0] - TIP[0], cloud.xyz[..., 2] - TIP[2])
    assert radius[mask].max() <= 0.1 + 1e-6
    assert mask[(scene.label == ITEM) & (radius < 0.099)].mean() > 0.98


def test_an_empty_gripper_says_so():
    for scene in (Scene(), wall(Scene(), 2.0), wall(Scene(), 1.5)):
        with pytest.raises(EmptyView, match="below the gripper tip"):
            segment(scene.cloud(), calibration(), DEFAULT)
    nothing = Cloud(0, "rig", np.zeros((0, 0, 3), np.float32), None)
    with pytest.raises(EmptyView, match="0 item points"):
        segment(nothing, calibration(), DEFAULT)


def test_a_view_holds_the_points_and_colours_of_its_pixels_only():
    scene = hanging_item()
    cloud = scene.cloud()
    rgb = np.random.default_rng(0).integers(0, 255, cloud.xyz.shape, dtype=np.uint8)
    view = make_view(7, Cloud(9, "rig", cloud.xyz, rgb), calibration(), 0.5, DEFAULT)
    row, col = view.pixel.T
    np.testing.assert_array_equal(view.points_rig, cloud.xyz[row, col].astype(np.float64))
    np.testing.assert_array_equal(view.rgb, rgb[row, col])
    assert (view.view_id, view.stamp_ns, view.angle_rad, view.shape) == (7, 9, 0.5, (480, 360))
    assert view.points_rig.base is None  # the cloud can go
    assert (np.diff(row * 360 + col) > 0).all()  # row-major


@pytest.mark.parametrize("name", ["LS1_1", "TR1_1", "SH1_1"])
def test_the_carried_recordings_agree_with_their_truth(name):
    folder = BAGS / name
    truth = np.load(folder / "truth.npz")
    assert not json.loads((folder / "truth.json").read_text())["wall"]
    rig = load_calibration(folder / "calibration.yaml")
    clouds = (m for m in open_recording(folder).messages() if isinstance(m, RecordedCloud))
    for number, message in enumerate(clouds):
        cloud = message.decode()
        here = truth["view"] == number
        row, col, flying = (truth[key][here] for key in ("row", "col", "flying"))
        off = np.abs(cloud.xyz[row, col, 2] - truth["depth"][here]) > 0.01
        label = np.zeros(cloud.xyz.shape[:2], int)
        label[row, col] = np.where(flying, np.where(off, FLYING, 0), ITEM)
        mask = np.zeros(label.shape, bool)
        mask[tuple(segment(cloud, rig, DEFAULT).T)] = True
        garment = np.zeros(label.shape, bool)
        garment[row, col] = True
        assert recall(mask, label) > 0.985, number  # a view edge-on loses most
        assert mask[label == FLYING].mean() < 0.25, number  # some float near another layer
        assert (mask & ~garment).sum() <= 1, number  # gripper


def test_a_pile_on_the_table_below_is_left_out():
    scene = SURROUNDINGS["table below"](hanging_item())
    scene.add(
        lambda x, y: 1.25 + 0 * x, lambda x, y: (np.abs(x) < 0.1) & (y > 0.38) & (y < 0.45), SCENE
    )
    mask = kept(scene.cloud())
    assert foreign(mask, scene.label) == 0
    assert recall(mask, scene.label) > 0.99


def fattened(cloud, px):
    """What is in front made wider by some pixels, as block matching does."""
    z = np.where(np.isnan(cloud.xyz[..., 2]), 9.0, cloud.xyz[..., 2])
    ray = np.stack([hanging_item().x, hanging_item().y, np.ones(z.shape)], axis=2)
    for _ in range(px):
        beside = np.stack(
            [np.roll(z, (down, right), (0, 1)) for down in (-1, 0, 1) for right in (-1, 0, 1)]
        ).min(axis=0)
        z = np.where(z - beside > 0.01, beside, z)
    z[z == 9.0] = np.nan
    return Cloud(0, "rig", (ray * z[..., None]).astype(np.float32), None)


def test_edges_that_stereo_makes_wider_are_trimmed():
    scene = hanging_item()
    cloud = scene.cloud(noise=0.0)
    item = kept(cloud)
    wide = kept(fattened(cloud, 3))
    narrow = kept(fattened(cloud, 3), config=SegmentationConfig(trim_px=3))
    assert wide.sum() - item.sum() > 2000
    assert (narrow & ~item).sum() < 0.02 * (wide & ~item).sum()
    assert (narrow & item).sum() > 0.97 * item.sum()


def test_trimming_keeps_what_lies_round_holes_and_behind_an_edge():
    scene = hanging_item()
    cloud = scene.cloud(noise=0.0)
    xyz = cloud.xyz.copy()
    row, col = (int(x) for x in np.argwhere(kept(cloud)).mean(axis=0))
    xyz[row, col - 1 : col + 2] = np.nan
    step = np.s_[row + 30 : row + 50, col - 5 : col]
    xyz[step] *= 0.96  # a flap before the rest
    trim = SegmentationConfig(trim_px=2)
    found = kept(Cloud(0, "rig", xyz, None), config=trim)
    assert found[row - 2 : row + 3, col - 3].all() and found[row - 2 : row + 3, col + 3].all()
    assert not found[row + 40, col - 5] and not found[row + 40, col - 1]
    assert found[row + 40, col - 3] and found[row + 40, col] and found[row + 40, col - 6]


def test_an_unorganised_cloud_is_not_trimmed():
    cloud = hanging_item().cloud()
    points = cloud.xyz[np.isfinite(cloud.xyz[..., 2])][None]
    flat = Cloud(0, "rig", points, None)
    assert kept(flat, config=SegmentationConfig(trim_px=3)).sum() == kept(flat).sum()
