"""Digests of captures, by which the stages of a training are named."""

from dataclasses import replace

import numpy as np
import pytest

from langsplat_core.datasets import Capture
from langsplat_core.scene import Camera


def captured(error: float = 0.0) -> Capture:
    """Three cameras and ten points, every number of their poses and places off by at most `error`."""
    rng, noise = np.random.default_rng(1), np.random.default_rng(2)
    cameras = []
    for number in range(3):
        pose = np.eye(4)
        pose[:3] += 0.1 * rng.normal(size=(3, 4)) + error * noise.uniform(-1, 1, (3, 4))
        cameras.append(Camera(4, 3, 5.0, 5.0, 2.0, 1.5, pose, f"view_{number}"))
    points = rng.normal(size=(10, 3)) + error * noise.uniform(-1, 1, (10, 3))
    images = tuple(rng.integers(0, 256, (3, 4, 3), dtype=np.uint8) for _ in cameras)
    return Capture(tuple(cameras), images, points, np.zeros((10, 3), np.uint8))


def test_rounding_of_another_processor_changes_no_digest():
    assert captured(1e-14).digest([0, 1, 2]) == captured().digest([0, 1, 2])
    zero = replace(captured(), points=np.zeros((10, 3)))
    assert replace(zero, points=-zero.points).digest([0]) == zero.digest([0])


@pytest.mark.parametrize("indices", [[0, 1], [1, 0, 2]])
def test_other_views_or_another_world_change_it(indices: list[int]):
    assert captured().digest(indices) != captured().digest([0, 1, 2])
    assert captured(1e-6).digest(indices) != captured().digest(indices)
