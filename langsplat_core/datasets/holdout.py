"""Photographs that are held out from training, to measure it on."""

from collections.abc import Sequence

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.config import DatasetConfig
from langsplat_core.datasets.capture import DECIMALS, Capture
from langsplat_core.scene import Camera

FEWEST_VIEWS = 6  # below, every photograph is needed for training, and nothing is measured
NEIGHBOURS = 4  # a view is surrounded where it lies in the middle of so many nearest training views
RADIAN = 2.0  # typical steps between cameras that a turn by a radian counts for


def split(capture: Capture, config: DatasetConfig) -> tuple[list[int], list[int]]:
    """Return indices of (training, held-out) views, about one in ``config.test_every``."""
    if config.hold_out == "every":
        return capture.split(config.test_every)
    held_out = chosen(capture.cameras, config.test_every)
    return [index for index in range(len(capture)) if index not in held_out], held_out


def chosen(cameras: Sequence[Camera], every: int, beside: Sequence[int] = ()) -> list[int]:
    """Return indices of one view in `every`, in ascending order, of which each lies among training views.

    Those at the ends of a walk show what no other photograph does, and tell nothing of the training.

    One after the other that view is taken which lies best in the middle of its nearest training views, by
    place and direction, measured by how far those are away. Its own nearest ones are then left to training,
    so that the views come from all over the capture. None of fewer than `FEWEST_VIEWS`, and none of those
    `beside`.
    """
    count = len(cameras)
    if every < 2 or count < FEWEST_VIEWS:
        return []
    stands = _stands(cameras)
    apart = np.linalg.norm(stands[:, None] - stands[None], axis=2)
    found: list[int] = []
    free = np.ones(count, bool)  # that may be held out
    free[list(beside)] = False
    for _ in range(max(1, round(count / every))):
        training = np.setdiff1d(np.arange(count), found)
        lean = {int(index): _lean(stands, apart, training, index) for index in training if free[index]}
        if not lean:
            break
        best = min(lean, key=lambda index: lean[index])
        found.append(best)
        free[np.argsort(apart[best], kind="stable")[: 1 + every // 2]] = False
    return sorted(found)


def _stands(cameras: Sequence[Camera]) -> Array:
    """Return (M, 6) place and direction of every camera, in typical steps from one camera to the next."""
    places = np.array([camera.position for camera in cameras])
    directions = np.array([camera.world_to_camera[2, :3] for camera in cameras])
    gaps = np.linalg.norm(places[:, None] - places[None], axis=2)
    np.fill_diagonal(gaps, np.inf)
    step = float(np.median(gaps.min(1))) or 1.0  # cameras in one place have none
    # Rounded, as another processor's last digits must not choose other views.
    return np.concatenate(
        [np.round(places / step, DECIMALS), np.round(RADIAN * directions, DECIMALS)], axis=1
    )


def _lean(stands: Array, apart: Array, training: Array, index: int) -> float:
    """Return how far view `index` is from the middle of its nearest training views, over how far those are.

    It is 0 in the middle, about 1 beside them.
    """
    others = training[training != index]
    nearest = others[np.argsort(apart[index, others], kind="stable")[:NEIGHBOURS]]
    offset = np.linalg.norm(stands[nearest].mean(0) - stands[index])
    return round(float(offset / max(apart[index, nearest].mean(), 1e-9)), 6)
