"""What is seen: the one value by which everything rasterized is kept or made anew."""

from dataclasses import dataclass

from langsplat_core.config import RasterSettings
from langsplat_core.raster import Rasterizer, View
from langsplat_core.scene import Camera, Scene
from langsplat_viewer.drawing.looking import looking_settings
from langsplat_viewer.drawing.seeing import UNCLIPPED, Clip
from langsplat_viewer.parallel import eye_depth


@dataclass(frozen=True, eq=False)
class Sight:
    """All that a projection of Gaussians depends on. Equal for the same scene, as an object, cut alike, and
    cameras that give the same picture."""

    scene: Scene  # as it is drawn
    camera: Camera
    clip: Clip = UNCLIPPED

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Sight) and self.scene is other.scene and self._place() == other._place()

    def __hash__(self) -> int:
        return hash((id(self.scene), self._place()))

    def _place(self) -> tuple[object, ...]:
        plane = eye_depth(self.camera)
        return self.clip, plane, self.camera.intrinsics, self.camera.world_to_camera.tobytes()

    def settings(self) -> RasterSettings:
        """The image formation for it."""
        return looking_settings(self.scene, self.camera, self.clip)


class LastView:
    """The view of the last sight, for as long as that is asked for."""

    def __init__(self, rasterizer: Rasterizer) -> None:
        self._rasterizer = rasterizer
        self._kept: tuple[Sight, View] | None = None

    def of(self, sight: Sight) -> View:
        """The Gaussians projected."""
        if self._kept is None or self._kept[0] != sight:
            view = self._rasterizer.view(sight.scene.gaussians, sight.camera, sight.settings())
            self._kept = sight, view
        return self._kept[1]

    def forget(self) -> None:
        """Project anew the next time."""
        self._kept = None
