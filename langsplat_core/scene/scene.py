"""A scene: Gaussians, perhaps a language field, perhaps the cameras it was trained from."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from langsplat_core.arrays import Array, across, unit
from langsplat_core.config import INRIA, RasterSettings
from langsplat_core.scene.camera import Camera, look_at
from langsplat_core.scene.gaussians import Gaussians
from langsplat_core.scene.language import LanguageField

# The opening view of a scene without cameras is from where it covers the most of a grid; lengths in radii.
SAMPLES, TURNS, REACH, CELL = 20_000, 12, 3.0, 0.06
WIDEST = 0.2  # of an image's width: shorter focal lengths, 136 degrees, are of no lens
MORE = 1.25  # how many times as much another side has to cover, to be better


@dataclass(frozen=True, eq=False)
class Scene:
    """Gaussians with all that is known of them: `load_scene` returns one, renderers and queries take one."""

    gaussians: Gaussians
    language: LanguageField | None = None
    cameras: tuple[Camera, ...] = ()  # training cameras, in the dataset's order
    path: Path | None = None
    antialiased: bool = False  # trained with Mip-Splatting's compensation, as its file says
    extras: Mapping[str, Array] = field(default_factory=dict)  # (N,) properties not read here
    metres_per_unit: float | None = None  # > 0; None: nobody said how long a world unit is
    unread: tuple[str, ...] = ()  # why files that lie beside it could not be read, a line each

    def __post_init__(self) -> None:
        if self.metres_per_unit is not None and not 0 < self.metres_per_unit < np.inf:
            raise ValueError(f"metres_per_unit of {self.metres_per_unit}: must be above 0 and finite")
        for name, values in self.extras.items():
            if values.shape != (len(self.gaussians),):
                raise ValueError(f"extras[{name!r}] of shape {values.shape}, not ({len(self.gaussians)},)")
        if self.language is not None and len(self.language) != len(self.gaussians):
            raise ValueError(
                f"language field of {len(self.language)} Gaussians on a scene of {len(self.gaussians)}"
            )

    def take(self, rows: Array) -> "Scene":
        """Return the scene of the Gaussians at `rows` (indices or a boolean mask), without a path."""
        return replace(
            self,
            gaussians=self.gaussians.take(rows),
            language=None if self.language is None else self.language.take(rows),
            extras={name: values[rows] for name, values in self.extras.items()},
            path=None,
        )

    def raster_settings(self, profile: RasterSettings = INRIA) -> RasterSettings:
        """`profile` with the antialiasing and the focal length that this scene was trained with."""
        return replace(profile, antialiased=self.antialiased, focal=self._focal)

    @cached_property
    def _focal(self) -> float | None:
        """Median focal length of the cameras, px.

        None without cameras, and where it is one of no lens, as in files that state it in other units.
        """
        lengths = [
            (np.sqrt(camera.fx * camera.fy), camera.width)
            for camera in self.cameras
            if not camera.orthographic
        ]
        focal, width = np.median(lengths, axis=0) if lengths else (0.0, 1.0)
        return float(focal) if focal > WIDEST * width else None

    def up(self) -> Array:
        """(3,) the world's up direction: the mean of the cameras' up axes, else -y as COLMAP has it."""
        if self.cameras:
            mean = -np.mean([camera.rotation[1] for camera in self.cameras], axis=0)
            if np.linalg.norm(mean) > 0.2:  # cameras that roll in every direction tell nothing
                return mean / np.linalg.norm(mean)
        return np.array([0.0, -1.0, 0.0])

    def bounds(self) -> tuple[Array, float]:
        """Robust centre (3,) and radius in world units: medians, so that floaters do not count."""
        means = self.gaussians.means[self.gaussians.valid()].astype(np.float64)
        if len(means) == 0:
            return np.zeros(3), 1.0
        centre = np.median(means, axis=0)
        radius = float(np.quantile(np.linalg.norm(means - centre, axis=1), 0.7))
        # far from the origin float32 positions are coarse, and a camera needs a distance that it can tell
        return centre, max(radius, 1e-3, 1e-6 * float(np.abs(centre).max()))

    def _across(self, centre: Array, radius: float, up: Array) -> Array:
        """(3,) the level direction along which the scene covers the most of an image."""
        side = across(up)
        side /= np.linalg.norm(side)
        ahead = np.cross(up, side)
        some = self.gaussians.take(np.arange(0, len(self.gaussians), len(self.gaussians) // SAMPLES + 1))
        offsets = (some.means[some.valid()] - centre) / radius
        heights, covered, directions = offsets @ up, [], []
        for angle in np.arange(TURNS) * np.pi / TURNS:
            directions.append(np.cos(angle) * side + np.sin(angle) * ahead)
            places = np.stack([offsets @ np.cross(up, directions[-1]), heights], 1)
            cells = np.floor(places[(np.abs(places) < REACH).all(1)] / CELL)
            covered.append(len(np.unique(cells @ (1.0, 4 * REACH / CELL))))  # a number for each cell
        broadest = int(np.argmax(covered))
        return np.asarray(directions[broadest if covered[broadest] > MORE * covered[0] else 0])

    def spiral_cameras(
        self,
        count: int,
        size: tuple[int, int],
        elevations: tuple[float, float] = (-20.0, 60.0),
        distances: Sequence[float] = (2.6,),
    ) -> tuple[Camera, ...]:
        """Return `count` upright cameras of `size` (width, height) around the scene that look at its centre.

        They are spread evenly between two `elevations`, degrees; `distances`, radii of the scene, take turns.
        """
        centre, radius = self.bounds()
        up = self.up()
        east = unit(across(up))
        north = np.cross(up, east)
        low, high = np.sin(np.radians(elevations))
        cameras = []
        for index in range(count):
            height = low + (high - low) * (index + 0.5) / count  # equal steps of the sine: even on the sphere
            angle = np.pi * (3 - np.sqrt(5)) * index
            level = np.sqrt(1 - height**2) * (np.cos(angle) * east + np.sin(angle) * north)
            eye = centre + distances[index % len(distances)] * radius * (level + height * up)
            cameras.append(replace(look_at(eye, centre, up, size), name=f"around_{index:03d}"))
        return tuple(cameras)

    def framing_camera(self, size: tuple[int, int], bounds: tuple[Array, float] | None = None) -> Camera:
        """Return a camera of `size` (width, height) that frames the `bounds`, by default the scene's.

        It looks a little from above, and from where they are broadest.
        """
        centre, radius = bounds or self.bounds()
        up = self.up()
        direction = self._across(centre, radius, up) + 0.35 * up
        return look_at(centre + 2.6 * radius * direction / np.linalg.norm(direction), centre, up, size)
