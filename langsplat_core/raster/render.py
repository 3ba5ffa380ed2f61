"""Rendering of a scene as a camera sees it, by any of the rasterizers.

>>> import numpy as np
>>> from langsplat_core import Gaussians, Scene, look_at, render
>>> one = Gaussians(
...     means=np.zeros((1, 3)), log_scales=np.full((1, 3), -1.0), quats_wxyz=np.array([[1.0, 0, 0, 0]]),
...     opacity_logits=np.array([9.0]), sh=np.full((1, 1, 3), 1.0),
... )
>>> camera = look_at(np.array([0, 0, -4.0]), np.zeros(3), np.array([0, -1.0, 0]), (64, 48))
>>> image = render(Scene(one), camera, backend="reference")
>>> image.colours.shape, image.alpha.shape, round(float(image.alpha[24, 32]), 2)
((48, 64, 3), (48, 64), 0.99)
"""

from dataclasses import dataclass
from functools import cache

import numpy as np

from langsplat_core.arrays import Array, check_array
from langsplat_core.config import RasterSettings
from langsplat_core.errors import InputError, expect
from langsplat_core.raster import load_lifting_rasterizer, load_rasterizer, protocol
from langsplat_core.scene import Camera, Gaussians, Scene

SLACK = 1e-3  # px by which footprints are widened where one pixel's are chosen: backends round


def view_of(
    scene: Scene,
    camera: Camera,
    rasterizer: protocol.LiftingRasterizer | None = None,
    settings: RasterSettings | None = None,
) -> protocol.LiftingView:
    """Project `scene` into `camera`, once for any number of images.

    rasterizer: by default the CPU's; settings: of image formation, by default as the scene was trained.
    """
    expect(scene, Scene, "load_scene(path) returns one")
    expect(camera, Camera, "scene.cameras has those of a scene, look_at makes one")
    if isinstance(rasterizer, str):
        raise InputError(f"no name alone; say view_of(scene, camera, load_rasterizer({rasterizer!r}))")
    formed = scene.raster_settings() if settings is None else settings
    return (rasterizer or _cpu()).view(scene.gaussians, camera, formed)


@cache
def _cpu() -> protocol.LiftingRasterizer:
    """Return the process's CPU rasterizer: only one, so that all views reuse its memory."""
    return load_lifting_rasterizer("cpu")


@dataclass(frozen=True, eq=False)
class Rendering:
    """A scene as one camera sees it; every channel is premultiplied by alpha, without background."""

    colours: Array  # (H, W, 3) display colours >= 0, not clamped above
    alpha: Array  # (H, W) in [0, 1]
    values: Array  # (H, W, C) the further values that were asked for; C may be 0

    def __repr__(self) -> str:
        return f"<Rendering of {self.alpha.shape[1]}x{self.alpha.shape[0]} pixels>"


def render(
    scene: Scene,
    camera: Camera,
    values: Array | None = None,
    backend: str = "cpu",
    profile: RasterSettings | None = None,
) -> Rendering:
    """Draw `scene` as `camera` sees it.

    values: (N, C) further numbers per Gaussian, finite, to be blended along with the colours. backend: one
    of `raster.BACKENDS` that needs no device handed to it ("cpu", "cuda", "reference"). profile: constants
    of image formation, such as `config.INRIA`; None: the published ones with the scene's own near plane. The
    scene's antialiasing applies to both. Raises InputError for an unknown backend, BackendError for one
    that cannot load here, ValueError for values of another shape or not finite.
    """
    expect(scene, Scene, "load_scene(path) returns one")
    expect(camera, Camera, "scene.cameras has those of a scene, look_at makes one")
    expect(profile, RasterSettings | None, "config.INRIA is one")
    if values is not None:
        values = np.asarray(values, np.float32)
        check_array("values", values, ("N", "C"), {"N": len(scene.gaussians.means)}, finite=True)
    rasterizer = _cpu() if backend == "cpu" else load_rasterizer(backend)
    view = rasterizer.view(scene.gaussians, camera, scene.raster_settings(profile))
    return splat_colours(view, scene.gaussians, values)


def splat_colours(view: protocol.View, gaussians: Gaussians, values: Array | None = None) -> Rendering:
    """Draw the image of a view of `gaussians` in one pass; values as in `render`."""
    rows = view.rows
    seen = colours_seen(gaussians, view.camera, rows)
    if values is not None:
        seen = np.concatenate([seen, np.asarray(values, np.float32)[rows]], 1)
    image, alpha = view.splat_rows(seen)
    return Rendering(image[..., :3], alpha, image[..., 3:])


def colours_seen(gaussians: Gaussians, camera: Camera, rows: Array | None = None) -> Array:
    """Return (N, 3) float32 colours >= 0 seen from the camera, 0 if invalid; (M, 3) of `rows` (M,)."""
    from langsplat_core.raster.cpu.projection import colours  # numba takes a second to import

    if camera.orthographic:
        sights = np.broadcast_to(camera.rotation[2].astype(np.float32), gaussians.means.shape)
        return colours(gaussians.sh, sights, np.zeros(3), rows)
    return colours(gaussians.sh, gaussians.means, camera.position, rows)


def pixel_weights(
    scene: Scene, camera: Camera, pixel: tuple[int, int], settings: RasterSettings | None = None
) -> tuple[Array, Array]:
    """Return (M,) int64 numbers of the Gaussians that paint `pixel` (column, row), and (M,) float32 weights.

    The weights, alpha_i T_i > 0, add up to the alpha of a pixel in the image. settings: see `view_of`.
    """
    from langsplat_core.compiled import shared_workers  # numba takes a second to import
    from langsplat_core.raster.cpu import projection

    column, row = pixel
    formed = scene.raster_settings() if settings is None else settings
    rows, at = projection.rows_of(scene.gaussians), projection.kernel_camera(camera, formed)
    found = projection.project_all(rows, at, shared_workers())
    boxes = found.geometry[found.drawn]
    across = np.abs(boxes[:, projection.MEAN_X] - column - 0.5) <= boxes[:, projection.HALF_WIDTH] + SLACK
    down = np.abs(boxes[:, projection.MEAN_Y] - row - 0.5) <= boxes[:, projection.HALF_HEIGHT] + SLACK
    near = found.drawn[across & down].astype(np.int64)
    view = _cpu().view(scene.gaussians.take(near), camera, formed)
    chosen = np.zeros((camera.height, camera.width, 1), np.float32)
    chosen[row, column] = 1
    weights = np.asarray(view.gather(chosen))[:, 0]
    painting = weights > 0
    return near[painting], weights[painting]
