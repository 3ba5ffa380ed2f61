"""Channel textures: what the composite shader reads, from either rasterizer."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, Protocol

import moderngl
import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.config import PictureConfig
from langsplat_core.display.displays import Channels, HeatRanges
from langsplat_core.progress import Progress, lap
from langsplat_core.raster import Rasterizer
from langsplat_core.raster.opengl.rasterizer import GlRasterizer, GlView, Source
from langsplat_core.scene import Camera, Gaussians, Scene
from langsplat_viewer.drawing.channels import (
    ArrayChannels,
    Channel,
    Clip,
    LastView,
    Layers,
    Sight,
)

Textures = tuple[moderngl.Texture, ...]  # colours with alpha, then one for each channel that was wanted
Ahead = Callable[[Progress], Callable[[], Textures]]  # for any thread; what it returns: for the context's


class ChannelSource(Protocol):
    """Where channel textures come from."""

    def render(self, sight: Sight, wanted: Sequence[Channel]) -> Textures:
        """Colours, then the texture of each channel (the colours' for "none"), valid until the next call.
        At most three with values, none of them twice."""

    def ahead(self, sight: Sight, wanted: Sequence[Channel]) -> Ahead | None:
        """What of `render` another thread can do, whatever is rendered here meanwhile; None: nothing."""

    def depth_at(self, sight: Sight, column: int, row: int) -> tuple[float, float]:
        """Surface depth (world units, 0: nothing) and alpha of one pixel."""

    def depth_map(self, sight: Sight) -> Array:
        """(H, W) surface depth, 0 where less than half the light is stopped. It ends `render`'s textures."""

    def forget(self) -> None:
        """Do every step anew the next time."""

    def release(self) -> None:
        """Give the device memory back."""


class GlSource:
    """Channels by the graphics pipeline."""

    def __init__(self, ctx: moderngl.Context, precision: Literal["half", "single"]) -> None:
        self._ctx, self._rasterizer = ctx, GlRasterizer(ctx, precision)
        self._views = LastView(self._rasterizer)
        self._uploads: dict[int, tuple[Array, moderngl.Texture]] = {}  # by the id of the array, which is held
        self._of: Scene | None = None  # whose Gaussians have them

    def _view(self, sight: Sight) -> GlView:
        view = self._views.of(sight)
        assert isinstance(view, GlView)
        return view

    def render(self, sight: Sight, wanted: Sequence[Channel]) -> Textures:
        self._keep(wanted if sight.scene is self._of else [])
        self._of, view = sight.scene, self._view(sight)
        uploads = [self._upload(view.gaussians, c.values) for c in wanted if c.values is not None]
        sources: list[Source] = ["colour", *uploads]
        images = self._rasterizer.draw(view, sources, with_depth=any(c.extra == "depth" for c in wanted))
        colours, *layers = images[: len(sources)]
        valued = iter(layers)
        by_channel = (
            next(valued) if c.values is not None else images[-1] if c.extra == "depth" else colours
            for c in wanted
        )
        return (colours, *by_channel)

    def ahead(self, sight: Sight, wanted: Sequence[Channel]) -> Ahead | None:
        return None  # the context is this thread's

    def _upload(self, gaussians: Gaussians, values: Array) -> moderngl.Texture:
        if id(values) not in self._uploads:
            with lap("upload", self._ctx.finish):
                texture = self._rasterizer.scene(gaussians).upload(values)
            self._uploads[id(values)] = values, texture
        return self._uploads[id(values)][1]

    def _keep(self, wanted: Sequence[Channel]) -> None:
        """Release what was uploaded for other channels."""
        for key in set(self._uploads) - {id(channel.values) for channel in wanted}:
            self._uploads.pop(key)[1].release()

    def depth_at(self, sight: Sight, column: int, row: int) -> tuple[float, float]:
        return self._view(sight).depth_at(column, row)

    def depth_map(self, sight: Sight) -> Array:
        return self._view(sight).median_depth()

    def forget(self) -> None:
        self._keep([])
        self._views.forget()
        self._rasterizer.forget()

    def release(self) -> None:
        self._keep([])
        self._rasterizer.release()


class ArraySource:
    """Channels by a rasterizer that returns arrays, uploaded."""

    def __init__(self, ctx: moderngl.Context, rasterizer: Rasterizer) -> None:
        self._ctx = ctx
        self._channels = ArrayChannels(rasterizer)
        self._textures: dict[tuple[int, int], moderngl.Texture] = {}  # by place and number of components

    def render(self, sight: Sight, wanted: Sequence[Channel]) -> Textures:
        return self._uploaded(self._channels.render_all(sight, wanted or [Channel()]), len(wanted))

    def ahead(self, sight: Sight, wanted: Sequence[Channel]) -> Ahead | None:
        channels = self._channels.apart()

        def work(report: Progress) -> Callable[[], Textures]:
            channels.views.of(sight)
            report("", 0.5)  # ends here where nobody wants it any more
            drawn = channels.render_all(sight, wanted or [Channel()])

            def finish() -> Textures:
                self._channels = channels
                return self._uploaded(drawn, len(wanted))

            return finish

        return work

    def _uploaded(self, drawn: Sequence[Channels], wanted: int) -> Textures:
        with lap("upload", self._ctx.finish):
            return self._upload_all(drawn, wanted)

    def _upload_all(self, drawn: Sequence[Channels], wanted: int) -> Textures:
        colours = self._upload(0, 4, drawn[0].rgb, drawn[0].alpha)
        textures = [colours]
        for place, channels in enumerate(drawn[:wanted], 1):
            image = channels.latent if channels.latent is not None else channels.relevancies
            if channels.depth_sum is not None:
                textures.append(self._upload(place, 2, channels.depth_sum[..., None], channels.alpha))
            elif image is not None:
                textures.append(self._upload(place, 4, image, channels.alpha))
            else:
                textures.append(colours)
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

    def depth_at(self, sight: Sight, column: int, row: int) -> tuple[float, float]:
        return self._channels.depth_at(sight, column, row)

    def depth_map(self, sight: Sight) -> Array:
        return self._channels.views.of(sight).median_depth()

    def forget(self) -> None:
        self._channels.views.forget()

    def release(self) -> None:
        for texture in self._textures.values():
            texture.release()
        self._textures.clear()


# How coarse a picture has to be while the camera moves, learned from what pictures took.

MOVING_BUDGET = 50.0  # milliseconds: with the panels, some fifteen pictures a second
GUESS = 5e-4  # milliseconds of a fine picture for each Gaussian, before one was drawn
MERGED_SHARE = 0.25  # of a picture's time, guessed, when four Gaussians are drawn as one
FORGET = 0.8  # what was learned is lowered by this with every fine picture, so that better is tried again


@dataclass(frozen=True)
class Level:
    """One way to draw."""

    scale: float = 1.0  # of the window's resolution
    merged: bool = False  # see `langsplat_core.scene.gaussians`

    @property
    def guess(self) -> float:
        """Time, as a share of a fine picture's."""
        return self.scale**2 * (MERGED_SHARE if self.merged else 1)


FINE = Level()
PLAIN = (FINE, Level(0.5), Level(0.25))
# Merged at half the resolution is nearer to the fine picture than all of it at a quarter, and cheaper.
WITH_MERGED = (FINE, Level(0.5), Level(0.5, merged=True), Level(0.25, merged=True))


class Pace:
    """Times of pictures, in milliseconds."""

    def __init__(self) -> None:
        self._count = 1
        self._each = GUESS  # of a fine picture's time, for one Gaussian
        self._shares: dict[Level, float] = {}  # of the fine picture's time, measured

    def expect(self, count: int) -> None:
        """Pictures are of so many Gaussians from now on."""
        self._count = max(count, 1)

    @property
    def is_slow(self) -> bool:
        """Whether fine pictures are too slow to follow a movement."""
        return not self._is_within(FINE)

    def drew(self, level: Level, milliseconds: float) -> None:
        """A picture took so long."""
        if level == FINE:
            self._each = milliseconds / self._count
            self._shares = {other: FORGET * share for other, share in self._shares.items()}
        elif self._each > 0:
            self._shares[level] = (self._share(level) + milliseconds / (self._each * self._count)) / 2

    def level(self, has_merged: bool) -> Level:
        """The finest at which a picture is expected within the budget, or the coarsest of all."""
        levels = WITH_MERGED if has_merged else PLAIN
        return next(filter(self._is_within, levels), levels[-1])

    def stand_in(self) -> Level | None:
        """The finest of merged Gaussians that is expected within the budget, if there is one: all of them are
        projected for few pixels, too."""
        merged = (level for level in WITH_MERGED if level.merged)
        return next(filter(self._is_within, merged), None)

    def _is_within(self, level: Level) -> bool:
        return self._each * self._count * self._share(level) <= MOVING_BUDGET

    def _share(self, level: Level) -> float:
        return 1.0 if level == FINE else self._shares.get(level, level.guess)


# What draws the pictures, as the canvas sees it.


@dataclass(frozen=True, eq=False)
class Rasterizing:
    """What another thread can do of a picture. Equal where the same comes of it."""

    sight: Sight
    channels: tuple[Channel, ...]  # beside the colours
    work: Ahead

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Rasterizing) and self.sight == other.sight and self._keys() == other._keys()

    def __hash__(self) -> int:
        return hash((self.sight, self._keys()))

    def _keys(self) -> tuple[object, ...]:
        return tuple(channel.key for channel in self.channels)


