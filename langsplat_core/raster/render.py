"""The front door of the rasterizers: a scene and a camera in, a picture out.

>>> import numpy as np
>>> from langsplat_core import Gaussians, Scene, look_at, render
>>> one = Gaussians(
...     means=np.zeros((1, 3)), log_scales=np.full((1, 3), -1.0), quats_wxyz=np.array([[1.0, 0, 0, 0]]),
...     opacity_logits=np.array([9.0]), sh=np.full((1, 1, 3), 1.0),
... )
>>> camera = look_at(np.array([0, 0, -4.0]), np.zeros(3), np.array([0, -1.0, 0]), (64, 48))
>>> picture = render(Scene(one), camera, backend="reference")
>>> picture.colours.shape, picture.alpha.shape, round(float(picture.alpha[24, 32]), 2)
((48, 64, 3), (48, 64), 0.99)
"""

from dataclasses import dataclass

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.config import INRIA, RasterSettings
from langsplat_core.raster import load_rasterizer
from langsplat_core.raster.protocol import View
from langsplat_core.scene import Camera, Gaussians, Scene


@dataclass(frozen=True, eq=False)
class Rendering:
    """What one camera sees of a scene; every channel is premultiplied by alpha, without background."""

    colours: Array  # (H, W, 3) display colours >= 0, not clamped above
    alpha: Array  # (H, W) in [0, 1]
    values: Array  # (H, W, C) the further values that were asked for; C may be 0


def render(
    scene: Scene,
    camera: Camera,
    values: Array | None = None,
    backend: str = "cpu",
    profile: RasterSettings = INRIA,
) -> Rendering:
    """Draw `scene` as `camera` sees it.

    values: (N, C) further numbers per Gaussian, finite, to be blended along with the colours. backend: one
    of `raster.BACKENDS` that needs no device handed to it ("cpu", "cuda", "reference"). profile: constants
    of image formation; the scene's own antialiasing applies. Raises InputError for an unknown backend,
    BackendError for one that cannot load here.
    """
    view = load_rasterizer(backend).view(scene.gaussians, camera, scene.raster_settings(profile))
    return splat_colours(view, scene.gaussians, camera, values)


def splat_colours(view: View, gaussians: Gaussians, camera: Camera, values: Array | None = None) -> Rendering:
    """The picture of a view that is projected already, in one pass; values as in `render`."""
    columns = [colours_seen(gaussians, camera)]
    if values is not None:
        columns.append(np.asarray(values, np.float32))
    image, alpha = view.splat(np.concatenate(columns, 1) if values is not None else columns[0])
    return Rendering(image[..., :3], alpha, image[..., 3:])


def colours_seen(gaussians: Gaussians, camera: Camera) -> Array:
    """(N, 3) float32 display colours >= 0 of the Gaussians as seen from the camera; invalid rows are 0."""
    from langsplat_core.raster.cpu.colour import colours  # numba: a second that OpenGL need not wait for

    return colours(gaussians.sh, gaussians.means, camera.position)
