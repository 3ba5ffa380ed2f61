"""What draws the pictures, as the canvas sees it."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import moderngl

from langsplat_core.arrays import Array
from langsplat_core.config import PictureConfig
from langsplat_core.display.compose import HeatRanges
from langsplat_core.scene import Camera, Scene
from langsplat_viewer.drawing.channel_textures import Ahead, Textures
from langsplat_viewer.drawing.channels import Channel, Layers
from langsplat_viewer.drawing.seeing import Clip
from langsplat_viewer.drawing.sight import Sight


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
    laps: Mapping[str, float]  # see `langsplat_core.stopwatch`


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
