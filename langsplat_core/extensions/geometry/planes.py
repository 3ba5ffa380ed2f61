"""Points sampled evenly from a scene's surface, and its floor, a plane found in them by RANSAC (Open3D)."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from langsplat_core.arrays import Array, rotation_matrices, unit
from langsplat_core.errors import InputError
from langsplat_core.scene import Gaussians, Scene
from langsplat_core.scene.surface import surface_areas, surface_weights

if TYPE_CHECKING:
    from open3d.geometry import PointCloud

FEWEST = 100  # least opaque Gaussians of a scene with a surface
SAMPLES = 30_000  # points of the surface
NEAR = 0.02  # largest distance of a plane's points, as a share of the scene's radius
LEAST = 0.02  # least share of the surface in a plane of a room
MOST = 8  # planes that are tried
LEVEL = 0.9  # least cosine of a floor's normals with up
BELOW = 0.05  # largest share of the surface below the floor: reflections and floaters


def sample_surface(gaussians: Gaussians, count: int) -> tuple[Array, Array]:
    """Return (count, 3) float64 points on the surface, of equal density by area, and their unit normals.

    Normals, (count, 3), are of either sign. A Gaussian is a disc across its shortest axis, with the density
    of its two longest ones. Raises InputError for fewer than `FEWEST` opaque Gaussians.
    """
    rows = np.flatnonzero(surface_weights(gaussians) > 0)
    areas = surface_areas(gaussians)[rows]
    if len(rows) < FEWEST or not areas.sum() > 0:
        raise InputError(f"{len(rows)} opaque Gaussians have no surface; at least {FEWEST} are needed")
    rng = np.random.default_rng(0)
    chosen = rows[rng.choice(len(rows), count, p=areas / areas.sum())]
    axes = rotation_matrices(gaussians.quats_wxyz[chosen].astype(np.float64))  # columns
    lengths = np.exp(gaussians.log_scales[chosen].astype(np.float64).clip(max=np.log(np.sqrt(areas.max()))))
    shortest = lengths.argmin(1)
    steps = lengths * rng.normal(size=(count, 3))
    steps[np.arange(count), shortest] = 0
    points = gaussians.means[chosen] + np.einsum("nij,nj->ni", axes, steps)
    return points, unit(axes[np.arange(count), :, shortest])


def cloud(points: Array, normals: Array | None = None) -> "PointCloud":
    """Return (P, 3) points, with (P, 3) normals if given, as a point cloud of Open3D."""
    import open3d

    made = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
    if normals is not None:
        made.normals = open3d.utility.Vector3dVector(normals)
    return made


@dataclass(frozen=True, eq=False)
class Room:
    """Up direction and floor of a scene."""

    up: Array  # (3,) unit: the floor's normal; the scene's own up without a floor
    ground: float  # height of the floor along `up`, world units; without one, of nearly the lowest surface
    has_floor: bool


def find_room(scene: Scene) -> Room:
    """Return up and floor: the largest level plane with little below it; InputError without a surface.

    Planes are found one by one, each among the level points that are in none of the planes before it.
    """
    import open3d

    points, normals = sample_surface(scene.gaussians, SAMPLES)
    up, near, least = scene.up(), NEAR * scene.bounds()[1], max(LEAST * len(points), 3)
    left = points[np.abs(normals @ up) >= LEVEL]
    open3d.utility.random.seed(0)
    for _ in range(MOST):
        if len(left) < least:
            break
        (*direction, offset), inside = cloud(left).segment_plane(near, 3, 1_000, 1.0)
        if len(inside) < least:
            break
        normal, length = np.array(direction), np.linalg.norm(direction)
        sign = 1 if normal @ up >= 0 else -1
        normal, ground = sign * normal / length, -sign * float(offset / length)
        if (points @ normal - ground < -2 * near).mean() <= BELOW:
            return Room(normal, ground, has_floor=True)
        left = np.delete(left, inside, axis=0)
    return Room(up, float(np.quantile(points @ up, BELOW)), has_floor=False)
