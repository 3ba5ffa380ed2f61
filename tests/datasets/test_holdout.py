"""Held-out views lie among training views, all over the capture, and are the same on every machine."""

from dataclasses import replace

import numpy as np
import pytest

from langsplat_core.config import DatasetConfig
from langsplat_core.datasets.capture import Capture
from langsplat_core.datasets.holdout import FEWEST_VIEWS, chosen, split
from langsplat_core.scene import Camera, look_at
from langsplat_core.scene.transform import moving, rotating, scaling

UP = np.array([0.0, 0.0, 1.0])
SIZE = (32, 24)


def ring(count: int) -> list[Camera]:
    around = 2 * np.pi * np.arange(count) / count
    eyes = np.stack([3 * np.cos(around), 3 * np.sin(around), np.full(count, 1.0)], 1)
    return [look_at(eye, np.zeros(3), UP, SIZE, 50.0) for eye in eyes]


def walk(count: int) -> list[Camera]:
    return [look_at(np.array([k, 0, 0.0]), np.array([k, 5.0, 0]), UP, SIZE, 50.0) for k in range(count)]


@pytest.mark.parametrize(("count", "expected"), [(3, 0), (5, 0), (6, 1), (7, 1), (12, 2), (40, 5)])
def test_one_view_in_eight_is_held_out_of_enough(count, expected):
    for cameras in (ring(count), walk(count)):
        found = chosen(cameras, 8)
        assert len(found) == len(set(found)) == expected
    assert FEWEST_VIEWS == 6


def test_the_ends_of_a_walk_and_their_neighbours_are_trained_on():
    for count in (9, 20, 41):
        found = chosen(walk(count), 8)
        assert min(found) >= 2
        assert max(found) <= count - 3
        assert np.all(np.diff(found) > 2)


def test_a_view_on_its_own_is_trained_on():
    alone = look_at(np.array([0.0, 0, 9]), np.zeros(3), np.array([0.0, 1, 0]), SIZE, 50.0)
    turned = look_at(np.array([3.0, 0, 1]), np.array([9.0, 0, 1]), UP, SIZE, 50.0)  # looks away from the rest
    found = chosen([alone, *ring(14), turned], 4)
    assert len(found) == 4
    assert not {0, 15} & set(found)


def test_held_out_share_is_bounded():
    assert chosen(ring(12), 0) == chosen(ring(12), 1) == []
    assert len(chosen(ring(12), 2)) <= 6


def test_held_out_views_survive_rounding_and_similarity():
    rng = np.random.default_rng(0)
    eyes = rng.normal(0, 2, (23, 3))
    cameras = [look_at(eye, rng.normal(0, 0.3, 3), UP, SIZE, 50.0) for eye in eyes]
    to = moving(np.array([3.0, -7, 1])).then(rotating(np.array([1.0, 2, 3]), 77)).then(scaling(0.03))
    assert chosen([to.camera(camera) for camera in cameras], 8) == chosen(cameras, 8)
    shaken = [
        replace(camera, world_to_camera=camera.world_to_camera * (1 + 1e-13 * rng.normal()))
        for camera in ring(24)
    ]
    assert chosen(shaken, 8) == chosen(ring(24), 8)


def test_cameras_in_one_place_are_told_apart_by_direction():
    ahead = [np.array([np.cos(k / 8), np.sin(k / 8), 0.0]) for k in range(9)]
    found = chosen([look_at(np.zeros(3), to, UP, SIZE, 50.0) for to in ahead], 8)
    assert 2 <= found[0] <= 6


def test_every_eighth_view_by_name_is_held_out():
    cameras = tuple(replace(camera, name=f"v{k}") for k, camera in enumerate(ring(10)))
    images = tuple(np.zeros((SIZE[1], SIZE[0], 3), np.uint8) for _ in cameras)
    capture = Capture(cameras, images, np.zeros((0, 3)), np.zeros((0, 3), np.uint8))
    assert split(capture, DatasetConfig(hold_out="every", test_every=4))[1] == [0, 4, 8]
    train, held_out = split(capture, DatasetConfig(test_every=8))
    assert len(held_out) == 1
    assert sorted(train + held_out) == list(range(10))
