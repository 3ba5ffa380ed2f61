"""Colours of codewords: neighbours are told apart, whatever else is large."""

from dataclasses import replace

import numpy as np

from langsplat_core.arrays import Array, unit
from langsplat_core.scene import NO_NODE, LanguageField
from langsplat_core.scene.codec import CodebookCodec, principal_colours
from langsplat_core.scene.gaussians import Gaussians
from langsplat_core.scene.surface import build_surface
from langsplat_core.scene.tree import tree_of_wholes
from langsplat_core.training.language.palette import contrasting_colours
from tests.support.file_samples import random_field

SIDE, THINGS = 40, 8


def sheet() -> Gaussians:
    """SIDE x SIDE small discs in a plane."""
    x, y = np.divmod(np.arange(SIDE * SIDE), SIDE)
    means = np.stack([x, y, 0 * x], 1) * 0.1
    count = len(means)
    quats = np.tile([1.0, 0, 0, 0], (count, 1))
    return Gaussians(
        means, np.full((count, 3), np.log(0.07)), quats, np.full(count, 4.0), np.zeros((count, 1, 3))
    )


def field_of(things: Array, vectors: Array) -> LanguageField:
    """Of things (N,), each with its own codeword; NO_NODE means nothing."""
    usage = np.bincount(things[things != NO_NODE], minlength=len(vectors)).astype(float)
    codec = CodebookCodec(vectors, principal_colours(vectors, usage))
    codes = np.where(things == NO_NODE, 0, things).astype(np.uint16)
    return replace(
        random_field(len(things), "codebook"),
        codec=codec,
        canonical=vectors[:4],
        everyday=None,
        phrasebook={},
        latents=np.tile(codes[None, :, None], (3, 1, 1)),
        confidence=np.tile((things != NO_NODE).astype(np.float32), (3, 1)),
        tree=tree_of_wholes(things),
    )


def rooms(seed: int) -> tuple[Gaussians, LanguageField]:
    """Small things in a row on a large wall; things are nearly alike, the wall and the floor are not."""
    rng = np.random.default_rng(seed)
    x, y = np.divmod(np.arange(SIDE * SIDE), SIDE)
    things = np.where(y < 12, 8, 9)
    on = (y > 8) & (y < 16)
    things[on] = x[on] * THINGS // SIDE
    alike = unit(rng.normal(size=32))
    small = unit(alike + 0.06 * rng.normal(size=(THINGS, 32)))
    large = unit(rng.normal(size=(2, 32)))
    return sheet(), field_of(things, np.concatenate([small, large]).astype(np.float32))


def least_between_neighbours(colours: Array) -> float:
    return float(np.linalg.norm(np.diff(colours[:THINGS], axis=0), axis=1).min())


def test_neighbours_differ_more_than_by_the_axes_of_everything():
    for seed in range(5):
        gaussians, field = rooms(seed)
        found = contrasting_colours(field, field.tree, build_surface(gaussians))
        assert found.shape == (THINGS + 2, 3)
        assert (found >= 0).all()
        assert (found <= 1).all()
        assert least_between_neighbours(found) > 1.5 * least_between_neighbours(field.codec.palette)


def test_nothing_beside_anything_has_no_colours():
    gaussians = sheet()
    count = len(gaussians)
    vectors = unit(np.random.default_rng(0).normal(size=(3, 32))).astype(np.float32)
    for things in (np.full(count, NO_NODE), np.zeros(count, int)):
        field = field_of(things, vectors)
        assert contrasting_colours(field, field.tree, build_surface(gaussians)) is None
