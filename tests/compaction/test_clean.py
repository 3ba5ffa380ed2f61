"""Floaters go, the surface stays, and the budget holds."""

from dataclasses import replace

import numpy as np
import pytest

from langsplat_core.arrays import logit
from langsplat_core.compaction.clean import clean, find_floaters
from langsplat_core.compaction.compact import Views, choose_views, draw
from langsplat_core.config import CleanConfig
from langsplat_core.errors import InputError
from langsplat_core.progress import silent
from langsplat_core.scene import Gaussians, Scene, look_at
from langsplat_core.scene.gaussians import join_gaussians
from tests.support.scenes import random_gaussians

SIDE = 24
CONFIG = CleanConfig(max_side=64)


def row(means, scale: float, opacity: float) -> Gaussians:
    count = len(means)
    quats = np.tile([1.0, 0, 0, 0], (count, 1))
    sh = np.random.default_rng(0).uniform(-1, 1, (count, 1, 3))
    return Gaussians(means, np.full((count, 3), np.log(scale)), quats, np.full(count, logit(opacity)), sh)


@pytest.fixture
def scene() -> Scene:
    """A wall of 576, then a single, a clump of ten and a large veil before it; cameras in front."""
    grid = np.linspace(-1, 1, SIDE)
    wall = np.stack([*np.meshgrid(grid, grid), np.zeros((SIDE, SIDE))], -1).reshape(-1, 3)
    clump = [0.5, 0.4, -0.8] + 0.01 * np.random.default_rng(1).normal(size=(10, 3))
    floaters = [
        row(np.array([[0.0, -0.5, -0.7]]), 0.03, 0.8),
        row(clump, 0.02, 0.8),
        row(np.array([[-0.3, 0.2, -1.0]]), 0.8, 0.1),
    ]
    cameras = tuple(
        look_at(np.array([x, y, -2.5]), np.zeros(3), [0, -1, 0], (64, 64))
        for x in (-0.8, -0.3, 0.3, 0.8)
        for y in (-0.5, 0, 0.5)
    )
    return Scene(join_gaussians([row(wall, 0.04, 0.95), *floaters]), cameras=cameras)


def test_floaters_are_told_from_the_wall(scene):
    found = find_floaters(scene, scene.cameras, 100)
    np.testing.assert_array_equal(np.flatnonzero(found.suspicion), np.arange(SIDE**2, SIDE**2 + 12))
    np.testing.assert_array_equal(np.flatnonzero(found.region), np.arange(SIDE**2, SIDE**2 + 11))


def test_the_size_and_place_of_the_world_are_no_matter(scene):
    from langsplat_core.scene.transform import moving, scaling, transform_scene

    there = transform_scene(scene, scaling(40).then(moving(np.array([300.0, 0, 0]))))
    found, before = (find_floaters(one, one.cameras, 100).suspicion for one in (there, scene))
    np.testing.assert_array_equal(found, before)


def test_photographs_let_all_of_them_go(scene):
    """Of the wall alone: without floaters its images are these."""
    wall = scene.take(np.arange(SIDE**2))
    held = scene.cameras[1::3]
    photographs = tuple((255 * draw(wall, camera)).round().astype(np.uint8) for camera in held)
    keep, report = clean(scene, Views(scene.cameras[::3], held, photographs, "here"), CONFIG)
    np.testing.assert_array_equal(np.flatnonzero(~keep), np.arange(SIDE**2, SIDE**2 + 12))
    assert (report.regions, report.free_space, report.kept) == (11, 1, 0)
    assert report.loss < -1
    assert report.psnr_after > report.psnr_before


@pytest.mark.parametrize("budget", [0.0, 0.2, 50.0])
def test_without_photographs_the_images_may_change_so_much(scene, budget):
    config = replace(CONFIG, max_psnr_loss=budget)
    keep, report = clean(scene, choose_views(scene, None, config, silent), config)
    assert report.loss <= budget + 1e-9
    assert report.removed == (~keep).sum()
    assert report.removed + report.kept == 12
    assert keep[: SIDE**2].all()
    assert (report.removed == 12) == (budget == 50)


def test_rows_that_cannot_be_drawn_go(scene):
    scene.gaussians.means[5] = np.nan
    keep, report = clean(scene, choose_views(scene, None, CONFIG, silent), CONFIG)
    assert not keep[5]
    assert report.invalid == 1


@pytest.mark.parametrize("count", [1, 2, 40])
def test_a_scene_that_is_one_small_region_stays(count):
    scene = Scene(random_gaussians(count, scale_range=(0.5, 0.8)))
    keep, report = clean(scene, choose_views(scene, None, CONFIG, silent), CONFIG)
    assert keep.any()
    assert report.loss <= CONFIG.max_psnr_loss


def test_nothing_cannot_be_cleaned():
    with pytest.raises(InputError, match="nothing"):
        clean(Scene(random_gaussians(0)), Views((), (), (), ""), CONFIG)
