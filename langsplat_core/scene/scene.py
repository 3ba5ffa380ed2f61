"""Scenes: Gaussians with cameras, in OpenCV's frame (x right, y down, z forward), and a language field."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

import langsplat_core
from langsplat_core.arrays import Array, across, affine, check_array, unit
from langsplat_core.config import INRIA, RasterSettings
from langsplat_core.errors import expect
from langsplat_core.scene.gaussians import Gaussians
from langsplat_core.scene.language import LanguageField


@dataclass(frozen=True)
class Intrinsics:
    """Size of an image, focal lengths and principal point; only a `Camera` needs whole numbers of pixels."""

    width: float  # pixels, > 0, finite
    height: float
    fx: float  # pixels, > 0
    fy: float
    cx: float  # pixels from the left edge; the first pixel's centre is at 0.5
    cy: float  # pixels from the top edge

    def __post_init__(self) -> None:
        if not (0 < self.width < math.inf and 0 < self.height < math.inf):
            raise ValueError(f"an image of {self.width}x{self.height} pixels")
        if not (np.isfinite([self.fx, self.fy, self.cx, self.cy]).all() and min(self.fx, self.fy) > 0):
            raise ValueError("focal lengths must be positive and the principal point finite")

    def resized(self, width: float, height: float) -> Self:
        """Return the same camera on another pixel grid over the same image."""
        sx, sy = width / self.width, height / self.height
        inner = {"fx": self.fx * sx, "fy": self.fy * sy, "cx": self.cx * sx, "cy": self.cy * sy}
        return replace(self, width=width, height=height, **inner)

    def fitted(self, width: float, height: float) -> Self:
        """Return the same camera in a window around its whole image, whose square pixels stay square."""
        scale = min(width / self.width, height / self.height)
        cx = (self.cx - self.width / 2) * scale + width / 2
        cy = (self.cy - self.height / 2) * scale + height / 2
        return replace(self, width=width, height=height, fx=self.fx * scale, fy=self.fy * scale, cx=cx, cy=cy)

    @property
    def fov_degrees(self) -> float:
        """Angle of view across the shorter side."""
        return math.degrees(2 * math.atan(0.5 * min(self.width, self.height) / min(self.fx, self.fy)))


FARTHEST = 1e9  # largest coordinate of cameras in files, world units: float32 steps there are 64 units


@dataclass(frozen=True, eq=False)
class Camera(Intrinsics):
    """A pinhole camera without distortion, or an orthographic one, whose rays are parallel to its z axis.

    The top left pixel's centre is (0.5, 0.5). Focal lengths of orthographic cameras are pixels per unit.
    """

    width: int  # pixels, >= 1
    height: int
    world_to_camera: Array = field(repr=False)  # (4, 4) float64, rigid
    name: str = ""  # file stem of the photograph it belongs to, if any
    orthographic: bool = False
    __eq__, __hash__ = object.__eq__, object.__hash__  # by identity, not by intrinsics

    def __post_init__(self) -> None:
        super().__post_init__()
        matrix = np.ascontiguousarray(self.world_to_camera, dtype=np.float64)
        check_array("world_to_camera", matrix, (4, 4))
        if not np.isfinite(matrix).all():
            raise ValueError("world_to_camera: every entry must be finite")
        if not is_rotation(matrix[:3, :3]) or np.abs(matrix[3] - (0, 0, 0, 1)).max() > 1e-3:
            raise ValueError("world_to_camera: no rotation and shift, but scaled, mirrored or transposed")
        if (self.width % 1, self.height % 1) != (0, 0):
            raise ValueError(f"an image of {self.width}x{self.height} pixels: they must be whole")
        # Sizes of calibrations may be 640.0, or of a type in which products overflow.
        vars(self).update(width=int(self.width), height=int(self.height), world_to_camera=matrix)

    @property
    def position(self) -> Array:
        """(3,) world units: centre of projection, or where an orthographic principal ray meets z = 0."""
        return -self.world_to_camera[:3, :3].T @ self.world_to_camera[:3, 3]

    @property
    def rotation(self) -> Array:
        """The (3, 3) world-to-camera rotation; its rows are the camera's right, down and forward axes."""
        return self.world_to_camera[:3, :3]

    def moved(self, offset: Array) -> "Camera":
        """Return the camera moved by `offset` (3,), world units."""
        return replace(self, world_to_camera=moved_pose(self.world_to_camera, offset))

    @property
    def intrinsics(self) -> Intrinsics:
        """Focal lengths and principal point on the camera's own pixel grid."""
        return Intrinsics(self.width, self.height, self.fx, self.fy, self.cx, self.cy)

    def within(self, side: int) -> "Camera":
        """Return the same view with an image of at most `side` pixels along its longer side."""
        share = min(side / max(self.width, self.height), 1.0)
        return self.resized(max(round(share * self.width), 1), max(round(share * self.height), 1))

    def project(self, points_world: Array) -> tuple[Array, Array]:
        """Map (N, 3) world points to (N, 2) pixel positions and (N,) depths along z (may be <= 0)."""
        u, v, w = np.asarray(points_world).T  # by columns: NumPy's loops over three numbers are slow
        x, y, depth = (a * u + b * v + c * w + t for a, b, c, t in self.world_to_camera[:3])
        safe = 1.0 if self.orthographic else np.where(np.abs(depth) < 1e-12, 1e-12, depth)
        return np.stack([x / safe * self.fx + self.cx, y / safe * self.fy + self.cy], -1), depth

    def unproject(self, pixels: ArrayLike, depths: ArrayLike) -> Array:
        """Map (..., 2) pixel positions and depths along z, (...) or one number, to (..., 3) world points."""
        places, z = np.asarray(pixels, np.float64), np.asarray(depths, np.float64)[..., None]
        offsets = (places - (self.cx, self.cy)) / (self.fx, self.fy) * (1.0 if self.orthographic else z)
        in_camera = np.concatenate([offsets, np.broadcast_to(z, (*offsets.shape[:-1], 1))], -1)
        return np.asarray((in_camera - self.world_to_camera[:3, 3]) @ self.rotation)

    def pixel_centres(self) -> Array:
        """Return (H, W, 2) positions x, y of the centres of all pixels."""
        x, y = np.meshgrid(np.arange(self.width), np.arange(self.height))
        return np.stack([x, y], -1) + 0.5

    def in_image(self, pixels: Array, depths: Array) -> Array:
        """Return (N,) bool: points, as returned by `project`, in front of the camera and inside its image."""
        (x, y), inside = pixels.T, depths > 0
        return np.asarray(inside & (x >= 0) & (x < self.width) & (y >= 0) & (y < self.height))


