"""Gaussians through the graphics pipeline: OpenGL 4.1 core, so that it also runs on macOS.

A view is projected once, in a fragment pass with one fragment per Gaussian, and sorted on the CPU; a splat
then draws one quad per Gaussian, and the fixed-function blender composes back to front. The image formation
is that of `raster/reference.py` but for one thing: blending back to front cannot stop at T <= 1e-4, so a
pixel may differ by up to 1e-2 of the largest value behind.

From top to bottom: a context without a window, tools for moderngl, a scene's textures, the rasterizer.
"""

import math
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any, Literal

import moderngl
import numpy as np

from langsplat_core.arrays import Array, check_array, sigmoid, unit
from langsplat_core.compiled import shared_workers
from langsplat_core.config import INRIA, RasterSettings
from langsplat_core.errors import BackendError
from langsplat_core.raster.cpu.tiles import depth_order
from langsplat_core.raster.opengl import shader, splat_shaders
from langsplat_core.raster.protocol import View, dilation, far_plane, mean_depth, tangent_limits
from langsplat_core.scene import SH_COUNTS, Camera, Gaussians

# glcontext looks for libGL.so first; images without development packages have only the versioned names.
_VERSIONED = {"libgl": "libGL.so.1", "libegl": "libEGL.so.1"}
SOFTWARE_RENDERERS = ("llvmpipe", "softpipe", "swrast", "swr ", "software", "swiftshader", "basic render")


def is_software(ctx: moderngl.Context) -> bool:
    """Return True where the driver draws on the CPU."""
    renderer = ctx.info["GL_RENDERER"].lower()
    return any(name in renderer for name in SOFTWARE_RENDERERS)


def create_egl_context() -> moderngl.Context:
    """Return an OpenGL context >= 4.1 without a display (EGL); BackendError without a driver."""
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
    """Set uniforms by name; names that the compiler removed as unused are ignored."""
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
        self.geometry = self._layers(self._geometry(kept), "f4")
        sh = kept.sh.reshape(len(kept), 3 * kept.sh.shape[1])
        self.sh = self._layers(np.clip(sh, -HALF_MAX, HALF_MAX) if half else sh, "f2" if half else "f4")
        self.placement, self.shape, self.colours = (ctx.texture(self.size, 4, dtype="f4") for _ in range(3))
        self.projected = ctx.framebuffer([self.placement, self.shape, self.colours])
        self.order = ctx.buffer(reserve=4 * max(len(kept), 1), dynamic=True)  # int32 texels, back to front
        self._drawn = 0  # number of texels in `order`

    def sort(self, camera: Camera, settings: RasterSettings) -> None:
        """Fill `order` with the texels between near and far, back to front, ties by index."""
        # Term by term, as in the reference: a matrix product may round equal rows, which must tie, apart.
        x, y, z = self._means
        a, b, c, d = camera.world_to_camera[2]
        depths = x * a + y * b + z * c + d
        ahead = np.flatnonzero((depths > settings.near) & (depths <= far_plane(settings))).astype(np.int32)
        self._drawn = len(ahead)
        self.order.write(depth_order(depths, ahead, shared_workers())[::-1].tobytes())

    def texels(self) -> Array:
        """Return (m,) int32 texels that are drawn, back to front, read from `order`."""
        return np.frombuffer(self.order.read(4 * self._drawn) if self._drawn else b"", np.int32)

    def draw(self, quads: moderngl.VertexArray) -> None:
        """Draw a quad for each texel of `order`."""
        if self._drawn:
            quads.render(moderngl.TRIANGLE_STRIP, vertices=4, instances=self._drawn)

    @staticmethod
    def _geometry(kept: Gaussians) -> Array:
        """Return (n, 12) float32: mean, opacity, scales, an unused 0 and unit quaternion of each Gaussian."""
        scales = np.minimum(np.exp(kept.log_scales.astype(np.float64)), LARGEST_SCALE)
        quats = unit(kept.quats_wxyz.astype(np.float64), 1e-30)
        opacities = sigmoid(kept.opacity_logits.astype(np.float64))
        free = np.zeros((len(kept), 1))
        return np.concatenate([kept.means, opacities[:, None], scales, free, quats], 1).astype(np.float32)

    def _layers(self, values: Array, dtype: Literal["f2", "f4"]) -> moderngl.TextureArray:
        """Upload (n, C) values as a texture array of ceil(C / 4) RGBA layers."""
        layers = math.ceil(values.shape[1] / 4)
        padded = np.zeros((layers, self.size[0] * self.size[1], 4), dtype)
        for layer in range(layers):
            part = values[:, 4 * layer : 4 * layer + 4]
            padded[layer, : len(part), : part.shape[1]] = part
        texture = self._ctx.texture_array((*self.size, layers), 4, padded, dtype=dtype)
        texture.filter = (moderngl.NEAREST, moderngl.NEAREST)
        return texture

    def upload(self, values: Array) -> moderngl.Texture:
        """Return (N, C <= 3) values, a row a Gaussian, as a texture to draw; the caller releases it."""
        padded = np.zeros((self.size[0] * self.size[1], 4), np.float32)
        padded[: len(self.rows), : values.shape[1]] = values[self.rows]
        return self._ctx.texture(self.size, 4, padded, dtype="f4")

    def release(self) -> None:
        """Give the device memory back."""
        for resource in (self.projected, self.geometry, self.sh, self.placement, self.shape, self.colours):
            resource.release()
        self.order.release()


