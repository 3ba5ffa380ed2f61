"""A scene in the memory of an OpenGL 4.1 device: one texel per Gaussian, in layers of 2D textures.

Textures, because OpenGL 4.1 (macOS) has no storage buffers, and moderngl no buffer textures. Invalid
rows (`Gaussians.valid`) are left out here; `rows` says which are kept.
"""

import math

import moderngl
import numpy as np

from langsplat_core.arrays import Array, sigmoid, unit
from langsplat_core.errors import BackendError
from langsplat_core.raster.opengl.depth_sort import DepthSorter, SortBuffers
from langsplat_core.scene import Camera, Gaussians

COLUMNS = 4096  # texels per row; 16384 rows, which every 4.1 device allows, then hold 67 million
HALF_MAX = 65504.0
LARGEST_SCALE = 1e20  # world units; beyond it products overflow float32 and nothing looks different


class SceneTextures:
    """The textures of one scene, and those into which `project.frag.glsl` writes one view of it."""

    def __init__(
        self, ctx: moderngl.Context, gaussians: Gaussians, half: bool, sorter: DepthSorter | None
    ) -> None:
        """half: colours in half precision; `sorter` for scenes that its buffers hold."""
        self.gaussians = gaussians
        self.rows = np.flatnonzero(gaussians.valid())  # (n,) kept rows
        kept = gaussians.take(self.rows)
        self._means = np.ascontiguousarray(kept.means.T, np.float64)  # (3, n)
        self._ctx = ctx
        self.columns = max(min(COLUMNS, len(kept)), 1)
        self.size = (self.columns, max(math.ceil(len(kept) / self.columns), 1))
        if self.size[1] > ctx.info["GL_MAX_TEXTURE_SIZE"]:
            raise BackendError(
                f"rasterizer 'opengl': {len(kept)} Gaussians exceed this driver's texture size; "
                "use --backend cpu"
            )
        self.geometry = self._layers(self._geometry(kept), np.dtype(np.float32))
        sh = kept.sh.reshape(len(kept), 3 * kept.sh.shape[1])
        self.sh = self._layers(np.clip(sh, -HALF_MAX, HALF_MAX) if half else sh, "f2" if half else "f4")
        self.placement, self.shape, self.colours = (ctx.texture(self.size, 4, dtype="f4") for _ in range(3))
        self.projected = ctx.framebuffer([self.placement, self.shape, self.colours])
        self.order = ctx.buffer(reserve=4 * max(len(kept), 1), dynamic=True)
        self.sort = (
            SortBuffers(ctx, self._means.T, self.order) if sorter and sorter.holds(len(kept)) else None
        )

    def depths(self, camera: Camera) -> Array:
        """(n,) float64 camera z. Term by term, as in the reference: a matrix product may round equal rows
        differently, and equal depths must tie."""
        x, y, z = self._means
        a, b, c, d = camera.world_to_camera[2]
        depths: Array = x * a + y * b + z * c + d
        return depths

    @staticmethod
    def _geometry(kept: Gaussians) -> Array:
        """(n, 12): mean and opacity, scales and a free place, unit quaternion."""
        scales = np.minimum(np.exp(kept.log_scales.astype(np.float64)), LARGEST_SCALE)
        quats = unit(kept.quats_wxyz.astype(np.float64), 1e-30)
        opacities = sigmoid(kept.opacity_logits.astype(np.float64))
        free = np.zeros((len(kept), 1))
        return np.concatenate([kept.means, opacities[:, None], scales, free, quats], 1).astype(np.float32)

    def _layers(self, values: Array, dtype: str | np.dtype) -> moderngl.TextureArray:
        """(n, C) -> texture array of ceil(C / 4) RGBA layers."""
        kind = np.dtype(dtype)
        layers = math.ceil(values.shape[1] / 4)
        padded = np.zeros((layers, self.size[0] * self.size[1], 4), kind)
        for layer in range(layers):
            part = values[:, 4 * layer : 4 * layer + 4]
            padded[layer, : len(part), : part.shape[1]] = part
        texture = self._ctx.texture_array((*self.size, layers), 4, padded, dtype=f"f{kind.itemsize}")
        texture.filter = (moderngl.NEAREST, moderngl.NEAREST)
        return texture

    def upload(self, values: Array) -> moderngl.Texture:
        """(N, C <= 3) values, a row for every Gaussian of the scene -> a texture that a splat can draw.

        The caller releases it.
        """
        padded = np.zeros((self.size[0] * self.size[1], 4), np.float32)
        padded[: len(self.rows), : values.shape[1]] = values[self.rows]
        return self._ctx.texture(self.size, 4, padded, dtype="f4")

    def release(self) -> None:
        """Give the device memory back."""
        for resource in (self.projected, self.geometry, self.sh, self.placement, self.shape, self.colours):
            resource.release()
        self.order.release()
        if self.sort is not None:
            self.sort.release()
