"""Which channels a picture needs, and those channels as arrays. No graphics device here."""

from collections.abc import Sequence
from copy import copy
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
from langsplat_core.scene import Camera, Gaussians
from langsplat_viewer.drawing.seeing import UNCLIPPED, Clip
from langsplat_viewer.drawing.sight import LastView, Sight
from langsplat_viewer.parallel import eye_depth

_DEPTH_SAMPLE = 20_000  # Gaussians looked at for the depth range; quantiles need no more


@dataclass(frozen=True, eq=False)
class Channel:
    """What is rasterized beside colours and alpha for one picture."""

    extra: Extra = "none"
    values: Array | None = None  # (N, 1 to 3) per Gaussian; None for "none" and "depth"

    @property
    def key(self) -> tuple[Extra, int]:
        """Equal for the same channel, as long as one of the two is held."""
        return self.extra, id(self.values)


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

    def channel(self, picture: PictureConfig) -> Channel:
        """That channel with its values."""
        extra = self.extra(picture)
        return Channel(extra, self.values(extra))

    def values(self, extra: Extra) -> Array | None:
        """The layer that is rasterized as `extra`, if there is one."""
        return {"latent": self.latent_rgb, "relevancies": self.relevancies}.get(extra)


def depth_range(gaussians: Gaussians, camera: Camera, clip: Clip = UNCLIPPED) -> tuple[float, float]:
    """Near and far end of the depth display: the 2 % and 98 % quantiles of the camera z of those
    Gaussians whose centres are in the image and not cut away. World units; (0, 1) where there are none."""
    means = gaussians.means[:: max(len(gaussians) // _DEPTH_SAMPLE, 1)].astype(np.float64)
    with np.errstate(invalid="ignore", over="ignore"):
        pixels, depths = camera.project(means)
        inside = (pixels >= 0).all(1) & (pixels < (camera.width, camera.height)).all(1) & (depths > 0)
        inside &= clip.beyond(eye_depth(camera)).keeps(depths)
    if not inside.any():
        return 0.0, 1.0
    near, far = np.quantile(depths[inside], [0.02, 0.98])
    return float(near), float(far)


def camera_depths(gaussians: Gaussians, camera: Camera) -> Array:
    """(N, 1) float32 camera z, world units; finite."""
    with np.errstate(invalid="ignore", over="ignore"):
        depths = gaussians.means.astype(np.float64) @ camera.rotation[2] + camera.world_to_camera[2, 3]
        return np.nan_to_num(depths.astype(np.float32))[:, None]


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
        self.views = LastView(rasterizer)

    def apart(self) -> "ArrayChannels":
        """Other ones, with the same projection to begin with: for another thread."""
        made = copy(self)
        made.views = copy(self.views)
        return made

    def render(self, sight: Sight, layers: Layers, extra: Extra) -> Channels:
        """Colours, alpha and `extra`, in one pass."""
        return self.render_all(sight, [Channel(extra, layers.values(extra))])[0]

    def render_all(self, sight: Sight, wanted: Sequence[Channel]) -> list[Channels]:
        """For each of `wanted` the colours, alpha and that channel; all of them in one pass."""
        gaussians, camera = sight.scene.gaussians, sight.camera
        columns = [camera_depths(gaussians, camera) if c.extra == "depth" else c.values for c in wanted]
        present = [column for column in columns if column is not None]
        values = np.concatenate(present, 1) if len(present) > 1 else next(iter(present), None)
        drawn = splat_colours(self.views.of(sight), gaussians, camera, values)
        ends = np.cumsum([0 if column is None else column.shape[1] for column in columns])
        parts = np.split(drawn.values, ends[:-1], axis=2)
        return [
            Channels(
                rgb=drawn.colours,
                alpha=drawn.alpha,
                latent=part if channel.extra == "latent" else None,
                relevancies=part if channel.extra == "relevancies" else None,
                depth_sum=part[..., 0] if channel.extra == "depth" else None,
                depth_range=depth_range(gaussians, camera, sight.clip)
                if channel.extra == "depth"
                else (0.0, 1.0),
            )
            for channel, part in zip(wanted, parts, strict=True)
        ]

    def depth_at(self, sight: Sight, column: int, row: int) -> tuple[float, float]:
        """Depth of the surface in a pixel (the median where the rasterizer knows it, else the mean, as where
        the scene is transparent there), world units, 0 where there is nothing, and alpha."""
        view = self.views.of(sight)
        _, alpha = view.splat(np.empty((len(sight.scene.gaussians), 0), np.float32))
        median = view.median_depth()[row, column] if isinstance(view, MedianDepth) else 0
        return float(median or view.depth()[row, column]), float(alpha[row, column])
