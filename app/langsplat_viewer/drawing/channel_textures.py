"""Channel textures: what the composite shader reads, from either rasterizer."""

from collections.abc import Callable, Sequence
from typing import Literal, Protocol

import moderngl
import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.display.compose import Channels
from langsplat_core.progress import Progress
from langsplat_core.raster import Rasterizer
from langsplat_core.raster.opengl.rasterizer import GlRasterizer, GlView, Source
from langsplat_core.scene import Gaussians, Scene
from langsplat_core.stopwatch import lap
from langsplat_viewer.drawing.channels import ArrayChannels, Channel, surface_depths
from langsplat_viewer.drawing.sight import LastView, Sight

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
        return surface_depths(self._view(sight), len(sight.scene.gaussians))

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
        return surface_depths(self._channels.views.of(sight), len(sight.scene.gaussians))

    def forget(self) -> None:
        self._channels.views.forget()

    def release(self) -> None:
        for texture in self._textures.values():
            texture.release()
        self._textures.clear()
