"""Renderers: a render request becomes an image. No window here.

A rasterizer makes channels (colours, and the one further channel of each pane); compositing turns them into
images: `ArrayRenderer` in NumPy, without a graphics device, `GlRenderer` with a shader. Channels are kept
while scene, camera and answers stay, so that moving a slider or repainting the user interface costs only the
compositing. All panes of a request share one pass of the rasterizer.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from copy import copy
from dataclasses import dataclass, replace
from typing import Literal

import moderngl
import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.display.composing import compose, compose_upwards
from langsplat_core.display.displays import (
    COLOUR_MAPS,
    QUERY_COLOURS,
    Channels,
    Ranges,
    drawing_of,
    full_ranges,
    shader_defines,
)
from langsplat_core.errors import BackendError
from langsplat_core.progress import Progress, lap
from langsplat_core.raster import Rasterizer, View, load_rasterizer
from langsplat_core.raster.opengl.rasterizer import GlRasterizer, GlView, Source
from langsplat_core.raster.opengl.scene_textures import create_egl_context, drawing, is_software, set_uniforms
from langsplat_core.raster.opengl.shaders import shader
from langsplat_core.raster.render import splat_colours, view_of
from langsplat_core.scene import Gaussians, Scene
from langsplat_viewer.rendering.request import (
    VISIBLE_ALPHA,
    Channel,
    Inputs,
    Pane,
    RenderKey,
    RenderRequest,
    camera_depths,
    depth_range,
)

Backend = Literal["auto", "opengl", "cpu", "cuda"]
Layer = moderngl.Texture | Channels  # what a pane is composed of, by the shader or by `compose`
Layers = tuple[Layer, ...]  # colours with alpha, then one for each channel that was wanted
Ahead = Callable[[Progress], Callable[[], Layers]]  # for any thread; what it returns: for the context's
PICK_ALPHA = 0.1  # a pixel with less alpha shows nothing that could be picked


@contextmanager
def open_renderer(backend: Backend = "auto") -> Iterator["ArrayRenderer | GlRenderer"]:
    """A renderer without a window, on the thread that it is opened on.

    Backends "cpu" and "cuda" touch no GL at all; "auto" takes "cpu" where GL is absent or software.
    Raises BackendError where the backend cannot work.
    """
    ctx = _context_for(backend)
    if ctx is None:
        yield ArrayRenderer(load_rasterizer("cpu" if backend == "auto" else backend))
        return
    try:
        yield GlRenderer(ctx, "opengl")
    finally:
        ctx.release()


def render_image(request: RenderRequest, backend: Backend = "auto") -> Array:
    """(H, W, 3) uint8 image, row 0 on top, (H, W, 4) of a transparent one. Raises as `open_renderer`."""
    with open_renderer(backend) as renderer:
        return renderer.read(request)


def suits_opengl(ctx: moderngl.Context) -> bool:
    """True where backend "auto" becomes "opengl": not on a driver before 4.1, and not on one that draws on
    the CPU, where the compiled CPU rasterizer is several times faster."""
    return ctx.version_code >= 410 and not is_software(ctx)


def _context_for(backend: Backend) -> moderngl.Context | None:
    """A context to draw with; None where the backend needs none."""
    if backend not in ("auto", "opengl"):
        return None
    try:
        ctx = create_egl_context()
    except BackendError:
        if backend == "auto":
            return None
        raise
    if backend == "auto" and not suits_opengl(ctx):
        ctx.release()
        return None
    return ctx


def _ranges(pane: Pane, key: RenderKey, channel: Channel) -> Ranges:
    """Values of the pane's channel that are drawn as 0 and as 1."""
    if channel.is_depth:
        return (depth_range(key.scene.gaussians, key.camera, key.clip),)
    return pane.ranges


# Without a graphics device.


class LastView:
    """Projection for the last render key, kept for as long as that is asked for."""

    def __init__(self, rasterizer: Rasterizer) -> None:
        self._rasterizer = rasterizer
        self._kept: tuple[RenderKey, View] | None = None

    def of(self, key: RenderKey) -> View:
        """Return the projected view of `key`, kept from the last call where it is equal."""
        if self._kept is None or self._kept[0] != key:
            self._kept = key, view_of(key.scene, key.camera, self._rasterizer, key.settings())
        return self._kept[1]

    def forget(self) -> None:
        self._kept = None


