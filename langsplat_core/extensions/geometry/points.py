"""Points spread evenly over a scene's surface, and as Open3D takes them."""

from typing import TYPE_CHECKING

import numpy as np

from langsplat_core.arrays import Array, rotation_matrices, unit
from langsplat_core.errors import InputError
from langsplat_core.scene import Gaussians
from langsplat_core.scene.surface import surface_areas, surface_weights

if TYPE_CHECKING:
    from open3d.geometry import PointCloud

FEWEST = 100  # Gaussians: fewer have no surface to speak of


def sample_surface(gaussians: Gaussians, count: int, seed: int = 0) -> tuple[Array, Array]:
    """Return (count, 3) float64 points on the surface, as many on equal areas, and their unit normals.

    Normals, (count, 3), are of either sign. A Gaussian is a disc across its shortest axis, with the density
    of its two longest ones; one of a wall counts as many times as it covers. Raises InputError for a scene
    with less than `FEWEST` opaque Gaussians.
    """
    rows = np.flatnonzero(surface_weights(gaussians) > 0)
    areas = surface_areas(gaussians)[rows]
    if len(rows) < FEWEST or not areas.sum() > 0:
        raise InputError(f"{len(rows)} opaque Gaussians have no surface; at least {FEWEST} are needed")
    rng = np.random.default_rng(seed)
    chosen = rows[rng.choice(len(rows), count, p=areas / areas.sum())]
    axes = rotation_matrices(gaussians.quats_wxyz[chosen].astype(np.float64))  # columns
    lengths = np.exp(gaussians.log_scales[chosen].astype(np.float64).clip(max=np.log(np.sqrt(areas.max()))))
    shortest = lengths.argmin(1)
    steps = lengths * rng.normal(size=(count, 3))
    steps[np.arange(count), shortest] = 0
    points = gaussians.means[chosen] + np.einsum("nij,nj->ni", axes, steps)
    return points, unit(axes[np.arange(count), :, shortest])


def cloud(points: Array, normals: Array | None = None) -> "PointCloud":
    """(P, 3) points, with (P, 3) normals where there are such, as Open3D has them."""
    import open3d

    made = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
    if normals is not None:
        made.normals = open3d.utility.Vector3dVector(normals)
    return made
