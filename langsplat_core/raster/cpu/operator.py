"""``W x`` and ``W^T y`` over tiles, whatever keeps or makes the weights of a tile."""

from abc import ABC, abstractmethod

import numpy as np

from langsplat_core.arrays import Array, check_array
from langsplat_core.compiled import Workers, plain
from langsplat_core.raster.cpu import blend
from langsplat_core.raster.cpu.planes import padded
from langsplat_core.raster.cpu.tiles import Tiles
from langsplat_core.scene import Camera

_CHANNELS_AT_ONCE = 32  # a tile's state stays in the first level cache


class TileOperator(ABC):
    """The linear operator W of a view: M drawn of `count` Gaussians, in depth order, with their tiles."""

    def __init__(self, camera: Camera, count: int, order: Array, tiles: Tiles, workers: Workers) -> None:
        self.camera, self.count = camera, count
        self.order = order  # (M,) int32
        self.tiles, self.workers = tiles, workers
        self.dropped = 0

    @abstractmethod
    def depth(self) -> Array:
        """See `View.depth`; float32."""

    @abstractmethod
    def median_depth(self) -> Array:
        """See `MedianDepth.median_depth`; float32."""

    @abstractmethod
    def _splat_part(self, values: Array, image: Array, alpha: Array) -> None:
        """(M, padded(C)) values in depth order -> fill (H, W, C) image and (H, W, 1) alpha."""

    @abstractmethod
    def _gather_part(self, image: Array, partial: Array) -> None:
        """(H, W, C) image -> fill (I, padded(C)) sums, one row per intersection."""

    def splat(self, values: Array) -> tuple[Array, Array]:
        """See `View.splat`; float32. Values must be finite."""
        check_array("values", values, (self.count, "C"))
        ordered = values[self.order]
        height, width, channels = self.camera.height, self.camera.width, ordered.shape[1]
        alpha = np.empty((height, width, 1), np.float32)
        parts = []
        for start in range(0, max(channels, 1), _CHANNELS_AT_ONCE):
            part = ordered[:, start : start + _CHANNELS_AT_ONCE]
            image = np.empty((height, width, part.shape[1]), np.float32)
            self._splat_part(in_fours(part), image, alpha)
            parts.append(image)
        return parts[0] if len(parts) == 1 else np.concatenate(parts, -1), alpha[..., 0]

    def gather(self, image: Array) -> Array:
        """See `LiftingView.gather`; float32, summed in float64 over tiles."""
        check_array("image", image, (self.camera.height, self.camera.width, "C"))
        channels = image.shape[2]
        values = np.zeros((self.count, channels), np.float32)
        for start in range(0, channels, _CHANNELS_AT_ONCE):
            part = plain(image[..., start : start + _CHANNELS_AT_ONCE])
            partial = np.empty((len(self.tiles.ranks), padded(part.shape[2])), np.float32)
            out = np.zeros((self.count, part.shape[2]), np.float32)
            self._gather_part(part, partial)
            self.workers.run(blend.sum_partials, len(self.order), self.tiles, self.order, partial, out)
            values[:, start : start + _CHANNELS_AT_ONCE] = out
        return values

    def contributions(self) -> Array:
        """See `LiftingView.contributions`; float32."""
        return self.gather(np.ones((self.camera.height, self.camera.width, 1), np.float32))[:, 0]


def in_fours(values: Array) -> Array:
    """(M, C) values as float32 (M, padded(C)), the last column zero where it was added."""
    count, channels = values.shape
    if padded(channels) == channels:
        return plain(values)
    wide = np.zeros((count, padded(channels)), np.float32)
    wide[:, :channels] = values
    return wide
