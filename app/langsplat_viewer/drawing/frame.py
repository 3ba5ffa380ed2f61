"""From a scene, a camera and picture settings to pixels. Needs a GL context, never a window.

A rasterizer fills channel textures (colours, and the one further channel that the display needs); a
composite shader turns them into the picture. The channels are kept while camera, scene and layers stay,
so that moving a slider or repainting the user interface costs only the composite pass. Several pictures of
one camera share one pass of the rasterizer, see `FrameRenderer.prepare`.
"""

from collections.abc import Sequence
from typing import Literal

import moderngl
import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.config import PictureConfig
from langsplat_core.display.displays import (
    COLOUR_MAPS,
    DISPLAYS,
    MAX_QUERIES,
    NUMBERS,
    QUERY_COLOURS,
    Extra,
    HeatRanges,
    full_ranges,
    shader_defines,
)
from langsplat_core.progress import lap
from langsplat_core.raster import load_rasterizer
from langsplat_core.raster.opengl.scene_textures import drawing, is_software, set_uniforms, shader
from langsplat_core.scene import Camera, Scene
from langsplat_viewer.drawing.channels import (
    UNCLIPPED,
    VISIBLE_ALPHA,
    Channel,
    Clip,
    Layers,
    Sight,
    depth_range,
)
from langsplat_viewer.drawing.renderer import (
    ArraySource,
    ChannelSource,
    GlSource,
    Rasterized,
    Rasterizing,
    Textures,
)

Backend = Literal["auto", "opengl", "cpu", "cuda"]
PICK_ALPHA = 0.1  # a pixel with less alpha shows nothing that could be picked


def suits_opengl(ctx: moderngl.Context) -> bool:
    """Whether backend "auto" becomes "opengl": not on a driver before 4.1, and not on one that draws on
    the CPU, where the compiled CPU rasterizer is several times faster."""
    return ctx.version_code >= 410 and not is_software(ctx)


