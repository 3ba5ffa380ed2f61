"""Depths of an image: clipping, near plane, the range of the depth display, and why nothing is seen."""

import math
from dataclasses import dataclass, replace

import numpy as np

from langsplat_core.arrays import Array, logit
from langsplat_core.config import INRIA, RasterSettings
from langsplat_core.scene import Camera, Gaussians, Scene


@dataclass(frozen=True)
class Clip:
    """Range of depths in which Gaussians are drawn, by their centres; world units from the eye. Answers and
    files have all of them."""

    near: float = 0.0
    far: float = math.inf

    def keeps(self, depths: Array) -> Array:
        """(N,) bool, of (N,) camera z."""
        kept: Array = (depths > self.near) & (depths <= self.far)
        return kept


UNCLIPPED = Clip()


# Image formation for looking round: what training would clip is shown, an image of nothing explained.

NEAR_SHARE = 0.25  # of the depth of what is nearest in the image
NEAREST_SHARE = 0.01  # of the Gaussians in the image that count as the nearest
LEAST_NEAR = 1e-3  # of the depth of the middle one: nearer, a Gaussian would be a fog over everything
VISIBLE_ALPHA = 1 / 255
_SAMPLE = 20_000  # Gaussians looked at; quantiles need no more


def _in_image(gaussians: Gaussians, camera: Camera) -> tuple[slice, Array, Array]:
    """A sample of the Gaussians: their rows, the (M,) camera z of their centres, world units, and (M,) bool,
    those whose centres are in the image."""
    rows = slice(None, None, max(len(gaussians) // _SAMPLE, 1))
    with np.errstate(invalid="ignore", over="ignore"):
        pixels, depths = camera.project(gaussians.means[rows].astype(np.float64))
        inside = (depths > 0) & (pixels >= 0).all(1) & (pixels < (camera.width, camera.height)).all(1)
    return rows, depths, inside


def near_plane(gaussians: Gaussians, camera: Camera, most: float = INRIA.near) -> float:
    """World units from the camera to the near plane: a share of the depth of what is nearest in the
    image, so that one can go as near to a thing as it is small; at most `most`, the constant of training,
    so that the view of a photograph is the one that was trained. Without perspective, that of the eye."""
    if camera.orthographic:
        return 0.0
    rows, depths, inside = _in_image(gaussians, camera)
    with np.errstate(invalid="ignore"):
        inside &= gaussians.opacity_logits[rows] > logit(np.array(VISIBLE_ALPHA))
    if not inside.any():
        return most
    nearest, middle = np.quantile(depths[inside], [NEAREST_SHARE, 0.5])
    return float(min(most, max(NEAR_SHARE * nearest, LEAST_NEAR * middle)))


def image_formation(scene: Scene, camera: Camera, clip: Clip = UNCLIPPED) -> RasterSettings:
    """The scene's own image formation, with the near plane of `near_plane`, and what `clip` cuts away."""
    settings = scene.raster_settings()
    near = near_plane(scene.gaussians, camera, settings.near)
    return replace(settings, near=max(near, clip.near), far=None if math.isinf(clip.far) else clip.far)


def depth_range(gaussians: Gaussians, camera: Camera, clip: Clip = UNCLIPPED) -> tuple[float, float]:
    """Near and far end of the depth display: the 2 % and 98 % quantiles of the camera z of those
    Gaussians whose centres are in the image and not cut away. World units; (0, 1) where there are none."""
    _, depths, inside = _in_image(gaussians, camera)
    with np.errstate(invalid="ignore"):
        inside &= clip.keeps(depths)
    if not inside.any():
        return 0.0, 1.0
    near, far = np.quantile(depths[inside], [0.02, 0.98])
    return float(near), float(far)


def camera_depths(gaussians: Gaussians, camera: Camera) -> Array:
    """(N, 1) float32 camera z, world units; finite."""
    with np.errstate(invalid="ignore", over="ignore"):
        depths = gaussians.means.astype(np.float64) @ camera.rotation[2] + camera.world_to_camera[2, 3]
        return np.nan_to_num(depths.astype(np.float32))[:, None]


def why_undrawable(gaussians: Gaussians) -> str:
    """Return why no camera could see anything of these; empty where one could."""
    count = len(gaussians)
    if count == 0:
        return "the scene holds no Gaussians"
    valid = gaussians.valid()
    if not valid.any():
        reasons = ", ".join(f"{rows:,} with {reason}" for reason, rows in gaussians.invalid_rows().items())
        return f"none of the {count:,} Gaussians can be drawn: {reasons}"
    if (gaussians.opacity_logits[valid] < logit(np.array(VISIBLE_ALPHA))).all():
        return f"all {int(valid.sum()):,} Gaussians are transparent"
    return ""


def why_nothing(gaussians: Gaussians, camera: Camera) -> str:
    """Return why an image shows nothing."""
    reason = why_undrawable(gaussians)
    if reason:
        return reason
    _, depths = camera.project(gaussians.means[gaussians.valid()].astype(np.float64))
    if (depths <= 0).all():
        return "the whole scene lies behind the camera"
    if (depths <= near_plane(gaussians, camera)).all():
        return "the whole scene lies nearer than the camera can see"
    return "nothing of the scene lies in this picture"
