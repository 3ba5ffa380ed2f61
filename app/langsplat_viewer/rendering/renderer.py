"""Renderers: a render request becomes an image. No window here.

An image is made in two steps. A rasterizer projects the Gaussians and splats layers: colours with alpha, and
the one further channel of each pane, all in one pass. Compositing turns the layers into pixels: with a
compiled kernel, or on a graphics device with a shader. `GlRenderer` keeps the layers while scene, camera and
answers stay, so that moving a slider costs only the compositing.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
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
    Subject,
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
from langsplat_core.scene import Scene
from langsplat_viewer.rendering.request import (
    VISIBLE_ALPHA,
    Pane,
    RenderRequest,
    depth_range,
    image_formation,
    with_splats,
)

Backend = Literal["auto", "opengl", "cpu", "cuda"]
Channel = Array | Literal["depth"] | None  # of a pane: (N, 1 to 3) per Gaussian, camera z, or none
Layer = moderngl.Texture | Channels  # what a pane is composed of, by the shader or by `compose`
PICK_ALPHA = 0.1  # a pixel with less alpha shows nothing that could be picked


# What both renderers do.


class Inputs:
    """Scenes and channels of requests as a rasterizer takes them.

    Those of the last scene, edits and answers are kept: the same channel is the same object.
    """

    def __init__(self) -> None:
        self._scene: tuple[tuple[object, ...], Scene] | None = None
        self._of: tuple[object, ...] = ()  # whose channels are kept
        self._channels: dict[tuple[object, ...], Channel] = {}

    def scene(self, request: RenderRequest) -> Scene:
        """Return the Gaussians that are projected, as a scene."""
        of = (request.scene, request.splats, request.merged)
        if self._scene is None or self._scene[0] != of:
            scene = request.scene.scene
            if request.merged is not None:
                scene = replace(scene, gaussians=request.merged.gaussians, language=None, extras={})
            self._scene = of, with_splats(scene, request.splats)
        return self._scene[1]

    def channels(self, request: RenderRequest) -> list[Channel]:
        """Return the further channel of each pane."""
        if self._of != (request.scene, request.answers):
            self._of, self._channels = (request.scene, request.answers), {}
        wanted = [(pane, (pane.row.channel, pane.level, request.merged)) for pane in request.panes]
        for pane, key in wanted:
            if key not in self._channels:
                self._channels[key] = _channel(request, pane)
        return [self._channels[key] for _, key in wanted]

    def forget(self) -> None:
        """Hold nothing."""
        self._scene, self._of, self._channels = None, (), {}


def _channel(request: RenderRequest, pane: Pane) -> Channel:
    make, source = pane.row.channel, request.scene.source
    if make is None or make == "depth":
        return make
    values = make(Subject(len(source.gaussians), source.language, pane.answers, pane.level))
    if values is None:
        return None
    values = request.scene.values(values, pane.row.is_colour)
    return values if request.merged is None else request.merged.values(values)


def splat_channels(view: View, scene: Scene, channels: Sequence[Channel]) -> list[Channels]:
    """Splat, in one pass, colours and alpha with each of `channels`; where there are none, with nothing."""
    means, camera, columns = scene.gaussians.means, view.camera, []
    for channel in channels or [None]:
        if isinstance(channel, str):
            with np.errstate(invalid="ignore", over="ignore"):
                depths = means.astype(np.float64) @ camera.rotation[2] + camera.world_to_camera[2, 3]
                columns.append(np.nan_to_num(depths.astype(np.float32))[:, None])
        else:
            columns.append(np.empty((len(means), 0), np.float32) if channel is None else channel)
    values = np.concatenate(columns, 1) if len(columns) > 1 else columns[0]
    drawn = splat_colours(view, scene.gaussians, values if values.shape[1] else None)
    parts = np.split(drawn.values, np.cumsum([column.shape[1] for column in columns])[:-1], axis=2)
    return [Channels(drawn.colours, drawn.alpha, part if part.shape[2] else None) for part in parts]


def _projected(rasterizer: Rasterizer, scene: Scene, request: RenderRequest) -> View:
    settings = image_formation(scene, request.camera, request.clip)
    return view_of(scene, request.camera, rasterizer, settings)


def _ranges(request: RenderRequest, pane: Pane) -> Ranges:
    """Return the values of the pane's channel that are drawn as 0 and as 1."""
    if pane.row.channel == "depth":
        return (depth_range(request.gaussians, request.camera, request.clip),)
    return pane.ranges


