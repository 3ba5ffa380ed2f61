"""Tiny seeded scenes that many tests share."""

from dataclasses import replace

import numpy as np

from langsplat_core.arrays import Array, logit, rotation_matrices
from langsplat_core.scene import SH_COUNTS, Camera, Gaussians, look_at


def random_gaussians(
    n: int,
    seed: int = 0,
    sh_degree: int = 0,
    *,
    radius: float = 1.0,
    scale_range: tuple[float, float] = (0.02, 0.25),
) -> Gaussians:
    """`n` Gaussians in a ball of `radius` world units around the origin, anisotropy about 1 to 12.

    Quaternions are left unnormalised, as trained files hold them; opacities span 0.05 to 0.99.
    """
    rng = np.random.default_rng(seed)
    directions = rng.normal(size=(n, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    means = directions * radius * rng.uniform(size=(n, 1)) ** (1 / 3)
    sh = rng.normal(scale=0.25, size=(n, SH_COUNTS[sh_degree], 3))
    sh[:, 0] = rng.uniform(-1.7, 1.7, size=(n, 3))
    return Gaussians(
        means=means,
        log_scales=np.log(rng.uniform(*scale_range, size=(n, 3)) * radius),
        quats_wxyz=rng.normal(size=(n, 4)) * rng.uniform(0.5, 2.0, size=(n, 1)),
        opacity_logits=logit(rng.uniform(0.05, 0.99, size=n)),
        sh=sh,
    )


def random_camera(
    seed: int = 0,
    width: int = 70,
    height: int = 45,
    *,
    distance: float = 3.0,
    off_centre: bool = True,
) -> Camera:
    """A camera `distance` world units from the origin that looks roughly at it.

    With `off_centre` the principal point is not the middle and fx differs from fy.
    """
    rng = np.random.default_rng(seed)
    eye = rng.normal(size=3)
    eye *= distance / np.linalg.norm(eye)
    camera = look_at(eye, rng.uniform(-0.2, 0.2, size=3), rng.normal(size=3), (width, height))
    if not off_centre:
        return camera
    return Camera(
        width,
        height,
        camera.fx * 1.1,
        camera.fy * 0.95,
        width * rng.uniform(0.35, 0.65),
        height * rng.uniform(0.35, 0.65),
        camera.world_to_camera,
    )


def without_perspective(camera: Camera, distance: float = 3.0) -> Camera:
    """The orthographic camera that sees what is `distance` world units away as large."""
    return replace(camera, fx=camera.fx / distance, fy=camera.fy / distance, orthographic=True)


def covariances(g: Gaussians) -> Array:
    """(N, 3, 3) in world units, float64."""
    axes = rotation_matrices(g.quats_wxyz.astype(float)) * np.exp(g.log_scales.astype(float))[:, None]
    return axes @ axes.transpose(0, 2, 1)


def random_values(n: int, channels: int, seed: int = 0) -> Array:
    """(n, channels) float32 values in [0, 1)."""
    return np.random.default_rng(seed).uniform(size=(n, channels)).astype(np.float32)


def shifted(gaussians: Gaussians, camera: Camera, offset: Array) -> tuple[Gaussians, Camera]:
    """The same picture with the world's origin moved by `offset` (3,), up to rounding of the means."""
    moved = replace(gaussians, means=gaussians.means.astype(np.float64) + offset)
    matrix = camera.world_to_camera.copy()
    matrix[:3, 3] -= camera.rotation @ np.asarray(offset, np.float64)
    return moved, replace(camera, world_to_camera=matrix)