class FrameRenderer:
    """Draws a scene into framebuffers of one context, OpenGL 3.3 or newer.

    `backend` "auto" is "opengl" or "cpu", see `suits_opengl`; the attribute of that name says which it
    became. `precision` is that of the OpenGL rasterizer's images; None is half, but single on a software
    driver, which is faster with it and rounds half precision towards zero. Raises BackendError where a
    rasterizer cannot load.
    """

    def __init__(
        self,
        ctx: moderngl.Context,
        backend: Backend = "auto",
        precision: Literal["half", "single"] | None = None,
    ) -> None:
        if backend == "auto":
            backend = "opengl" if suits_opengl(ctx) else "cpu"
        self.backend: str = backend
        self._ctx = ctx
        self._source: ChannelSource
        if backend == "opengl":
            self._source = GlSource(ctx, precision or ("single" if is_software(ctx) else "half"))
        else:
            self._source = ArraySource(ctx, load_rasterizer(backend))
        self._program = ctx.program(
            vertex_shader=shader("fullscreen.vert", 330),
            fragment_shader=shader("compose.frag", 330, "langsplat_core.display", **shader_defines()),
        )
        self._vao = ctx.vertex_array(self._program, [])
        tables = np.stack(list(COLOUR_MAPS.values()))
        self._maps = ctx.texture((tables.shape[1], len(tables)), 3, tables.tobytes(), alignment=1)
        self._scene: Scene | None = None
        self._layers = Layers()
        self._clip = UNCLIPPED
        self._last: Sight | None = None  # of the last draw
        self._held: Sight | None = None  # of the channels
        self._channels: Sequence[Channel] = ()  # those of `_textures` after the colours
        self._textures: Textures = ()
        self._own: moderngl.Framebuffer | None = None

    def set_scene(self, scene: Scene) -> None:
        """Show another scene, without layers."""
        self._scene, self._layers, self._last = scene, Layers(), None
        self._held, self._channels = None, ()

    def set_clip(self, clip: Clip) -> None:
        """Draw what lies between other depths."""
        self._clip = clip

    def forget(self) -> None:
        """Do every step of the next picture anew."""
        self._held, self._channels = None, ()
        self._source.forget()

    def set_layers(self, latent_rgb: Array | None, relevancies: Array | None) -> None:
        """What the displays "latent" and "relevancy" show: (N, 3) colours in [0, 1] of the level shown;
        (N, Q) relevancies in [0, 1] of 1 to MAX_QUERIES queries. ValueError for other shapes."""
        layers = Layers(latent_rgb, relevancies)
        layers.check(0 if self._scene is None else len(self._scene.gaussians))
        self._layers = layers

    def prepare(self, camera: Camera, pictures: Sequence[tuple[PictureConfig, Layers | None]]) -> None:
        """Rasterize in one pass what several pictures of one camera need, at most three, unless it is all
        there; their `draw` or `read` then only composes. Layers of a picture as in `draw`."""
        if self._scene is not None:
            self._rasterize(self._sight(self._scene, camera), self._wanted(pictures))

    def ahead(
        self, camera: Camera, pictures: Sequence[tuple[PictureConfig, Layers | None]]
    ) -> Rasterizing | None:
        """What of `prepare` another thread can do, whatever is drawn here meanwhile; None where that is
        nothing, or all of it is there."""
        if self._scene is None:
            return None
        sight = self._sight(self._scene, camera)
        missing = self._missing(sight, self._wanted(pictures))
        work = None if missing is None else self._source.ahead(sight, missing)
        return None if missing is None or work is None else Rasterizing(sight, tuple(missing), work)

    def take(self, made: Rasterized) -> None:
        """Have what came of that, as if it had been prepared here."""
        self._held, self._channels = None, ()
        self._textures = made.finish()
        self._held, self._channels = made.of.sight, made.of.channels

    def _wanted(self, pictures: Sequence[tuple[PictureConfig, Layers | None]]) -> list[Channel]:
        return [(layers or self._layers).channel(picture) for picture, layers in pictures]

    def _sight(self, scene: Scene, camera: Camera) -> Sight:
        return Sight(scene, camera, self._clip)

    def _rasterize(self, sight: Sight, wanted: Sequence[Channel]) -> None:
        """Have `wanted` among the channels that are held."""
        missing = self._missing(sight, wanted)
        if missing is not None:
            self._held, self._channels = None, ()
            self._textures = self._source.render(sight, missing)
            self._held, self._channels = sight, tuple(missing)

    def _missing(self, sight: Sight, wanted: Sequence[Channel]) -> list[Channel] | None:
        """What to rasterize beside colours to have `wanted`; None where all of it is held."""
        held = {channel.key for channel in self._channels}
        needed = {channel.key: channel for channel in wanted if channel.extra != "none"}
        return None if self._held == sight and needed.keys() <= held else list(needed.values())

    def _texture_of(self, channel: Channel) -> moderngl.Texture:
        """The one that holds a channel; the colours where it is none."""
        places = (place for place, held in enumerate(self._channels, 1) if held.key == channel.key)
        return self._textures[next(places, 0)]

    def draw(
        self,
        target: moderngl.Framebuffer,
        camera: Camera,
        picture: PictureConfig,
        heat_ranges: HeatRanges = (),
        layers: Layers | None = None,
    ) -> None:
        """Fill `target`'s viewport with the picture and leave `target` bound.

        The image is rasterized at the camera's size and stretched to the viewport if that is another.
        `heat_ranges` as in `display.compose`; `layers` of this picture alone, None: those that are set.
        """
        if self._scene is None:
            colour = (0.0, 0.0, 0.0, 0.0) if picture.transparent else (*picture.background, 1.0)
            target.clear(*colour, viewport=target.viewport)
            target.use()
            return
        channel = (layers or self._layers).channel(picture)
        self._last = self._sight(self._scene, camera)
        self._rasterize(self._last, [channel])
        set_uniforms(self._program, self._uniforms(self._last, picture, heat_ranges, channel.extra))
        for unit, texture in enumerate((self._textures[0], self._texture_of(channel), self._maps)):
            texture.use(unit)
        with lap("compose", self._ctx.finish), drawing(self._ctx, target, moderngl.NOTHING):
            self._vao.render(moderngl.TRIANGLES, vertices=3)
        target.use()

    def _uniforms(
        self, sight: Sight, picture: PictureConfig, heat_ranges: HeatRanges, extra: Extra
    ) -> dict[str, object]:
        # Without its layer a display shows the plain colours.
        display = picture.display if extra == DISPLAYS[picture.display].extra else "rgb"
        return {
            "colours": 0,
            "extra": 1,
            "colour_maps": 2,
            "colour_map": list(COLOUR_MAPS).index(picture.colour_map),
            "transparent": picture.transparent,
            "display": NUMBERS[display],
            "query_colours": QUERY_COLOURS.astype("f4").tobytes(),
            "heat_ranges": np.array(full_ranges(heat_ranges, MAX_QUERIES), "f4").tobytes(),
            "own_colours": picture.own_colours,
            "heat_opacity": picture.heat_opacity,
            "dim": picture.dim,
            "threshold": picture.threshold,
            "alpha_gate": picture.alpha_gate,
            "background": picture.background,
            "depth_range": depth_range(sight.scene.gaussians, sight.camera, sight.clip)
            if extra == "depth"
            else (0.0, 1.0),
        }

    def read(
        self,
        camera: Camera,
        picture: PictureConfig,
        heat_ranges: HeatRanges = (),
        layers: Layers | None = None,
    ) -> Array:
        """(H, W, 3) uint8 picture as `draw` makes it, (H, W, 4) of a transparent one, at the camera's size,
        row 0 on top; leaves bound what was bound."""
        size = (camera.width, camera.height)
        if self._own is None or self._own.size != size:
            self._release_own()
            self._own = self._ctx.framebuffer([self._ctx.texture(size, 4)])
        before = self._ctx.fbo or self._ctx.detect_framebuffer(0)
        try:
            self.draw(self._own, camera, picture, heat_ranges, layers)
            components = 4 if picture.transparent else 3
            pixels = self._own.read(components=components, alignment=1)
        finally:
            before.use()
        return np.frombuffer(pixels, np.uint8).reshape(camera.height, camera.width, components)[::-1].copy()

    def shows_nothing(self) -> bool:
        """Whether the last drawn image, if there was one, holds nothing of the scene."""
        if self._held is None:
            return False
        colours = self._textures[0]
        alpha = np.frombuffer(colours.read(), colours.dtype).reshape(-1, colours.components)[:, -1]
        return bool(alpha.max(initial=0) < VISIBLE_ALPHA)

    def depth_at(self, x_px: float, y_px: float) -> float | None:
        """Camera z of the surface in the pixel at a position in the last drawn image (in pixels of its
        camera), world units; None outside the image, where alpha is small, and before anything was drawn.

        The surface is where half the light is stopped, so that neither a floater in front nor a wall
        behind is picked; where the scene is more transparent than that, the mean depth.
        """
        sight = self._last
        if sight is None or not (0 <= x_px < sight.camera.width and 0 <= y_px < sight.camera.height):
            return None
        depth, alpha = self._source.depth_at(sight, int(x_px), int(y_px))
        return depth if alpha > PICK_ALPHA and depth > 0 else None

    def depth_map(self) -> Array | None:
        """(H, W) camera z of the surface in every pixel of the last drawn image, world units, 0 where nothing
        stops half the light; None before anything was drawn."""
        if self._last is None:
            return None
        self._held = None  # the rasterizer draws, and its textures hold until then
        return self._source.depth_map(self._last)

    def _release_own(self) -> None:
        if self._own is not None:
            texture = self._own.color_attachments[0]
            self._own.release()
            texture.release()
            self._own = None

    def release(self) -> None:
        """Give all device memory back; the renderer cannot be used afterwards."""
        self._release_own()
        self._source.release()
        self._vao.release()
        self._program.release()
        self._maps.release()