# Drawing.

MAX_TARGETS = 4  # colour attachments of one pass of `GlView.splat`, three values each
NOT_CURRENT = "its context is not current in this thread: render inside `with ctx:`"
Source = moderngl.Texture | Literal["colour"]  # what a target shows


class GlRasterizer:
    """Rasterizer `opengl`. Owns the device memory of one scene and one image size at a time.

    `precision` is that of the accumulated image. "half" suits a screen: every layer rounds once, which
    adds up to 4e-3 on average and 2e-2 at most on trained scenes where the driver rounds towards zero, as
    Mesa's software driver does (there "single" is the faster one, too); values up to 65504. "single"
    suits measurements: but for the cut-offs within 2e-5 in images of 400 pixels a side, 1e-4 in those of
    1920 and for needles across the image, as pixel positions are float32.

    Blending goes back to front and cannot stop: behind layers that would end a pixel more is drawn, with the
    weight that was left, at most 1e-2 and mostly below 1e-3.
    """

    name = "opengl"

    def __init__(self, ctx: moderngl.Context, precision: Literal["half", "single"] = "half") -> None:
        if ctx.version_code < 410:
            raise BackendError(
                f"rasterizer 'opengl' needs OpenGL 4.1, this driver offers {ctx.version_code / 100:.1f}; "
                "update the graphics driver or use --backend cpu"
            )
        self.ctx = ctx
        self.precision = precision
        self._project = ctx.program(
            vertex_shader=shader("fullscreen.vert"), fragment_shader=shader("project.frag")
        )
        self._project_vao = ctx.vertex_array(self._project, [])
        self._splats: dict[tuple[int, bool], moderngl.Program] = {}
        self._scene: SceneTextures | None = None
        self._current: GlView | None = None  # whose projection the scene's textures hold
        self._sorted: tuple[float, ...] | None = None  # near, far and plane of depths of its order
        self._targets: Targets | None = None

    def view(self, gaussians: Gaussians, camera: Camera, settings: RasterSettings = INRIA) -> "GlView":
        """Project with OpenGL; BackendError for an image beyond the driver, or without its context."""
        limit = self.ctx.info["GL_MAX_TEXTURE_SIZE"]
        if limit == 0:  # what moderngl reads where no context is current
            raise BackendError(f"rasterizer 'opengl': {NOT_CURRENT}")
        if max(camera.width, camera.height) > limit:
            raise BackendError(
                f"rasterizer 'opengl': this driver draws at most {limit} pixels a side, "
                f"not {camera.width}x{camera.height}; use a smaller size or --backend cpu"
            )
        self.scene(gaussians)  # one too large for the device is refused here
        return GlView(self, gaussians, camera, settings)

    def scene(self, gaussians: Gaussians) -> SceneTextures:
        """Return the scene's textures, uploaded if another scene was drawn last."""
        if self._scene is None or self._scene.gaussians is not gaussians:
            if self._scene is not None:
                self._scene.release()
            self._scene = self._current = self._sorted = None  # stays so if the upload fails
            try:
                self._scene = SceneTextures(self.ctx, gaussians, self.precision == "half")
            except moderngl.Error as error:
                raise BackendError(
                    f"rasterizer 'opengl': {error}; the scene is too large for the device "
                    f"(use --backend cpu) or {NOT_CURRENT}"
                ) from error
        return self._scene

    def draw(
        self, view: "GlView", sources: Sequence[Source], with_depth: bool = False
    ) -> tuple[moderngl.Texture, ...]:
        """Splat one image per source, at most five with depth, in one pass.

        A texture comes from `SceneTextures.upload`; "colour" is the view-dependent colour. Images are
        RGBA, premultiplied, row 0 on top. Depth comes last, as (sum of weight * camera z, alpha) in
        single precision. The images belong to the rasterizer and hold until its next `draw`.
        """
        scene = self.project(view)
        program = self._splat_program(len(sources), with_depth)
        targets = self._targets_for(view.camera, len(sources), with_depth)
        set_uniforms(
            program,
            {
                "placement": 0,
                "shape": 1,
                "values": np.arange(2, 2 + len(sources), dtype="i4").tobytes(),
                "columns": scene.columns,
                "image_size": (view.camera.width, view.camera.height),
                "alpha_min": view.settings.alpha_min,
                "alpha_max": view.settings.alpha_max,
            },
        )
        textures = [scene.colours if isinstance(source, str) else source for source in sources]
        for place, texture in enumerate((scene.placement, scene.shape, *textures)):
            texture.use(place)
        vao = self.ctx.vertex_array(program, [(scene.order, "1i/i", "gaussian")])
        with drawing(self.ctx, targets.framebuffer, moderngl.BLEND):
            targets.framebuffer.clear()
            self.ctx.blend_equation = moderngl.FUNC_ADD, moderngl.FUNC_ADD
            self.ctx.blend_func = moderngl.ONE, moderngl.ONE_MINUS_SRC_ALPHA
            scene.draw(vao)
        vao.release()
        return targets.images

    def project(self, view: "GlView") -> SceneTextures:
        """Return the scene's textures, with the projection and the draw order of `view` in them."""
        scene, camera, settings = self.scene(view.gaussians), view.camera, view.settings
        if self._current is view:
            return scene
        high = camera.position.astype(np.float32)
        added, fitted = dilation(camera, settings)
        set_uniforms(
            self._project,
            {
                "gaussians": 0,
                "sh": 1,
                "world_to_camera": camera.rotation.T.astype("f4").tobytes(),  # GLSL is column-major
                "camera_high": tuple(high),
                "camera_low": tuple(camera.position - high),
                "orthographic": camera.orthographic,
                "focal": (camera.fx, camera.fy),
                "principal": (camera.cx, camera.cy),
                "tangents": tangent_limits(camera, settings),
                "dilation": added,
                "fitted": fitted,
                "alpha_min": settings.alpha_min,
                "colour_max": HALF_MAX if self.precision == "half" else np.finfo(np.float32).max,
                "sh_count": SH_COUNTS[view.gaussians.sh_degree],
            },
        )
        scene.geometry.use(0)
        scene.sh.use(1)
        with drawing(self.ctx, scene.projected, moderngl.NOTHING):
            self._project_vao.render(moderngl.TRIANGLES, vertices=3)
        wanted = (settings.near, far_plane(settings), *camera.world_to_camera[2])
        if self._sorted != wanted:  # the order is kept when only the image plane changed
            scene.sort(camera, settings)
        self._current, self._sorted = view, wanted
        return scene

    def _splat_program(self, values: int, depth: bool) -> moderngl.Program:
        key = (values, depth)
        if key not in self._splats:
            vertex, fragment = splat_shaders(values, depth)
            self._splats[key] = self.ctx.program(vertex_shader=vertex, fragment_shader=fragment)
        return self._splats[key]

    def _targets_for(self, camera: Camera, values: int, depth: bool) -> Targets:
        key = (camera.width, camera.height, values, depth)
        if self._targets is None or self._targets.key != key:
            if self._targets is not None:
                self._targets.release()
            self._targets = Targets(self.ctx, key, "f2" if self.precision == "half" else "f4")
        return self._targets

    def release(self) -> None:
        """Give all device memory back; the rasterizer cannot be used afterwards."""
        programs: list[Any] = [*self._splats.values(), self._project_vao, self._project]
        for resource in (self._targets, self._scene, *programs):
            if resource is not None:
                resource.release()