@dataclass(frozen=True)
class Rasterized:
    """What came of it."""

    of: Rasterizing
    finish: Callable[[], Textures]  # what its work returned
    milliseconds: float
    laps: Mapping[str, float]  # see `langsplat_core.progress`


class Renderer(Protocol):
    """What `frame.FrameRenderer` offers."""

    backend: str

    def set_scene(self, scene: Scene) -> None:
        """Draw this scene from now on."""

    def set_clip(self, clip: Clip) -> None:
        """Draw what lies between other depths from now on."""

    def forget(self) -> None:
        """Do every step of the next picture anew."""

    def set_layers(self, latent_rgb: Array | None, relevancies: Array | None) -> None:
        """(N, 3) latent colours and (N, Q) relevancies, Q <= 3, of the scene's Gaussians."""

    def prepare(self, camera: Camera, pictures: Sequence[tuple[PictureConfig, Layers | None]]) -> None:
        """Rasterize at once what several pictures of one camera need."""

    def ahead(
        self, camera: Camera, pictures: Sequence[tuple[PictureConfig, Layers | None]]
    ) -> Rasterizing | None:
        """What of `prepare` another thread can do; None where nothing is left of it."""

    def take(self, made: Rasterized) -> None:
        """Have what came of that."""

    def draw(
        self,
        target: moderngl.Framebuffer,
        camera: Camera,
        picture: PictureConfig,
        heat_ranges: HeatRanges = (),
        layers: Layers | None = None,
    ) -> None:
        """Draw into `target`, which has the camera's size; with `layers` in place of those that are set."""

    def read(
        self,
        camera: Camera,
        picture: PictureConfig,
        heat_ranges: HeatRanges = (),
        layers: Layers | None = None,
    ) -> Array:
        """(H, W, 3) uint8 picture."""

    def shows_nothing(self) -> bool:
        """Whether the last picture holds nothing of the scene."""

    def depth_at(self, x_px: float, y_px: float) -> float | None:
        """Camera z of the surface at a pixel of the last picture, world units."""

    def depth_map(self) -> Array | None:
        """(H, W) the same at every pixel, 0 where there is none; None before the first picture."""
