"""MaskWeights against dense weights, block by block, and groups of masks."""

import numpy as np
import pytest

from langsplat_core.arrays import unit
from langsplat_core.raster import load_lifting_rasterizer
from langsplat_core.raster.reference import ReferenceRasterizer
from langsplat_core.semantics.store import ImageFeatures
from langsplat_core.training.language import mask_weights as module
from langsplat_core.training.language.mask_weights import PAIR, find_mask_weights, group_masks, view_pairs
from tests.support.lifting import D, dense_weights, make_views
from tests.support.scenes import random_camera, random_gaussians


@pytest.fixture(scope="module")
def gaussians():
    return random_gaussians(25, 3)


def ungrouped(views):
    return group_masks([features.vectors for _, features in views], groups=10_000)


@pytest.mark.parametrize(("backend", "chunk"), [("reference", 3), ("reference", 32), ("cpu", 32)])
def test_membership_is_the_weight_inside_the_mask(gaussians, backend, chunk):
    views = make_views()
    mask_weights = find_mask_weights(load_lifting_rasterizer(backend), gaussians, views, chunk)
    got = mask_weights.block(0, ungrouped(views)).toarray()
    assert got.shape == (25, 3 * 21)
    for index, (camera, features) in enumerate(views):
        weights = dense_weights(gaussians, camera)
        for row in range(7):
            level = 1 if row < 4 else 2
            want = weights[features.labels[level] == row].sum(0)
            want[want <= 1e-3] = 0
            column = level * 21 + 7 * index + row
            np.testing.assert_allclose(got[:, column], want, rtol=1e-5, atol=1e-6)
            got[:, column] = 0
    assert not got.any()  # nothing at any other level


def test_blocks_are_the_rows_of_the_whole(gaussians, monkeypatch):
    views = make_views()
    mask_weights = find_mask_weights(ReferenceRasterizer(), gaussians, views)
    groups = ungrouped(views)
    whole = mask_weights.block(0, groups).toarray()
    monkeypatch.setattr(module, "BLOCK", 7)
    again = find_mask_weights(ReferenceRasterizer(), gaussians, views)
    assert again.blocks == [(0, 7), (7, 14), (14, 21), (21, 25)]
    parts = [again.block(number, groups).toarray() for number in range(4)]
    np.testing.assert_array_equal(np.concatenate(parts), whole)


def test_masks_of_one_group_are_one_column(gaussians):
    views = make_views()
    mask_weights = find_mask_weights(ReferenceRasterizer(), gaussians, views)
    groups = group_masks([features.vectors for _, features in views], groups=4)
    assert groups.vectors.shape == (4, D)
    apart = mask_weights.block(0, ungrouped(views)).toarray().reshape(25, 3, 21)
    together = np.zeros((25, 3, 4))
    for column, group in enumerate(np.concatenate(groups.of_mask)):
        together[:, :, group] += apart[:, :, column]
    np.testing.assert_allclose(mask_weights.block(0, groups).toarray(), together.reshape(25, 12), rtol=1e-5)


def test_groups_hold_what_says_the_same():
    rng = np.random.default_rng(0)
    centres = unit(rng.normal(size=(6, D)))
    labels = rng.integers(6, size=300)
    vectors = unit(centres[labels] + 0.02 * rng.normal(size=(300, D))).astype(np.float32)
    groups = group_masks(np.split(vectors, [100, 100, 250]), groups=6)  # the second view has no masks
    assert [len(view) for view in groups.of_mask] == [100, 0, 150, 50]
    found = np.concatenate(groups.of_mask)
    assert len({(a, b) for a, b in zip(found, labels, strict=True)}) == 6
    np.testing.assert_allclose((groups.vectors[found] * centres[labels]).sum(1), 1, atol=0.01)


def test_a_view_without_masks_has_no_pairs(gaussians):
    empty = ImageFeatures(np.full((3, 6, 8), -1, np.int32), np.zeros((0, D), np.float32))
    pairs = view_pairs(ReferenceRasterizer(), gaussians, random_camera(0, 8, 6), empty)
    assert (len(pairs), pairs.dtype) == (0, PAIR)


def test_more_masks_than_can_be_numbered_are_refused(gaussians):
    labels = np.full((3, 6, 8), -1, np.int32)
    many = ImageFeatures(labels, np.zeros((70_000, 1), np.float32))
    with pytest.raises(ValueError, match="70000 masks; at most 65 535"):
        view_pairs(ReferenceRasterizer(), gaussians, random_camera(0, 8, 6), many)
