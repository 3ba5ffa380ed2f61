"""Renderers: a render request becomes an image. No window here.

An image is made in two steps. A rasterizer projects the Gaussians and splats layers: colours with alpha, and
the one further channel of each pane, all in one pass. Compositing turns the layers into pixels: with a
compiled kernel (`ArrayRenderer`), or on a graphics device with a shader (`GlRenderer`). Both keep projection
and layers while scene, camera and answers stay, so that moving a slider costs only the compositing.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, Generic, Literal, TypeVar, cast

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
from langsplat_core.progress import Progress
from langsplat_core.raster import Rasterizer, View, load_rasterizer
from langsplat_core.raster.opengl import shader
from langsplat_core.raster.opengl.rasterizer import (
    GlRasterizer,
    GlView,
    Source,
    create_egl_context,
    drawing,
    is_software,
    set_uniforms,
)
from langsplat_core.raster.render import splat_colours
from langsplat_core.scene import Scene
from langsplat_core.scene.gaussians import Merged
from langsplat_viewer.rendering.request import (
    VISIBLE_ALPHA,
    Pane,
    RenderRequest,
    Splats,
    image_formation,
    with_splats,
)

Backend = Literal["auto", "opengl", "cpu", "cuda"]
Channel = Array | Literal["depth"] | None  # of a pane: (N, 1 to 3) per Gaussian, camera z, or none
L = TypeVar("L", Channels, moderngl.Texture)  # a layer
# Fields of a `PictureConfig` that are uniforms of the shader.
AS_IN_PICTURE = ("transparent", "own_colours", "heat_opacity", "dim", "threshold", "alpha_gate", "background")
PICK_ALPHA = 0.1  # a pixel with less alpha shows nothing that could be picked


class Inputs:
    """Scenes and channels of requests as a rasterizer takes them.

    Those of the last scene, edits and answers are kept: the same channel is the same object.
    """

    def __init__(self) -> None:
        self._scene = lru_cache(maxsize=1)(_projected_scene)
        self._of: tuple[object, ...] = ()  # whose channels are kept
        self._channels: dict[tuple[object, ...], Channel] = {}

    def scene(self, request: RenderRequest) -> Scene:
        """Return the Gaussians that are projected, as a scene."""
        return self._scene(request.scene.scene, request.splats, request.merged)

    def channels(self, request: RenderRequest) -> list[Channel]:
        """Return the further channel of each pane, then that of what is selected."""
        if self._of != (request.scene, request.answers):
            self._of, self._channels = (request.scene, request.answers), {}
        found = []
        for pane in request.panes:
            key = pane.row.channel, pane.level, pane.picture.heat, request.merged
            if key not in self._channels:
                self._channels[key] = _channel(request, pane)
            found.append(self._channels[key])
        selected = "selected", request.merged
        if selected not in self._channels:
            self._channels[selected] = _merged(request, request.scene.selected)
        return [*found, self._channels[selected]]


def _projected_scene(scene: Scene, splats: Splats, merged: Merged | None) -> Scene:
    if merged is not None:
        scene = replace(scene, gaussians=merged.gaussians, language=None, extras={})
    return with_splats(scene, splats)


def _channel(request: RenderRequest, pane: Pane) -> Channel:
    make, source = pane.row.channel, request.scene.source
    if make is None or make == "depth":
        return make
    subject = Subject(len(source.gaussians), source.language, pane.answers, pane.level, pane.picture.heat)
    values = make(subject)
    return _merged(request, None if values is None else request.scene.values(values))


def _merged(request: RenderRequest, values: Array | None) -> Array | None:
    """Return values of the Gaussians that are drawn for those of the edited scene's."""
    return values if values is None or request.merged is None else request.merged.values(values)


@dataclass(frozen=True, eq=False)
class Layers(Generic[L]):
    """Images that were rasterized for a request."""

    projection: tuple[object, ...]  # the request's
    view: View
    channels: tuple[Channel, ...] = ()  # beside the colours
    images: tuple[L, ...] = ()  # colours with alpha, then one for each of `channels`; (): out of date

    def have(self, channels: Sequence[Channel]) -> bool:
        """Return whether all of `channels` are there, beside the colours."""
        held = {id(channel) for channel in self.channels}
        return bool(self.images) and all(channel is None or id(channel) in held for channel in channels)

    def of(self, channel: Channel) -> L:
        """Return the layer of a channel; the colours for none."""
        places = (place for place, held in enumerate(self.channels, 1) if held is channel)
        return self.images[next(places, 0)]


