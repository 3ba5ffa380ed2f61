"""Gaussians to begin with: one per structure-from-motion point (Kerbl et al. 2023, section 5.1)."""

from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from langsplat_core.arrays import Array, logit
from langsplat_core.datasets.capture import Capture
from langsplat_core.raster.spherical_harmonics import C0
from langsplat_core.scene import SH_COUNTS, Camera, Gaussians

INITIAL_OPACITY = 0.1
NEIGHBOURS = 3
SMALLEST_DISTANCE = 1e-7**0.5  # world units; INRIA bounds the squared distance by 1e-7
ISOLATED = 10.0  # a point is an outlier when its neighbours are this many times the median distance away
FEWEST_POINTS = 1_000  # fewer points are topped up to this number ...
RANDOM_POINTS = 10_000  # ... or to this one, when they are too few to show where the scene is
TELLING_POINTS = 50
NEAREST, FARTHEST = 0.3, 3.0  # random depths, as multiples of the distance to what the cameras look at


def initial_gaussians(
    capture: Capture, train_indices: Sequence[int], sh_degree: int, max_gaussians: int, seed: int
) -> Gaussians:
    """Isotropic Gaussians at the capture's points, as large as the mean distance to three neighbours.

    Points that no training camera sees, repeated points and isolated outliers are left out. Too few
    points are topped up with random ones from the volume that the training cameras see.
    """
    rng = np.random.default_rng(seed)
    cameras = [capture.cameras[i] for i in train_indices]
    points, rgb = _usable_points(capture.points, capture.colours / 255.0, cameras)
    if len(points) > max_gaussians:
        chosen = np.sort(rng.choice(len(points), max_gaussians, replace=False))
        points, rgb = points[chosen], rgb[chosen]
    wanted = FEWEST_POINTS if len(points) >= TELLING_POINTS else RANDOM_POINTS
    missing = min(wanted, max_gaussians) - len(points)
    if missing > 0:
        images = [capture.images[i] for i in train_indices]
        more, more_rgb = _random_points(missing, points, cameras, images, rng)
        points, rgb = np.concatenate([points, more]), np.concatenate([rgb, more_rgb])

    count = len(points)
    sh = np.zeros((count, SH_COUNTS[sh_degree], 3), np.float32)
    sh[:, 0] = (rgb - 0.5) / C0
    return Gaussians(
        means=points,
        log_scales=np.repeat(np.log(_neighbour_distance(points))[:, None], 3, axis=1),
        quats_wxyz=np.tile(np.array([1, 0, 0, 0], np.float32), (count, 1)),
        opacity_logits=np.full(count, logit(np.array(INITIAL_OPACITY))),
        sh=sh,
    )


def _usable_points(points: Array, rgb: Array, cameras: Sequence[Camera]) -> tuple[Array, Array]:
    """The points (and colours) worth starting from; see `initial_gaussians`."""
    keep = np.isfinite(points).all(1)
    points, rgb = points[keep], rgb[keep]
    _, first = np.unique(points, axis=0, return_index=True)
    first.sort()
    points, rgb = points[first], rgb[first]
    seen = np.zeros(len(points), bool)
    for camera in cameras:
        seen |= _inside(camera, points)
    points, rgb = points[seen], rgb[seen]
    if len(points) > NEIGHBOURS:
        distance = _neighbour_distance(points)
        keep = distance <= ISOLATED * np.median(distance)
        points, rgb = points[keep], rgb[keep]
    return points, rgb


def _inside(camera: Camera, points: Array) -> Array:
    """(N,) True where a point lies in front of the camera and inside its picture."""
    pixels, depths = camera.project(points)
    return (depths > 0) & (pixels >= 0).all(1) & (pixels < (camera.width, camera.height)).all(1)


def _neighbour_distance(points: Array) -> Array:
    """(N,) root mean square distance to the three nearest other points, world units, > 0."""
    if len(points) < 2:
        return np.ones(len(points))
    neighbours = min(NEIGHBOURS, len(points) - 1)
    distances, _ = cKDTree(points).query(points, k=neighbours + 1)
    return np.maximum(np.sqrt((distances[:, 1:] ** 2).mean(1)), SMALLEST_DISTANCE)


def _look_distance(cameras: Sequence[Camera]) -> float:
    """Typical distance from the cameras to the place they look at, world units.

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


def _random_points(
    count: int, points: Array, cameras: Sequence[Camera], images: Sequence[Array], rng: np.random.Generator
) -> tuple[Array, Array]:
    """`count` points in the cameras' view volume with the colours of the pixels they fall on.

    Depths are uniform in 1/z, so that near and far are equally dense in the pictures. Twice as many are
    drawn and those in sight of at least half the cameras preferred: one view alone teaches no depth.
    """
    distance = _look_distance(cameras)
    near, far = NEAREST * distance, FARTHEST * distance
    if len(points) >= TELLING_POINTS:
        depths = np.concatenate([c.project(points)[1][_inside(c, points)] for c in cameras])
        near, far = (float(z) for z in np.quantile(depths, (0.02, 0.98)))
    drawn = np.zeros((2 * count, 3))
    rgb = np.zeros((2 * count, 3))
    owner = rng.integers(len(cameras), size=2 * count)
    for index, camera in enumerate(cameras):
        rows = np.flatnonzero(owner == index)
        x = rng.uniform(0, camera.width, len(rows))
        y = rng.uniform(0, camera.height, len(rows))
        z = 1 / rng.uniform(1 / far, 1 / near, len(rows))
        local = np.stack([(x - camera.cx) / camera.fx * z, (y - camera.cy) / camera.fy * z, z], -1)
        drawn[rows] = local @ camera.rotation + camera.position
        rgb[rows] = images[index][y.astype(int), x.astype(int)] / 255.0
    shared = np.sum([_inside(camera, drawn) for camera in cameras], axis=0)
    best = np.argsort(shared < len(cameras) / 2, kind="stable")[:count]
    return drawn[best], rgb[best]