class ArrayChannels:
    """Channels by a rasterizer that returns arrays; the projection is kept while the camera rests."""

    def __init__(self, rasterizer: Rasterizer) -> None:
        self.views = LastView(rasterizer)

    def apart(self) -> "ArrayChannels":
        """Other ones, with the same projection to begin with: for another thread."""
        made = copy(self)
        made.views = copy(self.views)
        return made

    def render(self, key: RenderKey, wanted: Sequence[Channel] = ()) -> list[Channels]:
        """Rasterize, in one pass, for each of `wanted` the colours, alpha and that channel; colours and alpha
        where none is wanted."""
        gaussians, camera = key.scene.gaussians, key.camera
        wanted = wanted or [Channel()]
        columns = [camera_depths(gaussians, camera) if c.is_depth else c.values for c in wanted]
        present = [column for column in columns if column is not None]
        values = np.concatenate(present, 1) if len(present) > 1 else next(iter(present), None)
        drawn = splat_colours(self.views.of(key), gaussians, values)
        ends = np.cumsum([0 if column is None else column.shape[1] for column in columns])
        parts = np.split(drawn.values, ends[:-1], axis=2)
        return [
            Channels(drawn.colours, drawn.alpha, None if channel.is_absent else part)
            for channel, part in zip(wanted, parts, strict=True)
        ]

    def depth_at(self, key: RenderKey, column: int, row: int) -> tuple[float, float]:
        """Depth of the surface in a pixel (the median where the rasterizer knows it, else the mean, as where
        the scene is transparent there), world units, 0 where there is nothing, and alpha."""
        view = self.views.of(key)
        _, alpha = view.splat(np.empty((len(key.scene.gaussians), 0), np.float32))
        median = view.median_depth()[row, column]
        return float(median or view.depth()[row, column]), float(alpha[row, column])


class ArrayRenderer:
    """Draws requests with a rasterizer that returns arrays, and composes them on the CPU."""

    def __init__(self, rasterizer: Rasterizer) -> None:
        self._channels, self._inputs = ArrayChannels(rasterizer), Inputs()
        self._shows_nothing = False

    def read(self, request: RenderRequest) -> Array:
        """(H, W, 3) uint8 image, row 0 on top, (H, W, 4) of a transparent one."""
        key, wanted = self._inputs.key(request), self._inputs.channels(request)
        drawn = self._channels.render(key, wanted)
        self._shows_nothing = bool(drawn[0].alpha.max(initial=0) < VISIBLE_ALPHA)
        images = [
            compose(found, pane.picture, _ranges(pane, key, channel))
            for found, pane, channel in zip(drawn, request.panes, wanted, strict=True)
        ]
        return request.split.joined(images, request.width)

    def shows_nothing(self) -> bool:
        """True where the last image holds nothing of the scene."""
        return self._shows_nothing


# Channel layers: what is composed, from either rasterizer.