Ahead = tuple[object, Callable[[Progress], Layers[Any]]]  # a key, equal for equal layers, and the work


class Renderer(ABC, Generic[L]):
    """Draws requests; keeps what was rasterized for the last one."""

    def __init__(self, rasterizer: Rasterizer) -> None:
        self._rasterizer, self._inputs = rasterizer, Inputs()
        self.backend: str = rasterizer.name
        self._layers: Layers[L] | None = None  # of the last request

    @abstractmethod
    def draw(self, request: RenderRequest, targets: Sequence[moderngl.Texture]) -> None:
        """Fill each pane's RGBA8 target, of the size of the request's camera; row 0 at the bottom."""

    @abstractmethod
    def read(self, request: RenderRequest) -> Array:
        """Return the (H, W, 3) uint8 image, row 0 on top, (H, W, 4) of a transparent one."""

    @abstractmethod
    def _splat(self, view: View, scene: Scene, channels: tuple[Channel, ...]) -> tuple[L, ...]:
        """Return colours with alpha, then the layer of each channel: at most four, none of them twice."""

    @abstractmethod
    def _alpha(self, layer: L) -> Array:
        """Return the alpha of all pixels."""

    def ahead(self, request: RenderRequest) -> Ahead | None:
        """Return the part of the request that another thread can do, whatever is drawn here meanwhile.

        None where that is nothing, as on a graphics device, or where all of it is there.
        """
        return None

    def take(self, made: Layers[L]) -> None:
        """Take over what another thread rasterized, as if it had been rasterized here."""
        self._layers = made

    def forget(self) -> None:
        """Drop the layers that were rasterized for the last request."""
        self._layers = None

    def shows_nothing(self) -> bool:
        """Return whether the last image, if there was one, holds nothing of the scene."""
        if self._layers is None or not self._layers.images:
            return False
        return bool(self._alpha(self._layers.images[0]).max(initial=0) < VISIBLE_ALPHA)

    def depth_at(self, request: RenderRequest, x_px: float, y_px: float) -> float | None:
        """Return the camera z of the surface at a position in a pane, world units; None where there is none.

        `x_px` and `y_px` are pixels of the request's camera. The surface is where half the light is stopped,
        so that neither a floater in front nor a wall behind is picked; where the scene is more transparent
        than that, the mean depth. There is none outside the pane and where alpha is small.
        """
        if not (0 <= x_px < request.camera.width and 0 <= y_px < request.camera.height):
            return None
        depth, alpha = self._projected(request).view.depth_at(int(x_px), int(y_px))
        return depth if alpha > PICK_ALPHA and depth > 0 else None

    def depth_map(self, request: RenderRequest) -> Array:
        """Return the (H, W) camera z of the surface in a pane, 0 where nothing stops half the light."""
        layers = self._projected(request)
        self._layers = replace(layers, images=())  # a device draws: its images were overwritten
        return layers.view.median_depth()

    def release(self) -> None:
        """Give all device memory back; the renderer cannot be used afterwards."""

    def _projected(self, request: RenderRequest) -> Layers[L]:
        """Return the projection that the request needs, with the layers that there are, and keep it."""
        if self._layers is None or self._layers.projection != request.projection:
            self._layers = None
            view = _view(self._rasterizer, self._inputs.scene(request), request)
            self._layers = Layers(request.projection, view)
        return self._layers

    def _rasterized(self, request: RenderRequest) -> tuple[Layers[L], list[Channel]]:
        """Return the layers of all panes, their channels and that of the selection.

        What is missing of them is rasterized.
        """
        layers, wanted = self._projected(request), self._inputs.channels(request)
        if not layers.have(wanted):
            layers = self._layers = replace(layers, channels=_distinct(wanted), images=())
            images = self._splat(layers.view, self._inputs.scene(request), layers.channels)
            layers = self._layers = replace(layers, images=images)
        return layers, wanted


def _view(rasterizer: Rasterizer, scene: Scene, request: RenderRequest) -> View:
    settings = image_formation(scene, request.camera, request.clip)
    return rasterizer.view(scene.gaussians, request.camera, settings)


def _distinct(channels: Sequence[Channel]) -> tuple[Channel, ...]:
    return tuple({id(channel): channel for channel in channels if channel is not None}.values())