def is_rotation(matrix: Array) -> bool:
    """Return whether a finite (3, 3) matrix is a rotation, to 1e-3; files written in float32 keep 1e-6."""
    if np.abs(matrix).max() > 2:  # products of larger ones could overflow
        return False
    unlike = np.abs(matrix @ matrix.T - np.eye(3)).max()
    return bool(unlike <= 1e-3 and np.linalg.det(matrix) > 0)


def moved_pose(world_to_camera: Array, offset: Array) -> Array:
    """Return the (4, 4) pose of a camera that was moved by `offset` (3,)."""
    pose = world_to_camera.copy()
    pose[:3, 3] -= pose[:3, :3] @ offset
    return pose


def look_at(
    eye: Array, target: Array, up: Array, size: tuple[int, int], fov_y_degrees: float = 50.0
) -> Camera:
    """Return a camera at `eye` that sees `target` in its centre; `up` (world) points up in the image.

    `size` is (width, height) in pixels. An `up` parallel to the view is replaced by a world axis.
    """
    given = [np.asarray(vector, dtype=np.float64) for vector in (eye, target, up)]
    if any(vector.shape != (3,) or not np.isfinite(vector).all() for vector in given):
        raise ValueError(f"eye {eye}, target {target}, up {up}: expected three finite numbers each")
    if not 0 < fov_y_degrees < 180:
        raise ValueError(f"a field of view of {fov_y_degrees} degrees: expected above 0 and below 180")
    eye, forward = given[0], given[1] - given[0]
    if not (away := float(np.linalg.norm(forward))) > 0:
        raise ValueError(f"a camera at {eye} that looks at itself; give another eye or target")
    forward = forward / away
    right = np.cross(forward, given[2])
    if np.linalg.norm(right) < 1e-9:
        right = across(forward)
    right = right / np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    width, height = size
    focal = 0.5 * height / np.tan(np.radians(fov_y_degrees) / 2)
    return Camera(width, height, focal, focal, width / 2, height / 2, affine(rotation, -rotation @ eye))


