"""Gaussians to begin with: one per structure-from-motion point (Kerbl et al. 2023, section 5.1)."""

from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from langsplat_core.arrays import Array, logit
from langsplat_core.datasets.capture import Capture
from langsplat_core.datasets.random_points import TELLING_POINTS, inside, random_points
from langsplat_core.raster.spherical_harmonics import C0
from langsplat_core.scene import SH_COUNTS, Camera, Gaussians

INITIAL_OPACITY = 0.1
NEIGHBOURS = 3
SMALLEST_DISTANCE = 1e-7**0.5  # world units; INRIA bounds the squared distance by 1e-7
ISOLATED = 10.0  # a point is an outlier when its neighbours are this many times the median distance away
# Fewer points are topped up to this number: features are found where there is detail, and what lies between
# is covered from random ones better than by splitting what is elsewhere (docs/photographs.md) ...
FEWEST_POINTS = 3_000
RANDOM_POINTS = 10_000  # ... or to this one, when they are too few to show where the scene is


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
        more, colours = random_points(missing, points, cameras, images, rng)
        points, rgb = np.concatenate([points, more]), np.concatenate([rgb, colours / 255.0])

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
        seen |= inside(camera, points)
    points, rgb = points[seen], rgb[seen]
    if len(points) > NEIGHBOURS:
        distance = _neighbour_distance(points)
        keep = distance <= ISOLATED * np.median(distance)
        points, rgb = points[keep], rgb[keep]
    return points, rgb


def _neighbour_distance(points: Array) -> Array:
    """(N,) root mean square distance to the three nearest other points, world units, > 0."""
    if len(points) < 2:
        return np.ones(len(points))
    neighbours = min(NEIGHBOURS, len(points) - 1)
    distances, _ = cKDTree(points).query(points, k=neighbours + 1)
    return np.maximum(np.sqrt((distances[:, 1:] ** 2).mean(1)), SMALLEST_DISTANCE)
