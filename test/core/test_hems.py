"""A hem amid the flat surface, where other cloth lies flush against it."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from vflatten_ros.core import ways
from vflatten_ros.core.config import Config, RotationConfig
from vflatten_ros.core.distances import link_steps
from vflatten_ros.core.errors import DisconnectedSurface
from vflatten_ros.core.grouping import unfold_group
from vflatten_ros.core.hems import Hem, cut_at_hem, hem_within
from vflatten_ros.core.rotation import Surface, unfold_surface
from vflatten_ros.core.sheets import link_samples, sheet_edges

CONFIG = RotationConfig(landmarks=150)
WIDTH_M, LENGTH_M, APART_M = 0.3, 0.36, 0.006
FLAP = (0.08, 0.2, 0.1)  # from and to along the hem, and beyond it


def sheet(width_m, low_m, high_m, seed, left_m=0.0):
    step = CONFIG.spacing_m
    u = np.arange(left_m + step / 2, left_m + width_m, step)
    v = np.arange(low_m + step / 2, high_m, step)
    at = np.stack(np.meshgrid(u, v), -1).reshape(-1, 2)
    return at + np.random.default_rng(seed).normal(0.0, 0.1 * step, at.shape)


def tube(flap=None):
    """Front and back of a flattened tube, hem down; a flap lies flush against the front's hem."""
    front, back = sheet(WIDTH_M, 0.0, LENGTH_M, 1), sheet(WIDTH_M, 0.0, LENGTH_M, 2)
    if flap is not None:
        start, end, beyond = flap
        front = np.vstack([front, sheet(end - start, -beyond, 0.0, 3, start)])
    above, below = (np.full(len(p), s * APART_M / 2) for p, s in ((front, 1), (back, -1)))
    xyz = np.vstack([np.column_stack([front, above]), np.column_stack([back, below])])
    normal = np.zeros_like(xyz)
    normal[:, 2] = np.sign(xyz[:, 2])
    links = link_samples(xyz, normal, CONFIG)
    flat = ~links.rim
    edge = sheet_edges(xyz, normal, links.a[flat], links.b[flat], CONFIG)
    none = np.zeros(len(xyz), dtype=np.int64)
    samples = SimpleNamespace(xyz=xyz, normal=normal)
    steps = link_steps(xyz, normal, links)
    return Surface(samples, links, steps, edge, none.astype(float), none, np.zeros((len(xyz), 2)))


def laid_like(surface):
    """Laid flat; the plane turned and shifted so that the front lies as it was made."""
    unfolded = unfold_surface(surface, CONFIG)
    front = surface.samples.xyz[unfolded.row, 2] > 0
    lies, made = unfolded.points.uv[front], surface.samples.xyz[unfolded.row, :2][front]
    mean = lies.mean(axis=0), made.mean(axis=0)
    one, _, other = np.linalg.svd((lies - mean[0]).T @ (made - mean[1]))
    unfolded.points.uv[:] = (unfolded.points.uv - mean[0]) @ one @ other + mean[1]
    unfolded.side[:] = np.where(front, 1.0, -1.0)
    return unfolded


def fitted(low_m, seam=(False, True, False, True)):
    """A rectangle from some way below the hem to the waist, with seams at its sides."""
    corners = [[0.0, low_m], [WIDTH_M, low_m], [WIDTH_M, LENGTH_M], [0.0, LENGTH_M]]
    corners.insert(1, [0.4 * WIDTH_M, low_m])  # on the hem
    template = SimpleNamespace(vertices=5, seam=np.array([seam[0], *seam]))
    return SimpleNamespace(points=lambda: np.array(corners), template=template, misfit=-0.5)


@pytest.fixture(scope="module")
def flush():
    return laid_like(tube(FLAP))


def test_a_hem_against_which_other_cloth_lies_flush_is_found(flush):
    assert np.ptp(flush.points.uv[:, 1]) > LENGTH_M + 0.9 * FLAP[2]  # laid end to end
    hem = hem_within(flush, fitted(-FLAP[2]), CONFIG)
    assert hem.depth_m == pytest.approx(FLAP[2], abs=CONFIG.spacing_m)
    assert hem.inward == pytest.approx([0.0, 1.0])
    assert hem.start[1] == -FLAP[2]


def test_where_the_category_has_seams_none_is_looked_for(flush):
    assert hem_within(flush, fitted(-FLAP[2], seam=(True, True, False, True)), CONFIG) is None


def test_the_hem_of_the_item_itself_is_not_within():
    plain = laid_like(tube())
    assert hem_within(plain, fitted(0.0), CONFIG) is None
    assert hem_within(plain, fitted(0.01), CONFIG) is None
    assert hem_within(plain, fitted(-0.01), CONFIG) is None


@pytest.mark.parametrize("anew", [False, True])
def test_cut_along_it_the_item_is_as_long_as_it_is(flush, anew):
    grouped = cut_at_hem(flush, hem_within(flush, fitted(-FLAP[2]), CONFIG), anew, CONFIG)
    flap = flush.surface.samples.xyz[:, 1] < 0.0
    assert len(grouped.masks) == 2
    main, other = grouped.masks
    assert (main == ~flap).mean() > 0.99 and (other == flap).mean() > 0.99
    laid = unfold_group(grouped, 0, CONFIG)
    size = np.sort(np.ptp(laid.points.uv, axis=0))
    assert size == pytest.approx([WIDTH_M, LENGTH_M], abs=2 * CONFIG.spacing_m)