def _ranges(request: RenderRequest, pane: Pane) -> Ranges:
    """Return the values of the pane's channel that are drawn as 0 and as 1."""
    if pane.row.channel == "depth":
        return (request.depths or (0.0, 1.0),)
    return pane.ranges


def _depths(scene: Scene, view: View) -> Array:
    """Return (N, 1) float32 camera z, finite."""
    with np.errstate(invalid="ignore", over="ignore"):
        means, matrix = scene.gaussians.means.astype(np.float64), view.camera.world_to_camera
        return np.nan_to_num((means @ matrix[2, :3] + matrix[2, 3]).astype(np.float32))[:, None]


class ArrayRenderer(Renderer[Channels]):
    """Draws with a rasterizer that returns arrays, and composes them on the CPU. Reading needs no GL."""

    def draw(self, request: RenderRequest, targets: Sequence[moderngl.Texture]) -> None:
        for target, image in zip(targets, self._composed(request, compose_upwards), strict=True):
            target.write(image)

    def read(self, request: RenderRequest) -> Array:
        return request.split.joined(self._composed(request, compose), request.width)

    def _composed(self, request: RenderRequest, composer: Callable[..., Array]) -> list[Array]:
        layers, (*channels, selected) = self._rasterized(request)
        marked = None if selected is None else layers.of(selected).extra
        return [
            composer(replace(layers.of(channel), selected=marked), pane.picture, _ranges(request, pane))
            for pane, channel in zip(request.panes, channels, strict=True)
        ]

    def ahead(self, request: RenderRequest) -> Ahead | None:
        held, channels = self._layers, _distinct(self._inputs.channels(request))
        view = held.view if held is not None and held.projection == request.projection else None
        if held is not None and view is not None and held.have(channels):
            return None
        scene, rasterizer = self._inputs.scene(request), self._rasterizer

        def work(report: Progress) -> Layers[Channels]:
            made = view or _view(rasterizer, scene, request)
            report("", 0.5)  # ends here where nobody wants it any more
            return Layers(request.projection, made, channels, self._splat(made, scene, channels))

        return (request.projection, tuple(map(id, channels))), work

    def _splat(self, view: View, scene: Scene, channels: tuple[Channel, ...]) -> tuple[Channels, ...]:
        columns = [_depths(scene, view) if isinstance(c, str) else np.asarray(c) for c in channels]
        values = np.concatenate(columns, 1) if len(columns) > 1 else columns[0] if columns else None
        drawn = splat_colours(view, scene.gaussians, values)
        colours = Channels(drawn.colours, drawn.alpha)
        parts = np.split(drawn.values, np.cumsum([column.shape[1] for column in columns])[:-1], axis=2)
        return (colours, *(replace(colours, extra=part) for part in parts[: len(columns)]))

    def _alpha(self, layer: Channels) -> Array:
        return layer.alpha


