"""The surface: smoothing and walking along it, against plain NumPy."""

import numpy as np
import pytest
from scipy.sparse.csgraph import connected_components

from langsplat_core.arrays import sigmoid
from langsplat_core.query.surface import NEIGHBOURS, build_surface
from tests.support.scenes import random_gaussians


def test_smoothing_is_the_weighted_mean_of_the_nearest():
    gaussians = random_gaussians(300)
    surface = build_surface(gaussians)
    values = np.random.default_rng(0).uniform(size=(3, 300)).astype(np.float32)
    smoothed = surface.smooth(values)
    opacity = sigmoid(gaussians.opacity_logits.astype(np.float64))
    counted = np.flatnonzero((opacity >= 0.1) & gaussians.valid())
    assert sorted(surface.rows) == counted.tolist()
    for number, row in enumerate(surface.rows):
        distances = np.linalg.norm(gaussians.means[counted] - gaussians.means[row], axis=1)
        near = counted[np.argsort(distances)[:NEIGHBOURS]]
        want = (values[:, near] * opacity[near]).sum(1) / opacity[near].sum()
        np.testing.assert_allclose(smoothed[:, number], want, rtol=1e-5)


def test_links_are_symmetric_and_walking_them_finds_the_connected_part():
    gaussians = random_gaussians(400)
    surface = build_surface(gaussians)
    assert (surface.links != surface.links.T).nnz == 0
    inside = np.random.default_rng(1).uniform(size=len(surface.rows)) < 0.6
    members = np.flatnonzero(inside)
    _, labels = connected_components(surface.links[members][:, members], directed=False)
    for number in (0, len(members) // 2, len(members) - 1):
        want = members[labels == labels[number]]
        assert sorted(surface.connected(inside, members[number])) == want.tolist()


def test_the_far_side_of_a_gap_is_another_surface():
    gaussians = random_gaussians(60)
    gaussians.means[:] = np.random.default_rng(2).normal(scale=0.05, size=(60, 3))
    gaussians.means[50:, 0] += 9  # fewer than the neighbours everyone has: they reach across
    surface = build_surface(gaussians, min_opacity=0.0)
    near = np.flatnonzero(np.isin(surface.rows, np.arange(50)))
    reached = surface.connected(np.ones(len(surface.rows), bool), int(near[0]))
    assert set(reached) <= set(near)


@pytest.mark.parametrize("count", [0, 1, 2])
def test_a_surface_of_almost_nothing(count):
    surface = build_surface(random_gaussians(count), min_opacity=0.0)
    assert surface.smooth(np.full((3, count), 0.25, np.float32)).tolist() == [[0.25] * len(surface.rows)] * 3
