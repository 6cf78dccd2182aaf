"""Links between samples of sheets, layers and folds that are known."""

from __future__ import annotations

import numpy as np

from vflatten_ros.core.config import RotationConfig
from vflatten_ros.core.sheets import _supported, link_samples, sheet_edges

CONFIG = RotationConfig()
UP = np.array([0.0, 0.0, 1.0])


def sheet(x0, x1, y0, y1, z=0.0, seed=1):
    """Samples about 4 mm apart of a level sheet."""
    rng = np.random.default_rng(seed)
    grid = np.mgrid[x0:x1:0.004, y0:y1:0.004].reshape(2, -1).T
    flat = grid + rng.uniform(-0.0004, 0.0004, grid.shape)
    return np.column_stack([flat, np.full(len(flat), z)])


def between(links, of, one, other):
    return int(((of[links.a] == one) & (of[links.b] == other)).sum())


def test_an_even_sheet_is_linked_throughout():
    xyz = sheet(0, 0.1, 0, 0.1)
    links = link_samples(xyz, np.tile(UP, (len(xyz), 1)), CONFIG)
    degree = np.bincount(np.r_[links.a, links.b])
    assert degree.min() >= 3
    assert not links.rim.any()


def test_the_edge_of_a_layer_lying_on_another_is_not_bridged():
    below, above = sheet(0, 0.06, 0, 0.1), sheet(0.06, 0.12, 0, 0.1, z=0.003, seed=2)
    xyz = np.vstack([below, above])
    layer = np.repeat([0, 1], [len(below), len(above)])
    links = link_samples(xyz, np.tile(UP, (len(xyz), 1)), CONFIG)
    assert between(links, layer, 0, 1) == 0
    edge = sheet_edges(xyz, np.tile(UP, (len(xyz), 1)), links.a, links.b, CONFIG)
    assert (edge[(layer == 0) & (xyz[:, 0] > 0.055)] == 2).mean() > 0.5  # it goes on below
    assert (edge[layer == 1] != 2).all()


def test_the_two_sides_of_a_fold_are_linked_round_its_rim_only():
    front, back = sheet(0, 0.06, 0, 0.1), sheet(0, 0.06, 0, 0.1, z=-0.003, seed=2)
    xyz = np.vstack([front, back])
    side = np.repeat([0, 1], [len(front), len(back)])
    normal = np.where(side[:, None] == 0, UP, -UP)
    links = link_samples(xyz, normal, CONFIG)
    across = side[links.a] != side[links.b]
    assert across.sum() > 20
    assert links.rim[across].all()
    inner = (np.abs(xyz - [0.03, 0.05, 0.0]) < [0.02, 0.04, 1.0]).all(1)
    assert (inner[links.a] & inner[links.b] & across).sum() < 0.1 * across.sum()


def test_layers_that_face_each_other_are_not_linked():
    below, above = sheet(0, 0.06, 0, 0.1), sheet(0, 0.06, 0, 0.1, z=0.004, seed=2)
    xyz = np.vstack([below, above])
    layer = np.repeat([0, 1], [len(below), len(above)])
    links = link_samples(xyz, np.where(layer[:, None] == 0, UP, -UP), CONFIG)
    assert between(links, layer, 0, 1) == 0


def test_the_edges_of_a_stack_are_in_doubt_beside_those_of_single_seams():
    parts, normals, stacked = [], [], []
    for k in range(6):  # five folds 2 mm thick, and the outer sides of a stack of 5 mm
        thick = 0.005 if k == 5 else 0.002
        for side, z in ((1.0, 0.0), (-1.0, -thick)):
            parts.append(sheet(0.2 * k, 0.2 * k + 0.06, 0, 0.1, z=z, seed=2 * k + (side > 0)))
            normals.append(np.tile(side * UP, (len(parts[-1]), 1)))
            stacked.append(np.full(len(parts[-1]), k == 5))
    xyz, stack = np.vstack(parts), np.concatenate(stacked)
    links = link_samples(xyz, np.vstack(normals), CONFIG)
    of_stack = stack[links.a[links.rim]]
    assert of_stack.sum() > 20
    assert (links.doubt[links.rim][of_stack] > 1.0).mean() > 0.9
    assert (links.doubt[links.rim][~of_stack] < 1.0).mean() > 0.9
    assert not links.doubt[~links.rim].any()


def test_links_that_share_too_few_neighbours_go_round_by_round():
    """As found by counting all shared neighbours anew in every round."""
    rng = np.random.default_rng(3)
    n = 150
    a, b = np.triu_indices(n, 1)
    near = np.abs(a - b) < 12  # a band, of which some links are missing
    kept = near & (rng.random(len(a)) < 0.55)
    a, b, start = a[near], b[near], kept[near]
    expected, rounds = start.copy(), []
    for _ in range(3):
        around = [set() for _ in range(n)]
        for i, j in zip(a[expected], b[expected], strict=True):
            around[i].add(j)
            around[j].add(i)
        shared = np.array([len(around[i] & around[j]) for i, j in zip(a, b, strict=True)])
        fewer = np.array([min(len(around[i]), len(around[j])) for i, j in zip(a, b, strict=True)])
        weak = expected & ((shared < CONFIG.overlap * fewer) | (shared < 2))
        rounds.append(int(weak.sum()))
        expected &= ~weak
    assert min(rounds) > 0  # each round has something to do
    assert (_supported(a, b, start, n, CONFIG) == expected).all()


def test_no_pairs_at_all_are_no_error():
    xyz = 0.1 * np.arange(6.0)[:, None] * [1.0, 0.0, 0.0]
    normal = np.tile([0.0, 0.0, 1.0], (6, 1))
    none = np.zeros(0, dtype=np.int64)
    assert (sheet_edges(xyz, normal, none, none, CONFIG) >= 0).all()