class GlRenderer(Renderer[moderngl.Texture]):
    """Draws and composes on a graphics device, OpenGL 4.1 or newer. BackendError for an older driver."""

    def __init__(self, ctx: moderngl.Context, rasterizer: GlRasterizer | None = None) -> None:
        """`rasterizer` None has half precision; single on a software driver, which rounds halves to zero."""
        self._gl = rasterizer or GlRasterizer(ctx, "single" if is_software(ctx) else "half")
        super().__init__(self._gl)
        self._ctx = ctx
        self._program = ctx.program(
            vertex_shader=shader("fullscreen.vert", "330 core"),
            fragment_shader=shader("compose.frag", "330 core", "langsplat_core.display", **shader_defines()),
        )
        self._vao = ctx.vertex_array(self._program, [])
        tables = np.stack(list(COLOUR_MAPS.values()))
        self._maps = ctx.texture((tables.shape[1], len(tables)), 3, tables.tobytes(), alignment=1)
        self._uploads: dict[int, tuple[Array, moderngl.Texture]] = {}  # by the id of the array, which is held
        self._of: Scene | None = None  # whose Gaussians have them

    def draw(self, request: RenderRequest, targets: Sequence[moderngl.Texture]) -> None:
        layers, (*channels, selected) = self._rasterized(request)
        for pane, channel, texture in zip(request.panes, channels, targets, strict=True):
            self._compose(request, pane, layers, (channel, selected), texture)

    def read(self, request: RenderRequest) -> Array:
        camera, components = request.camera, 4 if request.picture.transparent else 3
        targets = [self._ctx.texture((camera.width, camera.height), 4) for _ in request.panes]
        try:
            self.draw(request, targets)
            pixels = [np.frombuffer(target.read(), np.uint8) for target in targets]
        finally:
            for target in targets:
                target.release()
        images = [part.reshape(camera.height, camera.width, 4)[::-1, :, :components] for part in pixels]
        return request.split.joined([image.copy() for image in images], request.width)

    def _splat(self, view: View, scene: Scene, channels: tuple[Channel, ...]) -> tuple[moderngl.Texture, ...]:
        valued = [channel for channel in channels if isinstance(channel, np.ndarray)]
        self._keep(valued if scene is self._of else [])
        self._of = scene
        textures = self._gl.scene(scene.gaussians)
        for values in valued:
            if id(values) not in self._uploads:
                self._uploads[id(values)] = values, textures.upload(values)
        sources: list[Source] = ["colour", *(self._uploads[id(values)][1] for values in valued)]
        images = self._gl.draw(cast(GlView, view), sources, with_depth="depth" in map(str, channels))
        colours, layers = images[0], iter(images[1:])
        return (colours, *(images[-1] if isinstance(channel, str) else next(layers) for channel in channels))

    def _keep(self, wanted: Sequence[Array]) -> None:
        for key in set(self._uploads) - {id(values) for values in wanted}:
            self._uploads.pop(key)[1].release()

    def _compose(
        self,
        request: RenderRequest,
        pane: Pane,
        layers: Layers[moderngl.Texture],
        channels: tuple[Channel, Channel],  # the pane's, and that of the selection
        texture: moderngl.Texture,
    ) -> None:
        picture, (channel, selected) = pane.picture, channels
        uniforms: dict[str, object] = {
            "colours": 0,
            "extra": 1,
            "colour_maps": 2,
            "selection": 3,
            "has_selection": selected is not None,
            "colour_map": list(COLOUR_MAPS).index(picture.colour_map),
            "display": int(drawing_of(picture.display, channel is not None)),
            "query_colours": QUERY_COLOURS.astype("f4").tobytes(),
            "ranges": full_ranges(_ranges(request, pane)).astype("f4").tobytes(),
            **{name: getattr(picture, name) for name in AS_IN_PICTURE},
        }
        set_uniforms(self._program, uniforms)
        sources = layers.images[0], layers.of(channel), self._maps, layers.of(selected)
        for unit, source in enumerate(sources):
            source.use(unit)
        target = self._ctx.framebuffer([texture])
        with drawing(self._ctx, target, moderngl.NOTHING):
            self._vao.render(moderngl.TRIANGLES, vertices=3)
        target.release()

    def _alpha(self, layer: moderngl.Texture) -> Array:
        return np.frombuffer(layer.read(), layer.dtype).reshape(-1, layer.components)[:, -1]

    def release(self) -> None:
        self._keep([])
        self._gl.release()
        self._vao.release()
        self._program.release()
        self._maps.release()


# The choice of renderer.


def suits_opengl(ctx: moderngl.Context) -> bool:
    """Return whether backend "auto" is "opengl": on drivers from 4.1 that do not draw on the CPU.

    There the compiled CPU rasterizer is several times faster.
    """
    return ctx.version_code >= 410 and not is_software(ctx)


def renderer_for(ctx: moderngl.Context | None, backend: Backend = "auto") -> Renderer[Any]:
    """Return the renderer of a backend; "auto" is "opengl" or "cpu". Raises BackendError."""
    if backend == "auto":
        backend = "opengl" if ctx is not None and suits_opengl(ctx) else "cpu"
    if backend == "opengl" and ctx is not None:
        return GlRenderer(ctx)
    return ArrayRenderer(load_rasterizer(backend))


@contextmanager
def open_renderer(backend: Backend = "auto") -> Iterator[Renderer[Any]]:
    """Open a renderer without a window, on this thread.

    Backends "cpu" and "cuda" touch no GL at all; "auto" takes "cpu" where GL is absent or software.
    Raises BackendError where the backend cannot work.
    """
    ctx = None
    if backend in ("auto", "opengl"):
        try:
            ctx = create_egl_context()
        except BackendError:
            if backend == "opengl":
                raise
    try:
        yield renderer_for(ctx, backend)
    finally:
        if ctx is not None:
            ctx.release()
