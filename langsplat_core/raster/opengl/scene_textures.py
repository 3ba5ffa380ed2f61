"""Scenes in the memory of an OpenGL device, and their draw order.

From top to bottom: a context without a window or a display, tools for drawing with moderngl, the sort on the
device, and the textures of a scene, which are sorted by the CPU or by the device.
"""

import math
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import product
from typing import Any, Literal

import moderngl
import numpy as np

from langsplat_core.arrays import Array, sigmoid, unit
from langsplat_core.config import RasterSettings
from langsplat_core.errors import BackendError
from langsplat_core.raster.opengl import shader
from langsplat_core.raster.protocol import farthest
from langsplat_core.scene import Camera, Gaussians

# glcontext looks for libGL.so first; images without development packages have only the versioned names.
_VERSIONED = {"libgl": "libGL.so.1", "libegl": "libEGL.so.1"}
VERSIONS = (430, 410)  # 4.3 sorts on the device; some drivers give no more than what is asked for
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
    for version, options in product(VERSIONS, attempts):
        try:
            return moderngl.create_context(standalone=True, require=version, **options)
        except Exception as error:  # noqa: BLE001  glcontext raises nothing more specific
            problem = error
    advice = "install libegl1 and libgl1-mesa-dri (Debian's names)" if linux else "update the graphics driver"
    raise BackendError(f"no offscreen OpenGL 4.1 ({problem}); {advice}, or use --backend cpu")


# Small tools for drawing with moderngl: uniforms, a pass that leaves the state as it was.


def set_uniforms(program: moderngl.Program | moderngl.ComputeShader, values: dict[str, object]) -> None:
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


# The draw order found on the device: a radix sort in compute shaders, OpenGL 4.3.
#
# It is the order of `front_to_back`, reversed, to the last bit: camera z is computed in double precision with
# the same operations, and the sort is stable. Only `depth_sort.comp.glsl` knows how.

GROUP, ROUNDS = 256, 8  # threads of a workgroup, and items that each of them takes
STEPS = ("keys", "count", "scan", "scatter")  # numbered as in the shader
DIGITS, KEY_BITS, DIGIT_BITS = 256, 64, 8
MEAN_BYTES = 24  # of one Gaussian, in the largest buffer
Sort = Literal["auto", "cpu", "device"]  # who finds the draw order
_PROBE = 5000  # points sorted to see whether the driver does it right