class GlSource:
    """Channel layers by the graphics pipeline."""

    def __init__(self, ctx: moderngl.Context, precision: Literal["half", "single"]) -> None:
        self._ctx, self._rasterizer = ctx, GlRasterizer(ctx, precision)
        self._views = LastView(self._rasterizer)
        self._uploads: dict[int, tuple[Array, moderngl.Texture]] = {}  # by the id of the array, which is held
        self._of: Scene | None = None  # whose Gaussians have them

    def _view(self, key: RenderKey) -> GlView:
        view = self._views.of(key)
        assert isinstance(view, GlView)
        return view

    def render(self, key: RenderKey, wanted: Sequence[Channel]) -> Layers:
        """Colours, then the layer of each channel (the colours' for an absent one), valid until the next
        call. At most three with values, none of them twice."""
        self._keep(wanted if key.scene is self._of else [])
        self._of, view = key.scene, self._view(key)
        uploads = [self._upload(view.gaussians, c.values) for c in wanted if c.values is not None]
        sources: list[Source] = ["colour", *uploads]
        images = self._rasterizer.draw(view, sources, with_depth=any(c.is_depth for c in wanted))
        colours, *layers = images[: len(sources)]
        valued = iter(layers)
        by_channel = (
            next(valued) if c.values is not None else images[-1] if c.is_depth else colours for c in wanted
        )
        return (colours, *by_channel)

    def ahead(self, key: RenderKey, wanted: Sequence[Channel]) -> Ahead | None:
        """Part of `render` that another thread can do, whatever is rendered here meanwhile; None: nothing."""
        return None  # the context is this thread's

    def _upload(self, gaussians: Gaussians, values: Array) -> moderngl.Texture:
        if id(values) not in self._uploads:
            with lap("upload", self._ctx.finish):
                texture = self._rasterizer.scene(gaussians).upload(values)
            self._uploads[id(values)] = values, texture
        return self._uploads[id(values)][1]

    def _keep(self, wanted: Sequence[Channel]) -> None:
        for key in set(self._uploads) - {id(channel.values) for channel in wanted}:
            self._uploads.pop(key)[1].release()

    def depth_at(self, key: RenderKey, column: int, row: int) -> tuple[float, float]:
        """Surface depth (world units, 0: nothing) and alpha of one pixel."""
        return self._view(key).depth_at(column, row)

    def depth_map(self, key: RenderKey) -> Array:
        """(H, W) surface depth, 0 where less than half the light is stopped. It ends `render`'s layers."""
        return self._view(key).median_depth()

    def forget(self) -> None:
        self._keep([])
        self._views.forget()
        self._rasterizer.forget()

    def release(self) -> None:
        self._keep([])
        self._rasterizer.release()


class ArraySource:
    """The same by a rasterizer that returns arrays: uploaded, but on a software driver left to `compose`,
    since such a driver takes longer to upload and compose than the rasterizer to draw."""

    def __init__(self, ctx: moderngl.Context, rasterizer: Rasterizer) -> None:
        self._ctx, self._uploads = ctx, not is_software(ctx)
        self._channels = ArrayChannels(rasterizer)
        self._textures: dict[tuple[int, int], moderngl.Texture] = {}  # by place and number of components

    def render(self, key: RenderKey, wanted: Sequence[Channel]) -> Layers:
        return self._layers(self._channels.render(key, wanted), wanted)

    def ahead(self, key: RenderKey, wanted: Sequence[Channel]) -> Ahead | None:
        channels = self._channels.apart()

        def work(report: Progress) -> Callable[[], Layers]:
            channels.views.of(key)
            report("", 0.5)  # ends here where nobody wants it any more
            drawn = channels.render(key, wanted)

            def finish() -> Layers:
                self._channels = channels
                return self._layers(drawn, wanted)

            return finish

        return work

    def _layers(self, drawn: Sequence[Channels], wanted: Sequence[Channel]) -> Layers:
        if not self._uploads:
            return (replace(drawn[0], extra=None), *drawn[: len(wanted)])
        with lap("upload", self._ctx.finish):
            return self._upload_all(drawn, wanted)

    def _upload_all(self, drawn: Sequence[Channels], wanted: Sequence[Channel]) -> Layers:
        colours = self._upload(0, 4, drawn[0].rgb, drawn[0].alpha)
        textures = [colours]
        for place, (channels, channel) in enumerate(zip(drawn, wanted, strict=False), 1):
            if channels.extra is None:
                textures.append(colours)
            else:
                components = 2 if channel.is_depth else 4
                textures.append(self._upload(place, components, channels.extra, channels.alpha))
        return tuple(textures)

    def _upload(self, place: int, components: int, image: Array, alpha: Array) -> moderngl.Texture:
        """(H, W, C) -> RGBA, or RG for depth, alpha last."""
        packed = np.zeros((*alpha.shape, components), np.float32)
        packed[..., : image.shape[2]] = image
        packed[..., -1] = alpha
        size, key = alpha.shape[::-1], (place, components)
        texture = self._textures.get(key)
        if texture is None or texture.size != size:
            if texture is not None:
                texture.release()
            texture = self._textures[key] = self._ctx.texture(size, components, dtype="f4")
            texture.repeat_x = texture.repeat_y = False
        texture.write(packed)
        return texture

    def depth_at(self, key: RenderKey, column: int, row: int) -> tuple[float, float]:
        return self._channels.depth_at(key, column, row)

    def depth_map(self, key: RenderKey) -> Array:
        return self._channels.views.of(key).median_depth()

    def forget(self) -> None:
        self._channels.views.forget()

    def release(self) -> None:
        for texture in self._textures.values():
            texture.release()
        self._textures.clear()