NEAR = 0.05  # near plane over the median depth that cameras see, or over the radius if they see nothing
LEAST_NEAR = 0.01  # its least value over the median depth: what is nearer veils the scene
NEAREST, NEAR_OF_NEAREST = 0.01, 0.25  # quantile of depths that counts as the nearest; near plane over it
NEAR_CAMERAS = 16  # cameras that are evaluated at most
SAMPLES = 20_000  # Gaussians, at most, that tell where a scene is and how it lies
WIDEST = 0.2  # least focal length over an image's width, 136 degrees: shorter ones belong to no lens


def near_plane(gaussians: Gaussians, cameras: Sequence[Camera], most: float | None = None) -> float:
    """Return the near plane, camera z in world units, > 0: a fraction of the depths that cameras see.

    most: its upper bound; None: `NEAR` of the median depth (published: 0.2). Orthographic ones do not count.
    """
    points = gaussians.sample.means.astype(np.float64)
    telling = [camera for camera in cameras if not camera.orthographic]
    depths = [np.zeros(0)]
    for camera in telling[:: max(-(-len(telling) // NEAR_CAMERAS), 1)]:
        pixels, z = camera.project(points)
        depths.append(z[camera.in_image(pixels, z)])
    every = np.concatenate(depths)
    if len(every) == 0:
        return most or NEAR * bounds_of(gaussians.sample)[1]
    nearest, middle = np.quantile(every, (NEAREST, 0.5))
    return float(min(most or NEAR * middle, max(NEAR_OF_NEAREST * nearest, LEAST_NEAR * middle)))


def bounds_of(gaussians: Gaussians) -> tuple[Array, float]:
    """Return the geometric median (3,) and the 70 % quantile of distances from it, > 0, world units."""
    valid = gaussians.valid()
    means = gaussians.means[valid].astype(np.float64)
    if len(means) == 0:
        return np.zeros(3), 1.0
    centre = geometric_median(means[:: len(means) // SAMPLES + 1])
    radius = float(np.quantile(np.linalg.norm(means - centre, axis=1), 0.7))
    # A single Gaussian has a radius too. Far from the origin, where float32 positions are coarse, cameras,
    # placed at multiples of the radius, need a distance above their rounding.
    size = float(np.exp(np.median(gaussians.log_scales[valid].astype(np.float64))))
    return centre, max(radius, size, 1e-6 * float(np.abs(centre).max()))


def geometric_median(points: Array) -> Array:
    """Return the (3,) float64 point of least summed distance to (N, 3) points (Weiszfeld)."""
    centre = np.median(points, axis=0)
    for _ in range(100):
        offsets = points - centre
        away = np.sqrt(np.einsum("ij,ij->i", offsets, offsets))
        if not (usual := float(np.median(away))):  # most are in one place
            break
        pull = 1 / np.maximum(away, 1e-9 * usual)
        step = pull / pull.sum() @ offsets
        centre = centre + step
        if np.linalg.norm(step) <= 1e-6 * usual:
            break
    return np.asarray(centre)


# Far from zero float32 is coarse: at a northing of 5 400 000 m positions lie half a metre apart. A far
# scene is therefore kept relative to a float64 origin, which is subtracted where files are read.

NO_ORIGIN = np.zeros(3)
NO_ORIGIN.flags.writeable = False
FAR = 100.0  # distance from zero, in radii, beyond which float32 steps are more than 1e-5 of a radius
LOOKED_AT = 4096  # positions, evenly taken: enough for a median


@np.errstate(over="ignore", invalid="ignore")  # a file may hold any number
def origin_of(points: Array) -> Array:
    """Return the (3,) float64 origin about which float32 holds (N, 3) positions: zero unless they are far.

    Along the axes on which they are far, it is their median, rounded to multiples of a power of two below
    their radius, so that it is subtracted from float32 positions without rounding.
    """
    some = points[:: len(points) // LOOKED_AT + 1].astype(np.float64)
    some = some[np.isfinite(some).all(1)]
    if not len(some):
        return NO_ORIGIN
    centre = np.median(some, axis=0)
    distance = float(np.abs(centre).max())
    radius = float(np.quantile(np.linalg.norm(some - centre, axis=1), 0.7)) or 1.0  # all in one place
    if not FAR * radius < distance <= FARTHEST:
        return NO_ORIGIN
    grid = 2.0 ** math.floor(math.log2(max(radius, 1e-12 * distance)))
    return np.where(np.abs(centre) > FAR * radius, np.round(centre / grid) * grid, 0.0)


def about_origin(points: Array) -> tuple[Array, Array]:
    """Return (N, 3) positions in the world about an origin near them, and that origin (3,)."""
    origin = origin_of(points)
    return (points - origin if origin.any() else points), origin


# Opening view of a scene without cameras: from where the scene covers most cells of a grid; lengths in radii.
TURNS, REACH, CELL = 12, 3.0, 0.06
MORE = 1.25  # how many times the cells of the first side another has to cover to be preferred


@dataclass(frozen=True, eq=False)
class Scene:
    """Gaussians with all that is known of them: `load_scene` returns one, renderers and queries take one.

    Everything in it is relative to `origin`: position in the world = `origin` + position.
    """

    gaussians: Gaussians
    language: LanguageField | None = None
    cameras: tuple[Camera, ...] = ()  # training cameras, in the dataset's order
    path: Path | None = None
    antialiased: bool = False  # trained with Mip-Splatting's compensation, as its file says
    extras: Mapping[str, Array] = field(default_factory=dict)  # (N,) other properties of the file
    metres_per_unit: float | None = None  # > 0; None: the length of a world unit is unknown
    unread: tuple[str, ...] = ()  # why files beside the scene could not be read, a line each
    origin: Array = field(default_factory=lambda: NO_ORIGIN)  # (3,) float64, zero unless the scene is far off

    def __post_init__(self) -> None:
        expect(self.gaussians, Gaussians, "load_scene(path) makes a scene of a file")
        expect(self.language, LanguageField | None, "a scene's own is scene.language")
        expect(self.cameras, Iterable, "say cameras=(camera,) for one")
        object.__setattr__(self, "cameras", tuple(self.cameras))
        for camera in self.cameras:
            expect(camera, Camera, "look_at makes one")
        object.__setattr__(self, "origin", np.asarray(self.origin, np.float64))
        if self.origin.shape != (3,) or not (np.abs(self.origin) <= FARTHEST).all():
            raise ValueError(f"an origin of {self.origin}: expected three numbers up to {FARTHEST:g}")
        if self.metres_per_unit is not None and not 0 < self.metres_per_unit < np.inf:
            raise ValueError(f"metres_per_unit of {self.metres_per_unit}: must be above 0 and finite")
        for name, values in self.extras.items():
            if values.shape != (len(self.gaussians),):
                raise ValueError(f"extras[{name!r}] of shape {values.shape}, not ({len(self.gaussians)},)")
        if self.language is not None and len(self.language) != len(self.gaussians):
            raise ValueError(f"a field of {len(self.language)} Gaussians on a scene of {len(self.gaussians)}")

    def __repr__(self) -> str:
        what = f"{'with' if self.language else 'without'} a language field"
        return f"<Scene of {len(self.gaussians):,} Gaussians {what}: {self.path or 'no file'}>"

    # `show` belongs to a higher layer, which is imported when its public name is used.
    def show(self, phrase: str = "", **options: Any) -> Any:
        """Return the page of `langsplat_core.show`, with `phrase` asked, which a notebook shows."""
        return langsplat_core.show(self, phrase, **options)

    def _repr_html_(self) -> str:
        return str(self.show()._repr_html_())

    def in_world(self, points: Array) -> Array:
        """Map (..., 3) positions in this scene to (..., 3) float64 positions in the world."""
        return np.asarray(points, np.float64) + self.origin

    def world_gaussians(self) -> Gaussians:
        """Return the Gaussians at their positions in the world, rounded to float32."""
        if not self.origin.any():
            return self.gaussians
        return replace(self.gaussians, means=self.in_world(self.gaussians.means))

    def take(self, rows: Array) -> "Scene":
        """Return the scene of the Gaussians at `rows` (indices or a boolean mask), without a path."""
        return replace(
            self,
            gaussians=self.gaussians.take(rows),
            language=None if self.language is None else self.language.take(rows),
            extras={name: values[rows] for name, values in self.extras.items()},
            path=None,
        )

    def recoloured(self, gaussians: Gaussians) -> "Scene":
        """Return the scene with `gaussians`, which have the same positions: the near plane is handed on."""
        made = replace(self, gaussians=gaussians)
        vars(made)["near"] = self.near
        return made

    def raster_settings(self, profile: RasterSettings | None = None) -> RasterSettings:
        """Return `profile`, or INRIA's settings with the scene's near plane, with the scene's own filters."""
        formed = replace(INRIA, near=self.near) if profile is None else profile
        return replace(formed, antialiased=self.antialiased, focal=self._focal)

    @cached_property
    def near(self) -> float:
        """Near plane: camera z up to which nothing is drawn, world units, > 0; see `near_plane`."""
        return near_plane(self.gaussians, self.cameras)

    @cached_property
    def _focal(self) -> float | None:
        """Median focal length of pinhole cameras, px; None if shorter than any lens's, as in other units."""
        pinholes = [camera for camera in self.cameras if not camera.orthographic]
        lengths = [(np.sqrt(camera.fx * camera.fy), camera.width) for camera in pinholes]
        focal, width = np.median(lengths, axis=0) if lengths else (0.0, 1.0)
        return float(focal) if focal > WIDEST * width else None

    def up(self) -> Array:
        """Return (3,) the world's up direction: the mean of the cameras' up axes, else -y as in COLMAP."""
        if self.cameras:
            mean = -np.mean([camera.rotation[1] for camera in self.cameras], axis=0)
            if np.linalg.norm(mean) > 0.2:  # cameras that roll in every direction tell nothing
                return mean / np.linalg.norm(mean)
        return np.array([0.0, -1.0, 0.0])

    def bounds(self) -> tuple[Array, float]:
        """Robust centre (3,) and radius in world units, > 0: see `bounds_of`."""
        return bounds_of(self.gaussians)

    def _level(self, up: Array) -> tuple[Array, Array]:
        """Return two orthogonal (3,) unit vectors across `up`, the first along the first camera's right."""
        right = self.cameras[0].rotation[0] if self.cameras else across(up)
        right = right - (right @ up) * up
        side = unit(right if np.linalg.norm(right) > 0.1 else across(up))
        return side, np.cross(up, side)

    def _across(self, centre: Array, radius: float, up: Array) -> Array:
        """Return the (3,) level viewing direction along which the scene covers most of an image."""
        side, ahead = self._level(up)
        some = self.gaussians.take(np.arange(0, len(self.gaussians), len(self.gaussians) // SAMPLES + 1))
        offsets = (some.means[some.valid()] - centre) / radius
        heights = offsets @ up
        covered, directions = [], []
        for angle in np.arange(TURNS) * np.pi / TURNS:
            directions.append(np.cos(angle) * side + np.sin(angle) * ahead)
            places = np.stack([offsets @ np.cross(up, directions[-1]), heights], 1)
            cells = np.floor(places[(np.abs(places) < REACH).all(1)] / CELL)
            covered.append(len(np.unique(cells @ (1.0, 4 * REACH / CELL))))  # one key per cell
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
        east, north = self._level(up)
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
        """Return a camera of `size` that frames the `bounds`, from a little above their broadest side."""
        centre, radius = bounds or self.bounds()
        up = self.up()
        direction = self._across(centre, radius, up) + 0.35 * up
        return look_at(centre + 2.6 * radius * direction / np.linalg.norm(direction), centre, up, size)