class GlView(View):
    """View without device memory: its rasterizer projects it again when another was drawn in between."""

    def __init__(
        self, rasterizer: GlRasterizer, gaussians: Gaussians, camera: Camera, settings: RasterSettings
    ) -> None:
        self.rasterizer = rasterizer
        self.gaussians, self.camera, self.settings = gaussians, camera, settings
        self.count = len(gaussians)

    def splat(self, values: Array) -> tuple[Array, Array]:
        values = np.asarray(values)
        channels = check_array("values", values, (len(self.gaussians), "C"))["C"]
        image = np.zeros((self.camera.height, self.camera.width, channels), np.float32)
        scene, alpha = self.rasterizer.scene(self.gaussians), np.zeros(image.shape[:2], np.float32)
        firsts = range(0, max(channels, 1), 3)  # of textures; one for alpha even without channels
        for some in (firsts[at : at + MAX_TARGETS] for at in range(0, len(firsts), MAX_TARGETS)):
            sources = [scene.upload(values[:, first : first + 3]) for first in some]
            try:
                for first, texture in zip(some, self.rasterizer.draw(self, sources), strict=True):
                    target = self._read(texture)
                    alpha = target[..., 3]
                    image[..., first : first + 3] = target[..., : min(3, channels - first)]
            finally:
                for source in sources:
                    source.release()
        return image, alpha

    def _read(self, texture: moderngl.Texture) -> Array:
        flat = np.frombuffer(texture.read(), texture.dtype)
        return flat.reshape(self.camera.height, self.camera.width, texture.components).astype(np.float32)

    def depth(self) -> Array:
        return mean_depth(*np.moveaxis(self._read(self.rasterizer.draw(self, [], with_depth=True)[0]), -1, 0))

    def depth_at(self, column: int, row: int) -> tuple[float, float]:
        """Return what `View.depth_at` does, from the projection read back."""
        scene = self.rasterizer.project(self)
        order = scene.texels()[::-1]
        x, y, z, opacity = np.frombuffer(scene.placement.read(), "f4").reshape(-1, 4)[order].T
        along_x, along_y, *inverse = np.frombuffer(scene.shape.read(), "f4").reshape(-1, 4)[order].T
        dx, dy = column + 0.5 - x, row + 0.5 - y
        with np.errstate(over="ignore", invalid="ignore"):
            u = (along_x * dx + along_y * dy) * inverse[0]
            v = (along_x * dy - along_y * dx) * inverse[1]
            alphas = np.minimum(self.settings.alpha_max, opacity * np.exp(-0.5 * (u * u + v * v)))
        hit = alphas >= self.settings.alpha_min
        alphas, z = alphas[hit].astype(np.float64), z[hit].astype(np.float64)
        if len(z) == 0:
            return 0.0, 0.0
        after = np.cumprod(1 - alphas)
        if after[-1] <= 0.5:
            return float(z[np.argmax(after <= 0.5)]), float(1 - after[-1])
        weights = alphas * np.concatenate([[1.0], after[:-1]])
        return float((weights * z).sum() / weights.sum()), float(1 - after[-1])