# Without a graphics device.


class ArrayRenderer:
    """Draws requests with a rasterizer that returns arrays, and composes them on the CPU."""

    def __init__(self, rasterizer: Rasterizer) -> None:
        self._rasterizer, self._inputs = rasterizer, Inputs()
        self._shows_nothing = False

    def read(self, request: RenderRequest) -> Array:
        """Return the (H, W, 3) uint8 image, row 0 on top, (H, W, 4) of a transparent one."""
        scene = self._inputs.scene(request)
        view = _projected(self._rasterizer, scene, request)
        drawn = splat_channels(view, scene, self._inputs.channels(request))
        self._shows_nothing = bool(drawn[0].alpha.max(initial=0) < VISIBLE_ALPHA)
        images = [
            compose(channels, pane.picture, _ranges(request, pane))
            for channels, pane in zip(drawn, request.panes, strict=True)
        ]
        return request.split.joined(images, request.width)

    def shows_nothing(self) -> bool:
        """Return whether the last image holds nothing of the scene."""
        return self._shows_nothing


@contextmanager
def open_renderer(backend: Backend = "auto") -> Iterator["ArrayRenderer | GlRenderer"]:
    """Open a renderer without a window, on this thread.

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
    """Return the (H, W, 3) uint8 image, row 0 on top, (H, W, 4) of a transparent one; see `open_renderer`."""
    with open_renderer(backend) as renderer:
        return renderer.read(request)


def suits_opengl(ctx: moderngl.Context) -> bool:
    """Return whether backend "auto" is "opengl": on drivers from 4.1 that do not draw on the CPU.

    There the compiled CPU rasterizer is several times faster.
    """
    return ctx.version_code >= 410 and not is_software(ctx)


def _context_for(backend: Backend) -> moderngl.Context | None:
    """Return a context to draw with; None where the backend needs none."""
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


# On a graphics device: layers as textures, from either kind of rasterizer.


class DeviceLayers:
    """Layers by the graphics pipeline, which holds them until its next pass."""

    def __init__(self, ctx: moderngl.Context, precision: Literal["half", "single"]) -> None:
        self.rasterizer = GlRasterizer(ctx, precision)
        self._ctx = ctx
        self._uploads: dict[int, tuple[Array, moderngl.Texture]] = {}  # by the id of the array, which is held
        self._of: Scene | None = None  # whose Gaussians have them

    def rasterize(self, view: View, scene: Scene, channels: Sequence[Channel]) -> tuple[Layer, ...]:
        """Return colours, then the layer of each channel: at most three with values, none of them twice."""
        assert isinstance(view, GlView)
        valued = [channel for channel in channels if isinstance(channel, np.ndarray)]
        self._keep(valued if scene is self._of else [])
        self._of = scene
        sources: list[Source] = ["colour", *(self._upload(view, values) for values in valued)]
        images = self.rasterizer.draw(view, sources, with_depth=any(isinstance(c, str) for c in channels))
        colours, layers = images[0], iter(images[1:])
        return (colours, *(images[-1] if isinstance(channel, str) else next(layers) for channel in channels))

    def _upload(self, view: GlView, values: Array) -> moderngl.Texture:
        if id(values) not in self._uploads:
            with lap("upload", self._ctx.finish):
                texture = self.rasterizer.scene(view.gaussians).upload(values)
            self._uploads[id(values)] = values, texture
        return self._uploads[id(values)][1]

    def _keep(self, wanted: Sequence[Array]) -> None:
        for key in set(self._uploads) - {id(values) for values in wanted}:
            self._uploads.pop(key)[1].release()

    def forget(self) -> None:
        """Have everything uploaded and projected anew."""
        self._keep([])
        self.rasterizer.forget()

    def release(self) -> None:
        """Give all device memory back."""
        self._keep([])
        self.rasterizer.release()


class UploadedLayers:
    """Layers by a rasterizer that returns arrays.

    On a software driver they are not uploaded but left to `compose`: such a driver takes longer to upload
    and compose than the rasterizer to draw.
    """

    def __init__(self, ctx: moderngl.Context, rasterizer: Rasterizer, uploads: bool | None = None) -> None:
        """Take `uploads` None as what suits the driver."""
        self.rasterizer = rasterizer
        self._ctx, self._uploads = ctx, not is_software(ctx) if uploads is None else uploads
        self._textures: dict[tuple[int, int], moderngl.Texture] = {}  # by place and number of components

    def rasterize(self, view: View, scene: Scene, channels: Sequence[Channel]) -> tuple[Layer, ...]:
        """Return colours, then the layer of each channel."""
        return self.uploaded(splat_channels(view, scene, channels), channels)

    def uploaded(self, drawn: Sequence[Channels], channels: Sequence[Channel]) -> tuple[Layer, ...]:
        """Return the layers of what `splat_channels` made."""
        layers = [replace(drawn[0], extra=None), *drawn[: len(channels)]]
        if not self._uploads:
            return tuple(layers)
        with lap("upload", self._ctx.finish):
            return tuple(map(self._upload, range(len(layers)), layers, (None, *channels)))

    def _upload(self, place: int, layer: Channels, channel: Channel) -> moderngl.Texture:
        """Return a texture as the shader takes it, alpha last: RG for depth, else RGBA."""
        values, components = layer.rgb if layer.extra is None else layer.extra, 4
        if isinstance(channel, str):
            components = 2
        packed = np.zeros((*layer.alpha.shape, components), np.float32)
        packed[..., : values.shape[2]] = values
        packed[..., -1] = layer.alpha
        size, key = layer.alpha.shape[::-1], (place, components)
        texture = self._textures.get(key)
        if texture is None or texture.size != size:
            if texture is not None:
                texture.release()
            texture = self._textures[key] = self._ctx.texture(size, components, dtype="f4")
            texture.repeat_x = texture.repeat_y = False
        texture.write(packed)
        return texture

    def forget(self) -> None:
        """Nothing is kept."""

    def release(self) -> None:
        """Give all device memory back."""
        for texture in self._textures.values():
            texture.release()
        self._textures.clear()


@dataclass(frozen=True, eq=False)
class Layers:
    """What was rasterized for a request."""

    projection: tuple[object, ...]  # the request's
    view: View
    channels: tuple[Channel, ...] = ()  # beside the colours
    images: tuple[Layer, ...] = ()  # colours with alpha, then one for each of `channels`; (): out of date

    def have(self, channels: Sequence[Channel]) -> bool:
        """Return whether all of `channels` are there, beside the colours."""
        held = {id(channel) for channel in self.channels}
        return bool(self.images) and all(channel is None or id(channel) in held for channel in channels)

    def of(self, channel: Channel) -> Layer:
        """Return the layer of a channel; the colours for none."""
        places = (place for place, held in enumerate(self.channels, 1) if held is channel)
        return self.images[next(places, 0)]


Ahead = tuple[object, Callable[[Progress], Layers]]  # a key, equal where the same comes of it, and the work


class GlRenderer:
    """Draws requests into framebuffers of one context, OpenGL 3.3 or newer.

    `backend`: a rasterizer that returns arrays, or the name of one; "auto" is "opengl" or "cpu", see
    `suits_opengl`. The attribute of that name says which it became. `precision` is that of the OpenGL
    rasterizer's images; None is half, but single on a software driver, which is faster with it and rounds
    half precision towards zero. `uploads`: see `UploadedLayers`. Raises BackendError where a rasterizer
    cannot load.
    """

    def __init__(
        self,
        ctx: moderngl.Context,
        backend: Backend | Rasterizer = "auto",
        precision: Literal["half", "single"] | None = None,
        uploads: bool | None = None,
    ) -> None:
        if backend == "auto":
            backend = "opengl" if suits_opengl(ctx) else "cpu"
        self._ctx = ctx
        self._source: DeviceLayers | UploadedLayers
        if backend == "opengl":
            self._source = DeviceLayers(ctx, precision or ("single" if is_software(ctx) else "half"))
        else:
            rasterizer = load_rasterizer(backend) if isinstance(backend, str) else backend
            self._source = UploadedLayers(ctx, rasterizer, uploads)
        self.backend: str = self._source.rasterizer.name
        self._program = ctx.program(
            vertex_shader=shader("fullscreen.vert", "330 core"),
            fragment_shader=shader("compose.frag", "330 core", "langsplat_core.display", **shader_defines()),
        )
        self._vao = ctx.vertex_array(self._program, [])
        tables = np.stack(list(COLOUR_MAPS.values()))
        self._maps = ctx.texture((tables.shape[1], len(tables)), 3, tables.tobytes(), alignment=1)
        self._inputs = Inputs()
        self._layers: Layers | None = None  # of the last request
        self._own: moderngl.Framebuffer | None = None  # that images are read from

    def forget(self) -> None:
        """Hold nothing of the last request: do every step of the next one anew."""
        self._layers = None
        self._inputs.forget()
        self._source.forget()

    def draw(self, request: RenderRequest, targets: Sequence[moderngl.Framebuffer]) -> None:
        """Fill each pane's target, of the size of the request's camera, and leave the last one bound."""
        layers, channels = self._rasterized(request), self._inputs.channels(request)
        for pane, channel, target in zip(request.panes, channels, targets, strict=True):
            self._compose(request, pane, layers, channel, target)

    def read(self, request: RenderRequest) -> Array:
        """Return the (H, W, 3) uint8 image, row 0 on top, (H, W, 4) of a transparent one."""
        layers, size = self._rasterized(request), (request.camera.width, request.camera.height)
        components = 4 if request.picture.transparent else 3
        if self._own is None or self._own.size != size:
            self._release_own()
            self._own = self._ctx.framebuffer([self._ctx.texture(size, 4)])
        before = self._ctx.fbo or self._ctx.detect_framebuffer(0)
        images = []
        try:
            for pane, channel in zip(request.panes, self._inputs.channels(request), strict=True):
                self._compose(request, pane, layers, channel, self._own)
                pixels = np.frombuffer(self._own.read(components=components, alignment=1), np.uint8)
                images.append(pixels.reshape(size[1], size[0], components)[::-1].copy())
        finally:
            before.use()
        return request.split.joined(images, request.width)

    def ahead(self, request: RenderRequest) -> Ahead | None:
        """Return the part of the request that another thread can do, whatever is drawn here meanwhile.

        None where that is nothing, as on a graphics device, or where all of it is there.
        """
        channels = self._missing(request)
        if channels is None or isinstance(self._source, DeviceLayers):
            return None
        scene, rasterizer, held = self._inputs.scene(request), self._source.rasterizer, self._view(request)

        def work(report: Progress) -> Layers:
            view = held or _projected(rasterizer, scene, request)
            report("", 0.5)  # ends here where nobody wants it any more
            drawn = splat_channels(view, scene, channels)
            return Layers(request.projection, view, channels, tuple(drawn))

        return (request.projection, tuple(map(id, channels))), work

    def take(self, made: Layers) -> None:
        """Take over what another thread rasterized, as if it had been rasterized here."""
        assert isinstance(self._source, UploadedLayers)
        drawn = [layer for layer in made.images if isinstance(layer, Channels)]
        self._layers = replace(made, images=self._source.uploaded(drawn, made.channels))

    def _view(self, request: RenderRequest) -> View | None:
        """Return the projection that the request needs, if it is there."""
        is_held = self._layers is not None and self._layers.projection == request.projection
        return self._layers.view if self._layers is not None and is_held else None

    def _missing(self, request: RenderRequest) -> tuple[Channel, ...] | None:
        """Return the channels to rasterize beside colours; None where all that is needed is there."""
        wanted = self._inputs.channels(request)
        if self._view(request) is not None and self._layers is not None and self._layers.have(wanted):
            return None
        return tuple({id(channel): channel for channel in wanted if channel is not None}.values())

    def _rasterized(self, request: RenderRequest) -> Layers:
        """Return the layers of all panes; what is missing of them is rasterized."""
        channels = self._missing(request)
        if self._layers is None or channels is not None:
            channels, view = channels or (), self._projected(request)
            self._layers = Layers(request.projection, view)  # also where rasterizing fails
            images = self._source.rasterize(view, self._inputs.scene(request), channels)
            self._layers = Layers(request.projection, view, channels, images)
        return self._layers

    def _compose(
        self,
        request: RenderRequest,
        pane: Pane,
        layers: Layers,
        channel: Channel,
        target: moderngl.Framebuffer,
    ) -> None:
        layer, ranges, picture = layers.of(channel), _ranges(request, pane), pane.picture
        if isinstance(layer, Channels):
            (image,) = target.color_attachments
            assert isinstance(image, moderngl.Texture)
            with lap("compose", self._ctx.finish):
                image.write(compose_upwards(layer, picture, ranges))
            target.use()
            return
        uniforms: dict[str, object] = {
            "colours": 0,
            "extra": 1,
            "colour_maps": 2,
            "colour_map": list(COLOUR_MAPS).index(picture.colour_map),
            "transparent": picture.transparent,
            "display": int(drawing_of(picture.display, channel is not None)),
            "query_colours": QUERY_COLOURS.astype("f4").tobytes(),
            "ranges": full_ranges(ranges).astype("f4").tobytes(),
            "own_colours": picture.own_colours,
            "heat_opacity": picture.heat_opacity,
            "dim": picture.dim,
            "threshold": picture.threshold,
            "alpha_gate": picture.alpha_gate,
            "background": picture.background,
        }
        set_uniforms(self._program, uniforms)
        for unit, texture in enumerate((layers.images[0], layer, self._maps)):
            assert isinstance(texture, moderngl.Texture)
            texture.use(unit)
        with lap("compose", self._ctx.finish), drawing(self._ctx, target, moderngl.NOTHING):
            self._vao.render(moderngl.TRIANGLES, vertices=3)
        target.use()

    def shows_nothing(self) -> bool:
        """Return whether the last image, if there was one, holds nothing of the scene."""
        if self._layers is None or not self._layers.images:
            return False
        colours = self._layers.images[0]
        if isinstance(colours, Channels):
            return bool(colours.alpha.max(initial=0) < VISIBLE_ALPHA)
        alpha = np.frombuffer(colours.read(), colours.dtype).reshape(-1, colours.components)[:, -1]
        return bool(alpha.max(initial=0) < VISIBLE_ALPHA)

    def depth_at(self, request: RenderRequest, x_px: float, y_px: float) -> float | None:
        """Return the camera z of the surface at a position in a pane, world units; None where there is none.

        `x_px` and `y_px` are pixels of the request's camera. The surface is where half the light is stopped,
        so that neither a floater in front nor a wall behind is picked; where the scene is more transparent
        than that, the mean depth. There is none outside the pane and where alpha is small.
        """
        if not (0 <= x_px < request.camera.width and 0 <= y_px < request.camera.height):
            return None
        depth, alpha = self._projected(request).depth_at(int(x_px), int(y_px))
        return depth if alpha > PICK_ALPHA and depth > 0 else None

    def depth_map(self, request: RenderRequest) -> Array:
        """Return the (H, W) camera z of the surface in a pane, 0 where nothing stops half the light."""
        view = self._projected(request)
        self._layers = Layers(request.projection, view)  # the rasterizer draws: its images are others now
        return view.median_depth()

    def _projected(self, request: RenderRequest) -> View:
        """Return the projection that the request needs, and keep it."""
        view = self._view(request)
        if view is None:
            self._layers = None
            view = _projected(self._source.rasterizer, self._inputs.scene(request), request)
            self._layers = Layers(request.projection, view)
        return view

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
