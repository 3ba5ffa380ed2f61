"""In which order the Gaussians of a view are drawn: back to front, found on the CPU or on the device."""

from dataclasses import dataclass
from typing import Protocol

import moderngl
import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.config import RasterSettings
from langsplat_core.raster.opengl.depth_sort import DepthSorter, SortBuffers
from langsplat_core.raster.opengl.scene_textures import SceneTextures
from langsplat_core.raster.protocol import farthest
from langsplat_core.scene import Camera
from langsplat_core.stopwatch import lap


def front_to_back(depths: Array) -> Array:
    """(n,) float64 depths -> (n,) indices by ascending depth, ties by index.

    NumPy's default sort is vectorised and about six times faster than its stable one, so equal depths
    are put right afterwards: they are few, and already neighbours.
    """
    order = np.argsort(depths)
    ascending = depths[order]
    equal = ascending[1:] == ascending[:-1]
    if equal.any():
        tied = np.flatnonzero(np.concatenate([[False], equal]) | np.concatenate([equal, [False]]))
        order[tied] = order[tied][np.lexsort((order[tied], ascending[tied]))]
    return order


class DrawOrder(Protocol):
    """Of the Gaussians ahead of one camera."""

    def write(self, scene: SceneTextures) -> None:
        """Make `scene.order` this order."""

    def rows(self, scene: SceneTextures) -> Array:
        """(m,) int32 texels, back to front; this order must be the one written last."""

    def draw(self, scene: SceneTextures, quads: moderngl.VertexArray) -> None:
        """A quad for each of them; this order must be the one written last."""


@dataclass(frozen=True, eq=False)
class CpuOrder:
    """Sorted by NumPy."""

    texels: Array  # (m,) int32, back to front

    def write(self, scene: SceneTextures) -> None:
        scene.order.write(self.texels)

    def rows(self, scene: SceneTextures) -> Array:
        return self.texels

    def draw(self, scene: SceneTextures, quads: moderngl.VertexArray) -> None:
        if len(self.texels):
            quads.render(moderngl.TRIANGLE_STRIP, vertices=4, instances=len(self.texels))


@dataclass(frozen=True, eq=False)
class DeviceOrder:
    """Sorted on the device when it is written; not even their number comes back to draw them."""

    sorter: DepthSorter
    plane: Array  # (4,) see `DepthSorter.sort`
    near: float
    far: float

    def write(self, scene: SceneTextures) -> None:
        self.sorter.sort(_buffers(scene), self.plane, self.near, self.far)

    def rows(self, scene: SceneTextures) -> Array:
        return _buffers(scene).order()

    def draw(self, scene: SceneTextures, quads: moderngl.VertexArray) -> None:
        quads.render_indirect(_buffers(scene).command, moderngl.TRIANGLE_STRIP, 1)


def _buffers(scene: SceneTextures) -> SortBuffers:
    assert scene.sort is not None  # as in `draw_order`; a scene that is uploaded again gets the same
    return scene.sort


def draw_order(
    scene: SceneTextures, camera: Camera, settings: RasterSettings, sorter: DepthSorter | None
) -> DrawOrder:
    """By camera z between the near and the far plane, ties by index; both ways give the same."""
    near, far = settings.near, farthest(settings)
    if sorter is not None and scene.sort is not None:
        return DeviceOrder(sorter, camera.world_to_camera[2], near, far)
    with lap("sort"):
        depths = scene.depths(camera)
        ahead = np.flatnonzero((depths > near) & (depths <= far))
        return CpuOrder(ahead[front_to_back(depths[ahead])][::-1].astype(np.int32))
