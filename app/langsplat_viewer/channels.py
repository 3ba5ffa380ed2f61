"""Which channels a picture needs, and those channels as arrays. No graphics device here."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from langsplat_core.arrays import Array, check_array
from langsplat_core.config import INRIA, PictureConfig
from langsplat_core.display.compose import Channels
from langsplat_core.errors import BackendError
from langsplat_core.raster import Rasterizer, View
from langsplat_core.scene import Camera, Gaussians, Scene

Extra = Literal["none", "latent", "relevancies", "depth"]  # what is rasterized beside colours and alpha
MAX_QUERIES = 3
_DEPTH_SAMPLE = 20_000  # Gaussians looked at for the depth range; quantiles need no more


@dataclass(frozen=True, eq=False)
class Layers:
    """Values per Gaussian that a picture may show beside the scene's own colours."""

    latent_rgb: Array | None = None  # (N, 3) in [0, 1]
    relevancies: Array | None = None  # (N, Q) in [0, 1], Q from 1 to 3

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
        if picture.display == "depth":
            return "depth"
        if picture.display == "latent" and self.latent_rgb is not None:
            return "latent"
        if picture.display in ("relevancy", "segmentation") and self.relevancies is not None:
            return "relevancies"
        return "none"


def depth_range(gaussians: Gaussians, camera: Camera) -> tuple[float, float]:
    """Near and far end of the depth display: the 2 % and 98 % quantiles of the camera z of those
    Gaussians whose centres are in the image. World units; (0, 1) where there are none."""
    means = gaussians.means[:: max(len(gaussians) // _DEPTH_SAMPLE, 1)].astype(np.float64)
    with np.errstate(invalid="ignore", over="ignore"):
        pixels, depths = camera.project(means)
        inside = (
            (pixels >= 0).all(1) & (pixels < (camera.width, camera.height)).all(1) & (depths > INRIA.near)
        )
    if not inside.any():
        return 0.0, 1.0
    near, far = np.quantile(depths[inside], [0.02, 0.98])
    return float(near), float(far)


def camera_key(camera: Camera) -> tuple[object, ...]:
    """Equal for cameras that give the same picture."""
    intrinsics = (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
    return (*intrinsics, camera.world_to_camera.tobytes())


class ArrayChannels:
    """Channels by a rasterizer that returns arrays; the projection is kept while the camera rests."""

    def __init__(self, rasterizer: Rasterizer) -> None:
        self._rasterizer = rasterizer
        self._view: View | None = None
        self._shown: tuple[Gaussians, tuple[object, ...]] | None = None  # what `_view` is a view of

    def view(self, scene: Scene, camera: Camera) -> View:
        """The Gaussians of `scene` projected into `camera`."""
        gaussians, settings = scene.gaussians, scene.raster_settings()
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
        from langsplat_core.raster.cpu.colour import colours  # numba: a second that OpenGL need not wait for

        gaussians = scene.gaussians
        values = [colours(gaussians.sh, gaussians.means, camera.position)]
        if extra == "depth":
            with np.errstate(invalid="ignore", over="ignore"):
                depths = gaussians.means.astype(np.float64) @ camera.rotation[2]
            values.append(np.nan_to_num(depths + camera.world_to_camera[2, 3])[:, None])
        elif extra == "latent" and layers.latent_rgb is not None:
            values.append(layers.latent_rgb)
        elif extra == "relevancies" and layers.relevancies is not None:
            values.append(layers.relevancies)
        image, alpha = self.view(scene, camera).splat(np.concatenate(values, 1, dtype=np.float32))
        more = image[..., 3:]
        return Channels(
            rgb=image[..., :3],
            alpha=alpha,
            latent=more if extra == "latent" else None,
            relevancies=more if extra == "relevancies" else None,
            depth_sum=more[..., 0] if extra == "depth" else None,
            depth_range=depth_range(gaussians, camera) if extra == "depth" else (0.0, 1.0),
        )

    def depth_at(self, scene: Scene, camera: Camera, column: int, row: int) -> tuple[float, float]:
        """Depth of the surface in a pixel (the median, or the mean where the scene is transparent there),
        world units, 0 where there is nothing, and alpha."""
        view = self.view(scene, camera)
        _, alpha = view.splat(np.empty((len(scene.gaussians), 0), np.float32))
        try:
            depth = view.depth("median")[row, column]
        except BackendError:  # CUDA has no median
            depth = 0
        return float(depth or view.depth("expected")[row, column]), float(alpha[row, column])
