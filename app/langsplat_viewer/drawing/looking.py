"""Image formation for looking round: what training would clip is shown, a picture of nothing explained."""

import math
from dataclasses import replace

import numpy as np

from langsplat_core.arrays import logit
from langsplat_core.config import INRIA, RasterSettings
from langsplat_core.scene import SH_COUNTS, Camera, Gaussians, Scene
from langsplat_viewer.drawing.seeing import UNCLIPPED, Clip, Splats
from langsplat_viewer.parallel import eye_depth

NEAR_SHARE = 0.25  # of the depth of what is nearest in the picture
NEAREST_SHARE = 0.01  # of the Gaussians in the picture that count as the nearest
LEAST_NEAR = 1e-3  # of the depth of the middle one: nearer, a Gaussian would be a fog over everything
VISIBLE_ALPHA = 1 / 255
_SAMPLE = 20_000  # Gaussians looked at; quantiles need no more


def near_plane(gaussians: Gaussians, camera: Camera, most: float = INRIA.near) -> float:
    """Where the near plane lies for looking, world units: a share of the depth of what is nearest in the
    picture, so that one can go as near to a thing as it is small; at most `most`, the constant of training,
    so that the view of a photograph is the one that was trained."""
    rows = slice(None, None, max(len(gaussians) // _SAMPLE, 1))
    means = gaussians.means[rows].astype(np.float64)
    with np.errstate(invalid="ignore", over="ignore"):
        pixels, depths = camera.project(means)
        inside = (depths > 0) & (pixels >= 0).all(1) & (pixels < (camera.width, camera.height)).all(1)
        inside &= gaussians.opacity_logits[rows] > logit(np.array(VISIBLE_ALPHA))
    if not inside.any():
        return most
    nearest, middle = np.quantile(depths[inside], [NEAREST_SHARE, 0.5])
    return float(min(most, max(NEAR_SHARE * nearest, LEAST_NEAR * middle)))


def drawn_scene(scene: Scene, splats: Splats) -> Scene:
    """The scene with its Gaussians as `splats` wants them drawn; the scene itself where that changes nothing.
    The rows stay the same, so that layers fit both."""
    gaussians = scene.gaussians
    if splats.size != 1:
        scales = gaussians.log_scales + np.float32(np.log(splats.size))
        gaussians = replace(gaussians, log_scales=scales)
    if splats.sh_degree < gaussians.sh_degree:
        gaussians = replace(gaussians, sh=gaussians.sh[:, : SH_COUNTS[splats.sh_degree]])
    return scene if gaussians is scene.gaussians else replace(scene, gaussians=gaussians)


def looking_settings(scene: Scene, camera: Camera, clip: Clip = UNCLIPPED) -> RasterSettings:
    """The scene's own image formation, with the near plane of `near_plane`, and what `clip` cuts away;
    without what lies behind the eye of a parallel projection."""
    settings = scene.raster_settings()
    near = near_plane(scene.gaussians, camera, settings.near)
    clip = clip.beyond(eye_depth(camera))
    return replace(settings, near=max(near, clip.near), far=None if math.isinf(clip.far) else clip.far)


def why_undrawable(gaussians: Gaussians) -> str:
    """Why no camera could see anything of these; empty where one could."""
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
    """Why a picture that shows nothing does."""
    reason = why_undrawable(gaussians)
    if reason:
        return reason
    _, depths = camera.project(gaussians.means[gaussians.valid()].astype(np.float64))
    if (depths <= eye_depth(camera)).all():
        return "the whole scene lies behind the camera"
    if (depths <= near_plane(gaussians, camera)).all():
        return "the whole scene lies nearer than the camera can see"
    return "nothing of the scene lies in this picture"