def test_a_hem_that_nothing_leads_across_needs_no_cut(flush):
    below = Hem(np.array([0.0, -0.2]), np.array([0.0, 1.0]), 0.05, 9.0)
    assert cut_at_hem(flush, below, False, CONFIG) is None


def lying(xyz_m, links, edge, row=None):
    """A surface that lies as it was made; of some samples nobody knows where."""
    count = len(xyz_m)
    samples = SimpleNamespace(xyz=xyz_m, normal=np.sign(xyz_m[:, 2:]) * [0.0, 0.0, 1.0])
    none = np.zeros(count, dtype=np.int64)
    row = np.arange(count) if row is None else row
    return SimpleNamespace(
        surface=Surface(samples, links, None, edge, none, none, none),
        row=row,
        points=SimpleNamespace(uv=xyz_m[row, :2]),
        side=np.sign(xyz_m[row, 2]),
    )


def test_the_sides_of_the_item_are_looked_at_each_by_itself():
    """A third of the front ends above the hem of a back that goes on."""
    front, back = sheet(0.12, 0.0, LENGTH_M, 1), sheet(WIDTH_M, -FLAP[2], LENGTH_M, 2)
    flat = np.vstack([front, back])
    height = np.r_[np.full(len(front), 0.003), np.full(len(back), -0.003)]
    xyz = np.column_stack([flat, height])
    normal = np.sign(xyz[:, 2:]) * [0.0, 0.0, 1.0]
    links = link_samples(xyz, normal, CONFIG)
    links = links.part(~links.rim)
    edge = sheet_edges(xyz, normal, links.a, links.b, CONFIG)
    alone = len(front)
    hem = hem_within(lying(xyz, links, edge), fitted(-FLAP[2]), CONFIG)
    assert hem.depth_m == pytest.approx(FLAP[2], abs=CONFIG.spacing_m)
    without = links.among(np.arange(len(xyz)) < alone)
    only = hem_within(lying(xyz[:alone], without, edge[:alone]), fitted(-FLAP[2]), CONFIG)
    assert hem.clear == pytest.approx(only.clear)


def test_what_lay_beyond_a_hem_and_hangs_on_otherwise_has_no_place_yet(flush):
    surface = flush.surface
    xyz = surface.samples.xyz
    row = np.flatnonzero(np.abs(xyz[:, 0] - 0.14) > 0.01)  # what joins both was not placed
    some = lying(xyz, surface.links, surface.edge, row)
    some.surface = surface
    cut = cut_at_hem(some, Hem(np.zeros(2), np.array([0.0, 1.0]), 0.0, 9.0), False, CONFIG)
    assert len(cut.masks) == 1 and cut.masks[0].mean() > 0.99
    beyond = row[xyz[row, 1] < -0.01]
    inside = row[xyz[row, 1] > 0.01]
    assert len(beyond) > 100 and np.isnan(cut.places[beyond]).all()
    assert np.array_equal(cut.places[inside], xyz[inside, :2])


def way(badness, misfit=0.0, fitted=True):
    fit = SimpleNamespace(misfit=misfit) if fitted else None
    return SimpleNamespace(
        badness=badness,
        untrusted="" if badness < 0.3 else "so bad",
        unfolded=None,
        found=SimpleNamespace(fit=fit),
    )


@pytest.fixture
def tried(monkeypatch):
    """What comes of a way, of the item cut and of it cut and laid flat anew."""

    def of(laid, *cut, hem="hem", grouped="grouped"):
        left = iter(cut)

        def from_groups(*_):
            found = next(left)
            if isinstance(found, DisconnectedSurface):
                raise found
            return found

        monkeypatch.setattr(ways._Draw, "_laid", lambda *_: laid)
        monkeypatch.setattr(ways._Draw, "_from_groups", from_groups)
        monkeypatch.setattr(ways, "hem_within", lambda *_: hem)
        monkeypatch.setattr(ways, "cut_at_hem", lambda *_: grouped)
        draw = ways._Draw.__new__(ways._Draw)
        draw._config = Config()
        return draw.tried(ways.WHOLE, lambda *_: None)

    return of


def test_a_way_is_cut_at_a_hem_if_it_is_better_so(tried):
    laid, better, best = way(0.5), way(0.4), way(0.35)
    assert tried(laid, better, way(0.6)) is better
    assert tried(laid, way(0.6), way(0.7)) is laid
    assert tried(laid, better, best) is best
    good = way(0.2)
    assert tried(laid, good) is good  # and is not laid flat anew
    assert tried(good, way(0.25)) is good


def test_a_way_that_the_cut_leaves_in_shreds_stays_as_it_was(tried):
    laid, shreds = way(0.5), DisconnectedSurface("in shreds")
    assert tried(laid, shreds) is laid
    assert tried(laid, better := way(0.4), shreds) is better


def test_a_way_is_cut_only_where_that_may_help(tried):
    laid = way(0.5)
    assert tried(laid, hem=None) is laid and tried(laid, grouped=None) is laid
    for hopeless in (way(3.0, misfit=1.0), way(3.0, fitted=False), way(6.0)):
        assert tried(hopeless) is hopeless
