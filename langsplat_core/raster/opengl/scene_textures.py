"""Scenes in the memory of an OpenGL device, and their draw order.

From top to bottom: a context without a window or a display, tools for drawing with moderngl, and the textures
of a scene, which the CPU sorts.
"""

import math
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import moderngl
import numpy as np

from langsplat_core.arrays import Array, sigmoid, unit
from langsplat_core.config import RasterSettings
from langsplat_core.errors import BackendError
from langsplat_core.raster.cpu.tiles import depth_order
from langsplat_core.raster.protocol import farthest
from langsplat_core.scene import Camera, Gaussians

# glcontext looks for libGL.so first; images without development packages have only the versioned names.
_VERSIONED = {"libgl": "libGL.so.1", "libegl": "libEGL.so.1"}
SOFTWARE_RENDERERS = ("llvmpipe", "softpipe", "swrast", "swr ", "software", "swiftshader", "basic render")


def is_software(ctx: moderngl.Context) -> bool:
    """Return True where the driver draws on the CPU."""
    renderer = ctx.info["GL_RENDERER"].lower()
    return any(name in renderer for name in SOFTWARE_RENDERERS)


def create_egl_context() -> moderngl.Context:
    """Return an OpenGL context of 4.1 or newer that needs no display: EGL on Linux.

    Raises BackendError where there is no driver for one.
    """
    linux = sys.platform.startswith("linux")
    attempts: list[dict[str, Any]] = [{"backend": "egl"}, {"backend": "egl", **_VERSIONED}] if linux else [{}]
    problem: Exception | None = None
    for options in attempts:
        try:
            return moderngl.create_context(standalone=True, require=410, **options)
        except Exception as error:  # noqa: BLE001  glcontext raises nothing more specific
            problem = error
    advice = "install libegl1 and libgl1-mesa-dri (Debian's names)" if linux else "update the graphics driver"
    raise BackendError(f"no offscreen OpenGL 4.1 ({problem}); {advice}, or use --backend cpu")


# Small tools for drawing with moderngl: uniforms, a pass that leaves the state as it was.


def set_uniforms(program: moderngl.Program, values: dict[str, object]) -> None:
    """Set uniforms by name; names that the compiler removed as unused are passed over."""
    for name, value in values.items():
        uniform = program.get(name, None)
        if isinstance(uniform, moderngl.Uniform):
            if isinstance(value, bytes):
                uniform.write(value)
            else:
                uniform.value = value


@contextmanager
def drawing(ctx: moderngl.Context, framebuffer: moderngl.Framebuffer, flags: int) -> Iterator[None]:
    """Draw into `framebuffer` with only `flags` enabled, then bind again what was bound before.

    Blending and all other switches end up off, the blend function is moderngl's default and the colour
    masks are those of the framebuffer bound before: a user interface drawn next finds a plain state.
    """
    # A standalone context begins with nothing bound. moderngl binds the last framebuffer again whenever it
    # makes one, which fails if that was released meanwhile: so the default one is bound, never ours.
    before = ctx.fbo or ctx.detect_framebuffer(0)
    framebuffer.use()
    ctx.enable_only(flags)
    try:
        yield
    finally:
        ctx.enable_only(moderngl.NOTHING)
        ctx.blend_func = moderngl.SRC_ALPHA, moderngl.ONE_MINUS_SRC_ALPHA
        before.use()


class Targets:
    """The images that one pass draws: RGBA, then depth as RG (sum of weight * camera z, alpha)."""

    def __init__(self, ctx: moderngl.Context, key: tuple[int, int, int, bool], dtype: str) -> None:
        self.key = key
        width, height, values, depth = key
        images = [ctx.texture((width, height), 4, dtype=dtype) for _ in range(values)]
        if depth:  # always single: half floats would give it 11 bits, and none beyond 65504 units
            images.append(ctx.texture((width, height), 2, dtype="f4"))
        for image in images:
            image.repeat_x = image.repeat_y = False
        self.images = tuple(images)
        self.framebuffer = ctx.framebuffer(images)

    def release(self) -> None:
        """Give the device memory back."""
        self.framebuffer.release()
        for image in self.images:
            image.release()


# A scene in the memory of an OpenGL 4.1 device: one texel per Gaussian, in layers of 2D textures.
#
# Textures, because OpenGL 4.1 (macOS) has no storage buffers, and moderngl no buffer textures. Invalid
# rows (`Gaussians.valid`) are left out here; `rows` says which are kept.

COLUMNS = 4096  # texels per row; 16384 rows, which every 4.1 device allows, then hold 67 million
HALF_MAX = 65504.0
LARGEST_SCALE = 1e20  # world units; beyond it products overflow float32 and nothing looks different


class SceneTextures:
    """The textures of one scene, and those into which `project.frag.glsl` writes one view of it."""

    def __init__(self, ctx: moderngl.Context, gaussians: Gaussians, half: bool) -> None:
        """half: colours in half precision."""
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
        self.order = ctx.buffer(reserve=4 * max(len(kept), 1), dynamic=True)  # int32 texels, back to front
        self._drawn = 0  # of them

    def sort(self, camera: Camera, settings: RasterSettings) -> None:
        """Fill `order` by camera z between near and far, ties by index."""
        # Term by term, as in the reference: a matrix product may round equal rows differently, and equal
        # depths must tie.
        x, y, z = self._means
        a, b, c, d = camera.world_to_camera[2]
        depths = x * a + y * b + z * c + d
        ahead = np.flatnonzero((depths > settings.near) & (depths <= farthest(settings))).astype(np.int32)
        self._drawn = len(ahead)
        self.order.write(ahead[depth_order(depths[ahead])[::-1]])

    def texels(self) -> Array:
        """(m,) int32 texels that are drawn, back to front, read from `order`."""
        return np.frombuffer(self.order.read(4 * self._drawn) if self._drawn else b"", np.int32)

    def draw(self, quads: moderngl.VertexArray) -> None:
        """Draw a quad for each texel of `order`."""
        if self._drawn:
            quads.render(moderngl.TRIANGLE_STRIP, vertices=4, instances=self._drawn)

    @staticmethod
    def _geometry(kept: Gaussians) -> Array:
        """(n, 12) numbers of each Gaussian: mean, opacity, scales, a free place, unit quaternion."""
        scales = np.minimum(np.exp(kept.log_scales.astype(np.float64)), LARGEST_SCALE)
        quats = unit(kept.quats_wxyz.astype(np.float64), 1e-30)
        opacities = sigmoid(kept.opacity_logits.astype(np.float64))
        free = np.zeros((len(kept), 1))
        return np.concatenate([kept.means, opacities[:, None], scales, free, quats], 1).astype(np.float32)

    def _layers(self, values: Array, dtype: str | np.dtype) -> moderngl.TextureArray:
        """Upload (n, C) values as a texture array of ceil(C / 4) RGBA layers."""
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
