"""Places in the plane from distances: points whose places are known."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.spatial import cKDTree

from vflatten_ros.core.config import FlatteningConfig
from vflatten_ros.core.errors import DisconnectedSurface, InvalidInput
from vflatten_ros.core.flattening import flatten
from vflatten_ros.core.values import DistanceNetwork

NOISE_M = 0.0005
SPRINGS = FlatteningConfig(solver="springs")


def sheet(slit=False):
    """Points of a 0.6 x 0.4 m sheet and the noisy distances of those nearer than 0.1 m."""
    random = np.random.default_rng(1)
    u, v = np.meshgrid(np.arange(0, 0.6, 0.03), np.arange(0, 0.4, 0.03))
    places = np.stack([u, v], axis=-1).reshape(-1, 2) + random.uniform(-0.01, 0.01, (u.size, 2))
    i, j = cKDTree(places).query_pairs(0.1, output_type="ndarray").T
    if slit:  # from the right border to the middle
        crosses = (places[i, 1] < 0.2) != (places[j, 1] < 0.2)
        open_ = crosses & (np.minimum(places[i, 0], places[j, 0]) > 0.25)
        i, j = i[~open_], j[~open_]
    distance = np.linalg.norm(places[i] - places[j], axis=1) + random.normal(0, NOISE_M, len(i))
    return places, DistanceNetwork(
        i=i,
        j=j,
        distance_m=distance,
        sigma_m=np.full(len(i), NOISE_M),
        bound=np.zeros(len(i), bool),
    )


def start_of(places):
    """Bent by up to 1 cm, and 5 mm off here and there."""
    random = np.random.default_rng(2)
    bent = places + np.c_[0.06 * places[:, 1] ** 2, 0.03 * places[:, 0] ** 2]
    return bent + random.normal(0, 0.005, places.shape)


def rms_m(found, places):
    """After rigid alignment; a mirror image is no match."""
    a, b = found - found.mean(axis=0), places - places.mean(axis=0)
    left, _, right = np.linalg.svd(a.T @ b)
    turn = left @ np.diag([1.0, np.sign(np.linalg.det(left @ right))]) @ right
    return float(np.sqrt(((a @ turn - b) ** 2).sum(axis=1).mean()))


def spoiled(network, share, seed=3):
    """A share of the distances is wrong by up to half."""
    random = np.random.default_rng(seed)
    wrong = random.random(len(network.i)) < share
    factor = np.where(wrong, random.uniform(0.5, 1.5, len(wrong)), 1.0)
    return dataclasses.replace(network, distance_m=network.distance_m * factor)


# about ten distances of 0.5 mm fix each point; errors of the shape add up over the sheet
@pytest.mark.parametrize("config", [FlatteningConfig(), SPRINGS], ids=["majorization", "springs"])
def test_points_return_to_their_places(config):
    places, network = sheet()
    uv, stress = flatten(network, start_of(places), config)
    assert rms_m(uv, places) < 0.0003
    assert stress.mean() == pytest.approx(NOISE_M, rel=0.3)


@pytest.mark.parametrize("share", [0.05, 0.2])
def test_a_share_of_wrong_distances_does_little_harm(share):
    places, network = sheet()
    uv, _ = flatten(spoiled(network, share), start_of(places), FlatteningConfig())
    assert rms_m(uv, places) < 0.0004


def test_a_slit_does_little_harm_with_wrong_distances_too():
    places, network = sheet(slit=True)
    for share, most in ((0.0, 0.0004), (0.2, 0.0005)):
        uv, _ = flatten(spoiled(network, share), start_of(places), FlatteningConfig())
        assert rms_m(uv, places) < most


def test_upper_bounds_push_nothing_together():
    places, network = sheet()
    far = np.array([[0, len(places) - 1]])
    longer = DistanceNetwork(
        i=np.r_[network.i, far[:, 0]],
        j=np.r_[network.j, far[:, 1]],
        distance_m=np.r_[network.distance_m, 1.5],  # the sheet's diagonal is 0.7 m
        sigma_m=np.r_[network.sigma_m, NOISE_M],
        bound=np.r_[network.bound, True],
    )
    alone, _ = flatten(network, start_of(places), FlatteningConfig())
    bounded, _ = flatten(longer, start_of(places), FlatteningConfig())
    assert np.abs(alone - bounded).max() < 1e-4  # where the search ends


def test_what_cannot_be_placed_is_refused():
    places, network = sheet()
    half = (places[network.i, 0] < 0.3) == (places[network.j, 0] < 0.3)
    cut = DistanceNetwork(
        **{f.name: getattr(network, f.name)[half] for f in dataclasses.fields(network)}
    )
    with pytest.raises(DisconnectedSurface, match="2 pieces"):
        flatten(cut, places, FlatteningConfig())
    with pytest.raises(InvalidInput, match="points, but the distances name more"):
        flatten(network, places[:10], FlatteningConfig())
    bad = dataclasses.replace(network, distance_m=network.distance_m * np.nan)
    with pytest.raises(InvalidInput, match="finite"):
        flatten(bad, places, FlatteningConfig())
