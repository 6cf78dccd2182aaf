"""Where two sheets hang together by a few links only."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.sparse.linalg import ArpackError
from scipy.spatial import cKDTree

from vflatten_ros.core import necks
from vflatten_ros.core.config import RotationConfig
from vflatten_ros.core.distances import link_steps
from vflatten_ros.core.errors import DisconnectedSurface
from vflatten_ros.core.grouping import unfold_group
from vflatten_ros.core.necks import cut_at_neck, narrowest
from vflatten_ros.core.rotation import Surface
from vflatten_ros.core.sheets import Links

CONFIG = RotationConfig(landmarks=100)
STEP_M, SIDE_M = CONFIG.spacing_m, 0.2


def sheets(*shifts, joined_m=0.03):
    """Square sheets, each some way from the one before; links over the start of their edges."""
    at = np.mgrid[0:SIDE_M:STEP_M, 0:SIDE_M:STEP_M].reshape(2, -1).T
    at = at + np.random.default_rng(2).normal(0.0, 0.1 * STEP_M, at.shape)
    flat = np.column_stack([at, np.zeros(len(at))])
    xyz = [flat]
    for shift in shifts:
        xyz.append(xyz[-1] + shift)
    xyz = np.vstack(xyz)
    sheet = np.repeat(np.arange(len(shifts) + 1), len(at))
    a, b = cKDTree(xyz).query_pairs(CONFIG.link_m, output_type="ndarray").T
    kept = (sheet[a] == sheet[b]) | ((xyz[a] + xyz[b])[:, 1] / 2 < joined_m)
    a, b = a[kept], b[kept]
    length = np.linalg.norm(xyz[a] - xyz[b], axis=1)
    nothing = np.zeros(len(a))
    return xyz, sheet, Links(a, b, length, nothing > 0, nothing)


def surface_of(xyz, links):
    normal = np.tile([0.0, 0.0, 1.0], (len(xyz), 1))
    none = np.zeros(len(xyz))
    steps = link_steps(xyz, normal, links)
    samples = SimpleNamespace(xyz=xyz, normal=normal)
    return Surface(samples, links, steps, none.astype(int), none, none.astype(int), none)


def test_it_is_where_the_fewest_links_lead_across():
    xyz, sheet, links = sheets([SIDE_M, 0.0, 0.0])
    part, across = narrowest(links, len(xyz))
    assert across == (sheet[links.a] != sheet[links.b]).sum() > 0
    assert (part[sheet == 0] == part[0]).all() and (part[sheet == 1] == 3 - part[0]).all()


def test_what_does_not_hang_together_with_the_largest_part_is_in_neither():
    xyz, sheet, links = sheets([SIDE_M, 0.0, 0.0], [0.5, 0.0, 0.0])
    part, across = narrowest(links, len(xyz))
    assert across > 0
    assert (part[sheet == 2] == 0).all() and set(part[sheet < 2]) == {1, 2}
    xyz, _, links = sheets([0.5, 0.0, 0.0])
    half = narrowest(links, len(xyz))[1]
    assert half > 100  # a sheet, through its middle: the other one is not cut off


def test_what_hangs_by_less_but_is_small_stays_with_its_sheet():
    xyz, sheet, links = sheets([SIDE_M, 0.0, 0.0])
    tag = (xyz[:, 0] < 0.03) & (xyz[:, 1] > SIDE_M - 0.03)
    to_it = np.flatnonzero(tag[links.a] != tag[links.b])
    kept = np.ones(len(links.a), dtype=bool)
    kept[to_it[2:]] = False
    part, across = narrowest(links.part(kept), len(xyz))
    assert across == (sheet[links.a] != sheet[links.b]).sum() > 2
    assert set(part[tag]) == {part[sheet == 0][0]} == set(part[sheet == 0])


def test_nothing_is_cut_of_which_there_is_nothing():
    none = np.zeros(0, dtype=np.int64)
    part, across = narrowest(Links(none, none, none.astype(float), none > 0, none.astype(float)), 5)
    assert across == 0 and not part.any()


def test_what_has_no_modes_to_cut_along_stays_whole(monkeypatch):
    def lost(*_, **__):
        raise ArpackError(-9999)

    monkeypatch.setattr(necks, "eigsh", lost)
    xyz, _, links = sheets([SIDE_M, 0.0, 0.0])
    with pytest.raises(DisconnectedSurface, match="nothing to cut"):
        cut_at_neck(surface_of(xyz, links), CONFIG)


def test_the_parts_are_laid_flat_each_by_itself():
    xyz, sheet, links = sheets([SIDE_M, 0.0, 0.0])
    grouped = cut_at_neck(surface_of(xyz, links), CONFIG)
    assert len(grouped.masks) == 2
    assert not (sheet[grouped.links.a] != sheet[grouped.links.b]).any()
    for k, mask in enumerate(grouped.masks):
        assert len(set(sheet[mask])) == 1
        laid = unfold_group(grouped, k, CONFIG)
        assert laid.row.tolist() == np.flatnonzero(mask).tolist()
        size = np.ptp(laid.points.uv, axis=0).max()
        assert SIDE_M - STEP_M < size < 1.5 * SIDE_M


def test_a_part_of_which_some_samples_have_no_place_is_laid_flat_all_the_same():
    xyz, _, links = sheets([SIDE_M, 0.0, 0.0])
    grouped = cut_at_neck(surface_of(xyz, links), CONFIG)
    whole = unfold_group(grouped, 0, CONFIG)
    lost = np.flatnonzero(grouped.masks[0])
    grouped.places[lost[::7]] = np.nan
    laid = unfold_group(grouped, 0, CONFIG)
    assert len(laid.points.uv) == len(whole.points.uv)
    apart = [np.linalg.norm(one.points.uv[0] - one.points.uv[-1]) for one in (laid, whole)]
    assert apart[0] == pytest.approx(apart[1], abs=0.003)
    grouped.places[lost] = np.nan
    with pytest.raises(DisconnectedSurface, match="laid flat"):
        unfold_group(grouped, 0, CONFIG)


def test_a_sheet_and_what_hangs_together_over_a_hands_breadth_stay_whole():
    xyz, _, links = sheets([SIDE_M, 0.0, 0.0], joined_m=0.1)
    with pytest.raises(DisconnectedSurface, match=r"1\d cm wide"):
        cut_at_neck(surface_of(xyz, links), CONFIG)
    xyz, _, links = sheets()
    with pytest.raises(DisconnectedSurface, match="nothing to cut"):
        cut_at_neck(surface_of(xyz, links), CONFIG)
