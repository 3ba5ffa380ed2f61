"""Which channels a picture needs, and those channels as arrays. No graphics device here."""

from dataclasses import dataclass

import numpy as np

from langsplat_core.arrays import Array, check_array
from langsplat_core.config import PictureConfig
from langsplat_core.display.colour_maps import MAX_QUERIES
from langsplat_core.display.compose import Channels
from langsplat_core.display.displays import DISPLAYS, Extra
from langsplat_core.raster import Rasterizer, View
from langsplat_core.raster.protocol import MedianDepth
from langsplat_core.raster.render import splat_colours
from langsplat_core.scene import Camera, Gaussians, Scene
from langsplat_viewer.looking import looking_settings

_DEPTH_SAMPLE = 20_000  # Gaussians looked at for the depth range; quantiles need no more


@dataclass(frozen=True, eq=False)
class Layers:
    """Values per Gaussian that a picture may show beside the scene's own colours."""

    latent_rgb: Array | None = None  # (N, 3) in [0, 1]
    relevancies: Array | None = None  # (N, Q) in [0, 1], Q from 1 to MAX_QUERIES

    def check(self, count: int) -> None:
        """ValueError where an array does not have `count` rows or the right number of columns."""
        if self.latent_rgb is not None:
            check_array("latent_rgb", self.latent_rgb, (count, 3))
        if self.relevancies is not None:
            queries = check_array("relevancies", self.relevancies, (count, "Q"))["Q"]
            if not 1 <= queries <= MAX_QUERIES:
                raise ValueError(
                    f"relevancies: 1 to {MAX_QUERIES} queries are shown at a time, got {queries}"
                )

    def extra(self, picture: PictureConfig) -> Extra:
        """The channel that `picture` needs beside colours and alpha, if it is there."""
        extra = DISPLAYS[picture.display].extra
        absent = extra in ("latent", "relevancies") and self.values(extra) is None
        return "none" if absent else extra

    def values(self, extra: Extra) -> Array | None:
        """The layer that is rasterized as `extra`, if there is one."""
        return {"latent": self.latent_rgb, "relevancies": self.relevancies}.get(extra)


def depth_range(gaussians: Gaussians, camera: Camera) -> tuple[float, float]:
    """Near and far end of the depth display: the 2 % and 98 % quantiles of the camera z of those
    Gaussians whose centres are in the image. World units; (0, 1) where there are none."""
    means = gaussians.means[:: max(len(gaussians) // _DEPTH_SAMPLE, 1)].astype(np.float64)
    with np.errstate(invalid="ignore", over="ignore"):
        pixels, depths = camera.project(means)
        inside = (pixels >= 0).all(1) & (pixels < (camera.width, camera.height)).all(1) & (depths > 0)
    if not inside.any():
        return 0.0, 1.0
    near, far = np.quantile(depths[inside], [0.02, 0.98])
    return float(near), float(far)


def camera_depths(gaussians: Gaussians, camera: Camera) -> Array:
    """(N, 1) float32 camera z, world units; finite."""
    with np.errstate(invalid="ignore", over="ignore"):
        depths = gaussians.means.astype(np.float64) @ camera.rotation[2] + camera.world_to_camera[2, 3]
        return np.nan_to_num(depths.astype(np.float32))[:, None]


def camera_key(camera: Camera) -> tuple[object, ...]:
    """Equal for cameras that give the same picture."""
    return camera.intrinsics, camera.world_to_camera.tobytes()


def surface_depths(view: View, count: int) -> Array:
    """(H, W) depth of the surface as a view of `count` Gaussians has it: the median where the rasterizer
    knows it, else the mean; world units, 0 where less than half of the light is stopped."""
    if isinstance(view, MedianDepth):
        return view.median_depth()
    _, alpha = view.splat(np.empty((count, 0), np.float32))
    return np.where(alpha >= 0.5, view.depth(), 0)


class ArrayChannels:
    """Channels by a rasterizer that returns arrays; the projection is kept while the camera rests."""

    def __init__(self, rasterizer: Rasterizer) -> None:
        self._rasterizer = rasterizer
        self._view: View | None = None
        self._shown: tuple[Gaussians, tuple[object, ...]] | None = None  # what `_view` is a view of

    def view(self, scene: Scene, camera: Camera) -> View:
        """The Gaussians of `scene` projected into `camera`."""
        gaussians, settings = scene.gaussians, looking_settings(scene, camera)
        key = (settings, *camera_key(camera))
        if (
            self._view is None
            or self._shown is None
            or self._shown[0] is not gaussians
            or self._shown[1] != key
        ):
            self._view, self._shown = self._rasterizer.view(gaussians, camera, settings), (gaussians, key)
        return self._view

    def render(self, scene: Scene, layers: Layers, camera: Camera, extra: Extra) -> Channels:
        """Colours, alpha and `extra`, in one pass."""
        gaussians = scene.gaussians
        values = camera_depths(gaussians, camera) if extra == "depth" else layers.values(extra)
        drawn = splat_colours(self.view(scene, camera), gaussians, camera, values)
        return Channels(
            rgb=drawn.colours,
            alpha=drawn.alpha,
            latent=drawn.values if extra == "latent" else None,
            relevancies=drawn.values if extra == "relevancies" else None,
            depth_sum=drawn.values[..., 0] if extra == "depth" else None,
            depth_range=depth_range(gaussians, camera) if extra == "depth" else (0.0, 1.0),
        )

    def depth_at(self, scene: Scene, camera: Camera, column: int, row: int) -> tuple[float, float]:
        """Depth of the surface in a pixel (the median where the rasterizer knows it, else the mean, as where
        the scene is transparent there), world units, 0 where there is nothing, and alpha."""
        view = self.view(scene, camera)
        _, alpha = view.splat(np.empty((len(scene.gaussians), 0), np.float32))
        median = view.median_depth()[row, column] if isinstance(view, MedianDepth) else 0
        return float(median or view.depth()[row, column]), float(alpha[row, column])
