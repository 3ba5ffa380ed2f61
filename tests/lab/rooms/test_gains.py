"""Changes of the lifting on a small scene with known things."""

import numpy as np
import pytest

from langsplat_core.arrays import unit
from langsplat_core.lab.rooms.gains import GAINS, Material, same_things
from langsplat_core.raster.reference import ReferenceRasterizer
from langsplat_core.scene import LEVELS, look_at
from langsplat_core.semantics.store import ImageFeatures
from langsplat_core.training.language.mask_weights import PAIR, MaskWeights, find_mask_weights
from tests.support.fakes import PER_BLOB, blobs

D = 16
WRONG = (1, 4)  # view, mask: whose vector is another thing's


@pytest.fixture(scope="module")
def material() -> Material:
    """Three blobs in four views, each a mask at levels part and whole; one mask in one view is misread."""
    gaussians = blobs()
    rng = np.random.default_rng(0)
    meanings = unit(rng.normal(size=(3, D)))
    views = []
    for index in range(4):
        angle = 0.3 * (index - 1.5)
        eye = 5 * np.array([np.sin(angle), -0.1, -np.cos(angle)])
        camera = look_at(eye, np.zeros(3), np.array([0.0, -1, 0]), (60, 45))
        view = ReferenceRasterizer().view(gaussians, camera)
        shares = view.splat(np.repeat(np.eye(3), PER_BLOB, 0))[0]
        blob = np.where(shares.sum(-1) > 0.3, shares.argmax(-1), -1).astype(np.int32)
        labels = np.stack([np.full_like(blob, -1), blob, np.where(blob >= 0, blob + 3, -1)])
        vectors = unit(np.tile(meanings, (2, 1)) + 0.05 * rng.normal(size=(6, D))).astype(np.float32)
        if index == WRONG[0]:
            vectors[WRONG[1]] = meanings[0]
        views.append((camera, ImageFeatures(labels, vectors)))
    members = find_mask_weights(ReferenceRasterizer(), gaussians, views)
    return Material(gaussians, members, tuple(features.vectors for _, features in views))


@pytest.mark.parametrize("change", GAINS)
def test_every_change_keeps_what_is_plain(material, change):
    lifted = GAINS[change](material)
    assert lifted.vectors.shape == (len(LEVELS), 3 * PER_BLOB, D)
    np.testing.assert_allclose(np.linalg.norm(lifted.vectors[lifted.confidence > 0], axis=1), 1, atol=1e-4)
    assert not lifted.confidence[0].any()  # no subparts were outlined
    means = [unit(lifted.vectors[1, b * PER_BLOB : (b + 1) * PER_BLOB].mean(0)) for b in range(3)]
    assert np.abs(np.array(means) @ np.array(means).T - np.eye(3)).max() < 0.75


def test_masks_of_one_thing_are_found_across_views(material):
    things = same_things(material.members, [6] * 4).reshape(4, 6)
    assert (things == things[0]).all()
    assert len(np.unique(things[0])) == 6


def test_an_outlying_mask_is_left_out(material):
    name = "masks 1.5 deviations below the others' cosine are left out"
    wrong, right = material.vectors[1][4], material.vectors[0][4]
    here = slice(PER_BLOB, 2 * PER_BLOB)
    before, after = (GAINS[change](material).vectors[2, here] for change in ("as it is", name))
    assert (after @ right).mean() > (before @ right).mean()
    assert (after @ wrong).mean() < (before @ wrong).mean()


def test_a_gaussian_that_paints_nothing_gets_no_meaning(material):
    pairs = [view[view["row"] != 5] for view in material.members.pairs]
    stray = np.array([(5, 0, 1, 0.2)], PAIR)
    pairs[0] = np.sort(np.concatenate([pairs[0], stray]), order="row")
    members = MaskWeights(pairs, material.members.count)
    lifted = GAINS["Gaussians that paint < 1 px in every view have no meaning"](
        Material(material.gaussians, members, material.vectors)
    )
    assert not lifted.confidence[:, 5].any()
    assert lifted.confidence[1].any()
