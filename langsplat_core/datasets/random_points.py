"""Points to begin with where structure from motion gave none, or too few."""

from collections.abc import Sequence

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.scene import Camera

NEAREST, FARTHEST = 0.3, 3.0  # random depths, as multiples of the distance to what the cameras look at
TELLING_POINTS = 50  # from this many known points on, depths follow theirs


def inside(camera: Camera, points: Array) -> Array:
    """(N,) True where a point lies in front of the camera and inside its picture."""
    pixels, depths = camera.project(points)
    return (depths > 0) & (pixels >= 0).all(1) & (pixels < (camera.width, camera.height)).all(1)


def look_distance(cameras: Sequence[Camera]) -> float:
    """Typical distance from the cameras to the place they look at, world units, > 0.

    That place is nearest to all optical axes in the least-squares sense; a small pull to the cameras'
    own mean keeps parallel axes from running to infinity.
    """
    positions = np.array([camera.position for camera in cameras])
    axes = np.array([camera.rotation[2] for camera in cameras])
    spread = max(float(np.linalg.norm(positions - positions.mean(0), axis=1).max()), 1e-3)
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    pull = 1e-3 * np.eye(3)
    centre = np.linalg.solve(
        across.mean(0) + pull,
        np.einsum("nij,nj->i", across, positions) / len(axes) + pull @ positions.mean(0),
    )
    distance = float(np.median(((centre - positions) * axes).sum(1)))
    return distance if distance > 0.1 * spread else 2 * spread


def random_points(
    count: int, known: Array, cameras: Sequence[Camera], images: Sequence[Array], rng: np.random.Generator
) -> tuple[Array, Array]:
    """`count` points in the cameras' view volume, (count, 3), with the (count, 3) uint8 colours of the pixels
    that they fall on.

    images: (H, W, 3) uint8, one per camera; known: (M, 3) points whose depths tell where the scene is, M may
    be 0. Depths are uniform in 1/z, so that near and far are equally dense in the pictures. Twice as many
    are drawn and those in sight of at least half the cameras preferred: one view alone teaches no depth.
    """
    distance = look_distance(cameras)
    near, far = NEAREST * distance, FARTHEST * distance
    if len(known) >= TELLING_POINTS:
        depths = np.concatenate([c.project(known)[1][inside(c, known)] for c in cameras])
        near, far = (float(z) for z in np.quantile(depths, (0.02, 0.98)))
    drawn = np.zeros((2 * count, 3))
    colours = np.zeros((2 * count, 3), np.uint8)
    owner = rng.integers(len(cameras), size=2 * count)
    for index, camera in enumerate(cameras):
        rows = np.flatnonzero(owner == index)
        x = rng.uniform(0, camera.width, len(rows))
        y = rng.uniform(0, camera.height, len(rows))
        z = 1 / rng.uniform(1 / far, 1 / near, len(rows))
        local = np.stack([(x - camera.cx) / camera.fx * z, (y - camera.cy) / camera.fy * z, z], -1)
        drawn[rows] = local @ camera.rotation + camera.position
        colours[rows] = images[index][y.astype(int), x.astype(int)]
    shared = np.sum([inside(camera, drawn) for camera in cameras], axis=0)
    best = np.argsort(shared < len(cameras) / 2, kind="stable")[:count]
    return drawn[best], colours[best]
