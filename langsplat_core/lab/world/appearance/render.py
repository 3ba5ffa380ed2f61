"""Photographs of a `World` by ray casting, with baked light; only weak highlights depend on the view."""

from dataclasses import dataclass

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.lab.world.appearance.colours import to_display
from langsplat_core.lab.world.appearance.light import Light, Tracer, bake
from langsplat_core.lab.world.appearance.shading import shade, surfaces
from langsplat_core.lab.world.assembly import World
from langsplat_core.scene import Camera

__all__ = ["Light", "Picture", "Renderer"]


@dataclass(frozen=True, eq=False)
class Picture:
    """One rendered view."""

    image: Array  # (H, W, 3) uint8 sRGB
    pieces: Array  # (H, W) int32 row of `World.ids` at each pixel's centre, -1 where no surface is
    depth: Array  # (H, W) float32 metres along the camera's z axis, inf where no surface is


class Renderer:
    """Holds the ray tracer and the light that reaches every surface."""

    def __init__(self, world: World, light: Light, samples: int = 32, cell: float = 0.0) -> None:
        """`samples`: rays for the lamp and again for everything around, per place where light is kept;
        `cell`: spacing of those places in metres where light varies, 0 for the vertices alone."""
        self._world = world
        self._tracer = Tracer(world)
        self._surfaces = surfaces(world, light, bake(self._tracer, world, light, samples, cell))

    def picture(self, camera: Camera, oversample: int = 2) -> Picture:
        """A view of the room. `oversample`: rays per pixel and axis; labels come from the pixel's centre."""
        fine = camera.resized(camera.width * oversample, camera.height * oversample)
        triangle, uv, depth = self._cast(fine)
        linear = self._shade(triangle, uv, camera.position)
        blocks = linear.reshape(camera.height, oversample, camera.width, oversample, 3).mean((1, 3))
        image = _developed(blocks)
        if oversample > 1:
            triangle, _, depth = self._cast(camera)
        pieces = np.where(triangle >= 0, self._world.piece_of[triangle], -1).astype(np.int32)
        shape = (camera.height, camera.width)
        return Picture(image, pieces.reshape(shape), depth.reshape(shape))

    def _cast(self, camera: Camera) -> tuple[Array, Array, Array]:
        """First surface at pixel centres: (H*W,) triangle or -1, (H*W, 2) barycentrics, (H*W,) depth."""
        origin, directions = _rays(camera)
        depth, triangle, uv, _ = self._tracer.first_hit(origin, directions)
        return np.where(np.isfinite(depth), triangle.astype(np.int64), -1), uv, depth

    def colours_at(self, triangle: Array, uv: Array, eye: Array) -> Array:
        """(N, 3) uint8 colour of surface points, given by triangle and barycentrics, as seen from `eye`."""
        return _developed(self._shade(triangle, uv, eye))

    def _shade(self, triangle: Array, uv: Array, eye: Array) -> Array:
        """(N, 3) linear light leaving points towards `eye` (3,)."""
        out = np.empty((len(triangle), 3), np.float32)
        shade(self._surfaces, triangle, uv.astype(np.float32), eye.astype(np.float32), out)
        return out


def _developed(linear: Array) -> Array:
    """Linear light -> uint8 sRGB. A soft shoulder, so that highlights do not clip."""
    soft = np.where(linear < 0.65, linear, 0.65 + 0.35 * np.tanh((linear - 0.65) / 0.55))
    return np.asarray((to_display(soft) * 255 + 0.5).astype(np.uint8))


def _rays(camera: Camera) -> tuple[Array, Array]:
    """Origin (3,) and (H*W, 3) directions through the pixel centres; length 1 along the camera's z axis."""
    x = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
    y = (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy
    r = camera.rotation
    across, down = x[:, None] * r[0], y[:, None] * r[1] + r[2]
    return camera.position, (down[:, None] + across[None]).reshape(-1, 3)
