"""Channel textures: what the composite shader reads, from either rasterizer."""

from typing import Literal, Protocol

import moderngl
import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.display.displays import Extra
from langsplat_core.raster import Rasterizer
from langsplat_core.raster.opengl.rasterizer import GlRasterizer, GlView, Source
from langsplat_core.scene import Camera, Scene
from langsplat_viewer.channels import ArrayChannels, Layers, surface_depths
from langsplat_viewer.looking import looking_settings

Textures = tuple[moderngl.Texture, ...]  # colours with alpha and, if asked for, one further channel


class ChannelSource(Protocol):
    """Where channel textures come from."""

    def set_scene(self, scene: Scene) -> None:
        """Show another scene."""

    def set_layers(self, layers: Layers) -> None:
        """Show other layers of the same scene."""

    def render(self, camera: Camera, extra: Extra) -> Textures:
        """Channel textures, valid until the next call."""

    def depth_at(self, camera: Camera, column: int, row: int) -> tuple[float, float]:
        """Surface depth (world units, 0: nothing) and alpha of one pixel."""

    def depth_map(self, camera: Camera) -> Array:
        """(H, W) surface depth, 0 where less than half the light is stopped. It ends `render`'s textures."""

    def release(self) -> None:
        """Give the device memory back."""


class GlSource:
    """Channels by the graphics pipeline."""

    def __init__(self, ctx: moderngl.Context, precision: Literal["half", "single"]) -> None:
        self._rasterizer = GlRasterizer(ctx, precision)
        self._layers = Layers()
        self._uploads: dict[str, moderngl.Texture] = {}

    def set_scene(self, scene: Scene) -> None:
        self.set_layers(Layers())
        self._scene = scene

    def set_layers(self, layers: Layers) -> None:
        for texture in self._uploads.values():
            texture.release()
        self._uploads.clear()
        self._layers = layers

    def _view(self, camera: Camera) -> GlView:
        return self._rasterizer.view(self._scene.gaussians, camera, looking_settings(self._scene, camera))

    def render(self, camera: Camera, extra: Extra) -> Textures:
        sources: list[Source] = ["colour"]
        view = self._view(camera)
        values = self._layers.values(extra)
        if values is not None:
            if extra not in self._uploads:
                self._uploads[extra] = self._rasterizer.scene(self._scene.gaussians).upload(values)
            sources.append(self._uploads[extra])
        return self._rasterizer.draw(view, sources, with_depth=extra == "depth")

    def depth_at(self, camera: Camera, column: int, row: int) -> tuple[float, float]:
        return self._view(camera).depth_at(column, row)

    def depth_map(self, camera: Camera) -> Array:
        return surface_depths(self._view(camera), len(self._scene.gaussians))

    def release(self) -> None:
        self.set_layers(Layers())
        self._rasterizer.release()


class ArraySource:
    """Channels by a rasterizer that returns arrays, uploaded."""

    def __init__(self, ctx: moderngl.Context, rasterizer: Rasterizer) -> None:
        self._ctx = ctx
        self._channels = ArrayChannels(rasterizer)
        self._layers = Layers()
        self._textures: dict[str, moderngl.Texture] = {}

    def set_scene(self, scene: Scene) -> None:
        self._scene = scene
        self._layers = Layers()

    def set_layers(self, layers: Layers) -> None:
        self._layers = layers

    def render(self, camera: Camera, extra: Extra) -> Textures:
        channels = self._channels.render(self._scene, self._layers, camera, extra)
        images = {"colours": channels.rgb}
        if channels.depth_sum is not None:
            images["depth"] = channels.depth_sum[..., None]
        elif channels.latent is not None:
            images["extra"] = channels.latent
        elif channels.relevancies is not None:
            images["extra"] = channels.relevancies
        return tuple(self._upload(role, image, channels.alpha) for role, image in images.items())

    def _upload(self, role: str, image: Array, alpha: Array) -> moderngl.Texture:
        """(H, W, C) -> RGBA, or RG for depth, alpha last."""
        components = 2 if role == "depth" else 4
        packed = np.zeros((*alpha.shape, components), np.float32)
        packed[..., : image.shape[2]] = image
        packed[..., -1] = alpha
        size = alpha.shape[::-1]
        texture = self._textures.get(role)
        if texture is None or texture.size != size:
            if texture is not None:
                texture.release()
            texture = self._textures[role] = self._ctx.texture(size, components, dtype="f4")
            texture.repeat_x = texture.repeat_y = False
        texture.write(packed)
        return texture

    def depth_at(self, camera: Camera, column: int, row: int) -> tuple[float, float]:
        return self._channels.depth_at(self._scene, camera, column, row)

    def depth_map(self, camera: Camera) -> Array:
        return surface_depths(self._channels.view(self._scene, camera), len(self._scene.gaussians))

    def release(self) -> None:
        for texture in self._textures.values():
            texture.release()
        self._textures.clear()