# The renderer on a graphics device.


@dataclass(frozen=True, eq=False)
class Rasterizing:
    """The part of a request that another thread can do. Equal where the same comes of it."""

    key: RenderKey
    channels: tuple[Channel, ...]  # beside the colours
    work: Ahead

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Rasterizing) and self.key == other.key and self._keys() == other._keys()

    def __hash__(self) -> int:
        return hash((self.key, self._keys()))

    def _keys(self) -> tuple[object, ...]:
        return tuple(channel.key for channel in self.channels)


@dataclass(frozen=True)
class Rasterized:
    """Result of a `Rasterizing`."""

    of: Rasterizing
    finish: Callable[[], Layers]  # what its work returned
    milliseconds: float
    laps: Mapping[str, float]  # see `langsplat_core.progress`


class GlRenderer:
    """Draws requests into framebuffers of one context, OpenGL 3.3 or newer.

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
        self._source: GlSource | ArraySource
        if backend == "opengl":
            self._source = GlSource(ctx, precision or ("single" if is_software(ctx) else "half"))
        else:
            self._source = ArraySource(ctx, load_rasterizer(backend))
        self._program = ctx.program(
            vertex_shader=shader("fullscreen.vert", "330 core"),
            fragment_shader=shader("compose.frag", "330 core", "langsplat_core.display", **shader_defines()),
        )
        self._vao = ctx.vertex_array(self._program, [])
        tables = np.stack(list(COLOUR_MAPS.values()))
        self._maps = ctx.texture((tables.shape[1], len(tables)), 3, tables.tobytes(), alignment=1)
        self._inputs = Inputs()
        self._held: RenderKey | None = None  # of the channels
        self._channels: Sequence[Channel] = ()  # those of `_layers` after the colours
        self._layers: Layers = ()
        self._own: moderngl.Framebuffer | None = None

    def forget(self) -> None:
        """Hold nothing of the last request: do every step of the next one anew."""
        self._drop()
        self._inputs.forget()
        self._source.forget()

    def _drop(self) -> None:
        self._held, self._channels = None, ()

    def draw(self, request: RenderRequest, targets: Sequence[moderngl.Framebuffer]) -> None:
        """Fill each pane's target, of the size of the request's camera, and leave the last one bound."""
        key, wanted = self._rasterized(request)
        for pane, channel, target in zip(request.panes, wanted, targets, strict=True):
            self._compose(pane, key, channel, target)

    def read(self, request: RenderRequest) -> Array:
        """(H, W, 3) uint8 image, row 0 on top, (H, W, 4) of a transparent one; leaves bound what was."""
        key, wanted = self._rasterized(request)
        size, components = (key.camera.width, key.camera.height), 4 if request.picture.transparent else 3
        if self._own is None or self._own.size != size:
            self._release_own()
            self._own = self._ctx.framebuffer([self._ctx.texture(size, 4)])
        before = self._ctx.fbo or self._ctx.detect_framebuffer(0)
        images = []
        try:
            for pane, channel in zip(request.panes, wanted, strict=True):
                self._compose(pane, key, channel, self._own)
                pixels = np.frombuffer(self._own.read(components=components, alignment=1), np.uint8)
                images.append(pixels.reshape(size[1], size[0], components)[::-1].copy())
        finally:
            before.use()
        return request.split.joined(images, request.width)

    def ahead(self, request: RenderRequest) -> Rasterizing | None:
        """The part of the request that another thread can do, whatever is drawn here meanwhile; None where
        that is nothing, or all of it is there."""
        key = self._inputs.key(request)
        missing = self._missing(key, self._inputs.channels(request))
        work = None if missing is None else self._source.ahead(key, missing)
        return None if missing is None or work is None else Rasterizing(key, tuple(missing), work)

    def take(self, made: Rasterized) -> None:
        """Take over what another thread rasterized, as if it had been rasterized here."""
        self._drop()
        self._layers = made.finish()
        self._held, self._channels = made.of.key, made.of.channels

    def _rasterized(self, request: RenderRequest) -> tuple[RenderKey, list[Channel]]:
        """Rasterize what is missing of the channels of all panes; return the key and the channels."""
        key, wanted = self._inputs.key(request), self._inputs.channels(request)
        missing = self._missing(key, wanted)
        if missing is not None:
            self._drop()
            self._layers = self._source.render(key, missing)
            self._held, self._channels = key, tuple(missing)
        return key, wanted

    def _missing(self, key: RenderKey, wanted: Sequence[Channel]) -> list[Channel] | None:
        """Channels to rasterize beside colours to have `wanted`; None where all of it is held."""
        held = {channel.key for channel in self._channels}
        needed = {channel.key: channel for channel in wanted if not channel.is_absent}
        return None if self._held == key and needed.keys() <= held else list(needed.values())

    def _layer_of(self, channel: Channel) -> Layer:
        """The one that holds a channel; the colours where it is absent."""
        places = (place for place, held in enumerate(self._channels, 1) if held.key == channel.key)
        return self._layers[next(places, 0)]

    def _compose(self, pane: Pane, key: RenderKey, channel: Channel, target: moderngl.Framebuffer) -> None:
        layer, ranges = self._layer_of(channel), _ranges(pane, key, channel)
        if isinstance(layer, Channels):
            (image,) = target.color_attachments
            assert isinstance(image, moderngl.Texture)
            with lap("compose", self._ctx.finish):
                image.write(compose_upwards(layer, pane.picture, ranges))
            target.use()
            return
        set_uniforms(self._program, _uniforms(pane, ranges, channel.is_absent))
        for unit, texture in enumerate((self._layers[0], layer, self._maps)):
            assert isinstance(texture, moderngl.Texture)
            texture.use(unit)
        with lap("compose", self._ctx.finish), drawing(self._ctx, target, moderngl.NOTHING):
            self._vao.render(moderngl.TRIANGLES, vertices=3)
        target.use()

    def shows_nothing(self) -> bool:
        """True where the last image, if there was one, holds nothing of the scene."""
        if self._held is None:
            return False
        colours = self._layers[0]
        if isinstance(colours, Channels):
            return bool(colours.alpha.max(initial=0) < VISIBLE_ALPHA)
        alpha = np.frombuffer(colours.read(), colours.dtype).reshape(-1, colours.components)[:, -1]
        return bool(alpha.max(initial=0) < VISIBLE_ALPHA)

    def depth_at(self, request: RenderRequest, x_px: float, y_px: float) -> float | None:
        """Camera z of the surface at a position in a pane (pixels of the camera that draws it), world units;
        None outside the pane and where alpha is small.

        The surface is where half the light is stopped, so that neither a floater in front nor a wall
        behind is picked; where the scene is more transparent than that, the mean depth.
        """
        key = self._inputs.key(request)
        if not (0 <= x_px < key.camera.width and 0 <= y_px < key.camera.height):
            return None
        depth, alpha = self._source.depth_at(key, int(x_px), int(y_px))
        return depth if alpha > PICK_ALPHA and depth > 0 else None

    def depth_map(self, request: RenderRequest) -> Array:
        """(H, W) camera z of the surface in a pane, world units, 0 where nothing stops half the light."""
        self._held = None  # the rasterizer draws, and its layers hold until then
        return self._source.depth_map(self._inputs.key(request))

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


def _uniforms(pane: Pane, ranges: Ranges, is_absent: bool) -> dict[str, object]:
    """Uniforms of the shader. Without its channel a display shows the plain colours."""
    picture = pane.picture
    return {
        "colours": 0,
        "extra": 1,
        "colour_maps": 2,
        "colour_map": list(COLOUR_MAPS).index(picture.colour_map),
        "transparent": picture.transparent,
        "display": int(drawing_of(picture.display, not is_absent)),
        "query_colours": QUERY_COLOURS.astype("f4").tobytes(),
        "ranges": full_ranges(ranges).astype("f4").tobytes(),
        "own_colours": picture.own_colours,
        "heat_opacity": picture.heat_opacity,
        "dim": picture.dim,
        "threshold": picture.threshold,
        "alpha_gate": picture.alpha_gate,
        "background": picture.background,
    }
