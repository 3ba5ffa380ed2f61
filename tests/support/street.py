"""A walk straight ahead between two walls: what structure from motion finds hardest to begin with."""

from functools import cache
from pathlib import Path

import numpy as np
from PIL import Image
from scipy.ndimage import gaussian_filter, map_coordinates

from langsplat_core.arrays import Array

LENGTH, HALF_WIDTH, HEIGHT = 40.0, 3.0, 4.0  # world units; one walks along y at x = 0 and looks along it
TEXELS = 24  # per unit
SIZE, FOCAL = (480, 320), 420.0
EYE = 1.6  # above the ground


@cache
def _texture(seed: int, across: float) -> Array:
    """(texels along, texels across) in [0, 255], of the length of the street; nothing repeats."""
    noise = np.random.default_rng(seed).normal(size=(int(LENGTH * TEXELS) + 2, int(across * TEXELS) + 2))
    layers = [gaussian_filter(noise, sigma) for sigma in (1.5, 4, 12)]
    return np.clip(128 + sum(40 * layer / layer.std() for layer in layers), 0, 255)


def walk(folder: Path, count: int, step: float = 0.8) -> list[str]:
    """PNG files in `folder`, taken every `step` units; returns their names."""
    folder.mkdir(parents=True, exist_ok=True)
    names = [f"step_{index:02d}.png" for index in range(count)]
    for index, name in enumerate(names):
        Image.fromarray(_seen_from(3 + step * index)).reduce(2).save(folder / name)
    return names


def _seen_from(y: float) -> Array:
    """(2 H, 2 W) uint8."""
    width, height, focal = 2 * SIZE[0], 2 * SIZE[1], 2 * FOCAL
    v, u = np.mgrid[:height, :width] + 0.5
    right, up = (u - width / 2) / focal, (height / 2 - v) / focal - 0.03  # a little downward
    picture = np.full((height, width), 200.0)
    with np.errstate(divide="ignore"):
        depths = np.stack([-EYE / up, -HALF_WIDTH / right, HALF_WIDTH / right])
    depths[~(depths > 0)] = np.inf
    nearest, depth = depths.argmin(0), depths.min(0)
    across = [right * depth + HALF_WIDTH, EYE + up * depth, EYE + up * depth]
    for number, extent in enumerate((2 * HALF_WIDTH, HEIGHT, HEIGHT)):
        seen = (nearest == number) & (depth + y < LENGTH) & (across[number] < extent)
        place = TEXELS * np.stack([depth[seen] + y, across[number][seen]])
        picture[seen] = map_coordinates(_texture(number, extent), place, order=1, mode="nearest")
    return picture.astype(np.uint8)