class SortBuffers:
    """Device memory to sort n points: 60 bytes each. `rows` becomes the order, `command` the draw of it."""

    def __init__(self, ctx: moderngl.Context, means: Array, rows: moderngl.Buffer) -> None:
        """means: (n, 3) world units; rows: room for n indices, which stays its owner's."""
        n = self.count = len(means)
        self.groups = max(-(-n // (GROUP * ROUNDS)), 1)
        self.rows = rows
        points = np.ascontiguousarray(means, np.float64).tobytes() or bytes(MEAN_BYTES)
        self.means = ctx.buffer(points)
        self.keys, self.other_keys = (ctx.buffer(reserve=8 * max(n, 1)) for _ in range(2))
        self.other_rows = ctx.buffer(reserve=4 * max(n, 1))
        self.counts = ctx.buffer(reserve=4 * DIGITS * self.groups)
        self.totals = ctx.buffer(reserve=4 * DIGITS)
        self.command = ctx.buffer(reserve=20)  # moderngl's stride; the last four bytes are not read

    def order(self) -> Array:
        """(m,) int32 rows of the points that are drawn, back to front, read from the device."""
        drawn = int(np.frombuffer(self.command.read(16), np.uint32)[1])
        return np.frombuffer(self.rows.read(4 * drawn), np.int32) if drawn else np.zeros(0, np.int32)

    def release(self) -> None:
        """Give the device memory back, all but `rows`."""
        own = self.means, self.keys, self.other_keys, self.other_rows, self.counts, self.totals, self.command
        for buffer in own:
            buffer.release()


class DepthSorter:
    """The compiled sort of one context.

    Raises BackendError where the driver cannot compile it, or sorts wrongly as some do.
    """

    def __init__(self, ctx: moderngl.Context) -> None:
        self._ctx = ctx
        self._programs: dict[str, moderngl.ComputeShader] = {}
        try:
            for number, name in enumerate(STEPS):
                source = shader("depth_sort.comp", "430 core", STEP=number, GROUP=GROUP, ROUNDS=ROUNDS)
                self._programs[name] = ctx.compute_shader(source)
            works = self._is_right()
        except moderngl.Error:
            works = False
        if not works:
            self.release()
            raise BackendError("this driver cannot sort: older than OpenGL 4.3, or its compute shaders fail")

    def holds(self, count: int) -> bool:
        """Return True where the driver's buffers are large enough for so many points."""
        return bool(MEAN_BYTES * count <= self._ctx.info["GL_MAX_SHADER_STORAGE_BLOCK_SIZE"])

    def sort(self, buffers: SortBuffers, plane: Array, near: float, far: float) -> None:
        """Order by camera z, far ones first, ties by descending index, those within (near, far] alone.

        plane: (4,) third row of the camera's world to camera matrix.
        """
        b = buffers
        b.command.write(np.array([4, 0, 0, 0, 0], np.uint32))
        for binding, buffer in ((0, b.means), (5, b.counts), (6, b.totals), (7, b.command)):
            buffer.bind_to_storage_buffer(binding)
        self._bind(b.keys, b.rows, b.other_keys, b.other_rows)
        values: dict[str, object] = {"plane": tuple(plane), "near": near, "far": far}
        values |= {"items": b.count, "groups": b.groups}
        self._run("keys", max(-(-b.count // GROUP), 1), values)
        here, there = (b.keys, b.rows), (b.other_keys, b.other_rows)
        for shift in range(0, KEY_BITS, DIGIT_BITS):  # an even number of passes: they end in `rows`
            self._bind(*here, *there)
            digit = values | {"digit_word": shift // 32, "digit_shift": shift % 32}
            for step, groups in (("count", b.groups), ("scan", DIGITS), ("scatter", b.groups)):
                self._run(step, groups, digit)
            here, there = there, here

    @staticmethod
    def _bind(*buffers: moderngl.Buffer) -> None:
        for binding, buffer in enumerate(buffers, 1):
            buffer.bind_to_storage_buffer(binding)

    def _run(self, step: str, groups: int, values: dict[str, object]) -> None:
        set_uniforms(self._programs[step], values)
        self._programs[step].run(groups)
        self._ctx.memory_barrier()

    def _is_right(self) -> bool:
        depths = np.random.default_rng(0).integers(-2, 60, _PROBE) * np.pi
        means = np.zeros((_PROBE, 3))
        means[:, 2] = depths
        rows = self._ctx.buffer(reserve=4 * _PROBE)
        buffers = SortBuffers(self._ctx, means, rows)
        self.sort(buffers, np.array([0.0, 0.0, 1.0, 0.0]), 0.2, 150.0)
        found = buffers.order()
        buffers.release()
        rows.release()
        ahead = np.flatnonzero((depths > 0.2) & (depths <= 150.0))
        return np.array_equal(found, ahead[np.argsort(depths[ahead], kind="stable")][::-1])

    def release(self) -> None:
        """Give the programs back."""
        for program in self._programs.values():
            program.release()


def chosen_sorter(ctx: moderngl.Context, sort: Sort) -> DepthSorter | None:
    """None where the CPU is to sort.

    "auto": a sorter that works, but none on a driver that runs on the CPU, where NumPy is faster.
    BackendError for "device" where there is none.
    """
    if sort == "cpu" or (sort == "auto" and is_software(ctx)):
        return None
    try:
        return DepthSorter(ctx)
    except BackendError:
        if sort == "device":
            raise
        return None


# A scene in the memory of an OpenGL 4.1 device: one texel per Gaussian, in layers of 2D textures.
#
# Textures, because OpenGL 4.1 (macOS) has no storage buffers, and moderngl no buffer textures. Invalid
# rows (`Gaussians.valid`) are left out here; `rows` says which are kept.

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
        self.order = ctx.buffer(reserve=4 * max(len(kept), 1), dynamic=True)  # int32 texels, back to front
        self._drawn = 0  # of them, sorted by NumPy
        self._sorter = sorter if sorter is not None and sorter.holds(len(kept)) else None
        self._buffers = None if self._sorter is None else SortBuffers(ctx, self._means.T, self.order)

    def sort(self, camera: Camera, settings: RasterSettings) -> None:
        """Fill `order` by camera z between near and far, ties by index; the device and NumPy do the same."""
        near, far, plane = settings.near, farthest(settings), camera.world_to_camera[2]
        if self._sorter is not None and self._buffers is not None:
            self._sorter.sort(self._buffers, plane, near, far)
            return
        # Term by term, as in the reference: a matrix product may round equal rows differently, and equal
        # depths must tie.
        x, y, z = self._means
        depths = x * plane[0] + y * plane[1] + z * plane[2] + plane[3]
        ahead = np.flatnonzero((depths > near) & (depths <= far))
        self._drawn = len(ahead)
        self.order.write(ahead[front_to_back(depths[ahead])][::-1].astype(np.int32))

    def texels(self) -> Array:
        """(m,) int32 texels that are drawn, back to front, read from `order`."""
        if self._buffers is not None:
            return self._buffers.order()
        return (
            np.frombuffer(self.order.read(4 * self._drawn), np.int32)
            if self._drawn
            else np.zeros(0, np.int32)
        )

    def draw(self, quads: moderngl.VertexArray) -> None:
        """Draw a quad for each texel of `order`; sorted by the device, not even their number is read back."""
        if self._buffers is not None:
            quads.render_indirect(self._buffers.command, moderngl.TRIANGLE_STRIP, 1)
        elif self._drawn:
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
        if self._buffers is not None:
            self._buffers.release()


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
