"""What the rasterizer benchmark draws."""

from dataclasses import dataclass

import numpy as np

from langsplat_core.scene import Camera, Gaussians, look_at


@dataclass(frozen=True, eq=False)
class Case:
    """A scene, the camera that sees it and how many values each Gaussian carries."""

    scene: str  # "random", or the name of a file
    gaussians: Gaussians
    camera: Camera


def random_scene(count: int, seed: int = 0) -> Gaussians:
    """`count` small Gaussians in a unit ball, sized so that the picture's coverage does not grow with it."""
    generator = np.random.default_rng(seed)
    directions = generator.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    radius = generator.uniform(0, 1, (count, 1)) ** (1 / 3)
    size = 0.6 * count ** (-1 / 3)
    return Gaussians(
        means=directions * radius,
        log_scales=np.log(size * np.exp(generator.normal(-1.0, 0.5, (count, 3)))),
        quats_wxyz=generator.normal(size=(count, 4)),
        opacity_logits=generator.normal(0.0, 1.5, count),
        sh=generator.normal(0, 0.5, (count, 1, 3)),
    )


def default_camera(width: int, height: int) -> Camera:
    """A camera that sees the whole ball of `random_scene`."""
    return look_at(np.array([0.0, 0.0, -2.6]), np.zeros(3), np.array([0.0, -1.0, 0.0]), (width, height))


Pair = tuple[int, tuple[int, int]]  # Gaussians, (width, height)


def sweep(
    counts: tuple[int, ...], sizes: tuple[tuple[int, int], ...], pivot: int, extra: tuple[Pair, ...] = ()
) -> list[Pair]:
    """The random scenes: every count at the middle size, every size at `pivot` Gaussians, and those of
    `extra` whose count and size are asked for; small ones first, so that the time of large ones can be
    foretold."""
    middle = sorted(sizes)[len(sizes) // 2]
    pairs = {(count, middle) for count in counts} | {(pivot, size) for size in sizes}
    pairs |= {(count, size) for count, size in extra if count in (*counts, pivot) and size in sizes}
    return sorted(pairs, key=lambda pair: (pair[0], pair[1][0] * pair[1][1]))
