"""Captures: photographs with known cameras, as every loader returns them, and the length of their unit."""

import hashlib
import logging
import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from PIL import Image
from scipy.spatial.distance import pdist

from langsplat_core.arrays import Array, check_array
from langsplat_core.datasets.exif import place
from langsplat_core.datasets.matches import Matches
from langsplat_core.datasets.photos import WORKERS, Photo, View, developer
from langsplat_core.errors import InputError
from langsplat_core.io.hostile import PictureError
from langsplat_core.scene import Camera

DECIMALS = 9  # of world units: what a digest tells apart, far above rounding and far below a pixel

log = logging.getLogger("langsplat")


def warn_of_lost_points(good: Array, source: str) -> None:
    """Warn where most of the points of `source` had to be left out; good: (M,) bool, those that were not."""
    if 2 * good.sum() < len(good):
        log.warning(
            "%d of the %d points of %s are damaged or badly located and are left out; was it written whole?",
            len(good) - good.sum(),
            len(good),
            source,
        )


@dataclass(frozen=True, eq=False)
class Capture:
    """Undistorted photographs, in name order, with pinhole cameras of the same size."""

    cameras: tuple[Camera, ...]  # camera.name is the photograph's file stem
    images: tuple[Array, ...]  # (H, W, 3) uint8 each, display (sRGB) values
    points: Array  # (M, 3) float64 structure-from-motion points; M may be 0
    colours: Array  # (M, 3) uint8
    metres_per_unit: float | None = None  # > 0, how long a unit of its world is; None: unknown
    photos: tuple[Photo, ...] = ()  # the files, in the same order; none for images made otherwise
    drawn: bool = False  # by `assets.making`, where encoders are calibrated
    masks: tuple[Array | None, ...] = ()  # (H, W) bool each, pixels that count; None: all; (): no masks
    matches: Matches | None = None  # of all photographs, where cameras came from structure from motion

    def __post_init__(self) -> None:
        lists = {"photographs": self.images, "files": self.photos, "masks": self.masks}
        for name, items in lists.items():
            if len(items) != len(self.cameras) and (items or name == "photographs"):
                raise ValueError(f"{len(items)} {name} for {len(self.cameras)} cameras")
        for index, camera in enumerate(self.cameras):
            shape, mask = (camera.height, camera.width), self.mask(index)
            check_array(f"photograph {camera.name}", self.images[index], (*shape, 3), dtype=np.uint8)
            if mask is not None:
                check_array(f"mask of {camera.name}", mask, shape, dtype=np.bool_)
        dims = check_array("points", self.points, ("M", 3))
        check_array("colours", self.colours, ("M", 3), dims)

    def __len__(self) -> int:
        return len(self.cameras)

    def mask(self, index: int) -> Array | None:
        """Return (H, W) bool, pixels of photograph `index` that count; None: all of them."""
        return self.masks[index] if self.masks else None

    def split(self, test_every: int) -> tuple[list[int], list[int]]:
        """Return indices of (training, held-out) views; every `test_every`-th is held out, 0 holds out none.

        There is always a training view.
        """
        test = [i for i in range(len(self)) if test_every > 1 and i % test_every == 0 and len(self) > 1]
        return [i for i in range(len(self)) if i not in test], test

    def digest(self, indices: Sequence[int]) -> str:
        """Return a digest of all that a training on the photographs at `indices` sees.

        That is these in their order, their cameras, and the points. Structure from motion run again may place
        the same photographs in another world, so names alone do not identify a capture. Poses and points
        count to `DECIMALS`, so that a work folder is taken up on another processor too, whose products of
        matrices differ in their last digits.
        """
        digest = hashlib.blake2b(digest_size=16)
        for camera, image in ((self.cameras[i], self.images[i]) for i in indices):
            digest.update(repr((camera.name, camera.intrinsics)).encode())
            digest.update(_rounded(camera.world_to_camera).tobytes())
            digest.update(np.ascontiguousarray(image).data)
        for mask in (self.mask(i) for i in indices):
            digest.update(b"" if mask is None else np.packbits(mask).tobytes())
        digest.update(_rounded(self.points).tobytes())
        digest.update(self.colours.tobytes())
        return digest.hexdigest()

    def shrunk(self, indices: Sequence[int], longer_side: int) -> "Capture":
        """Return the photographs at `indices`, at most `longer_side` pixels long, with the points of all."""
        views: list[View] = []
        for index in indices:
            camera, share = self.cameras[index], longer_side / max(self.images[index].shape)
            size = max(round(camera.width * share), 1), max(round(camera.height * share), 1)
            view = camera, self.images[index], self.mask(index)
            views.append(view if share >= 1 else shrunk_view(*view, size))
        return self._of(views)

    def read_at(self, indices: Sequence[int], longer_side: int) -> "Capture":
        """Return the photographs at `indices` bit for bit as a dataset that is read at that size has them.

        The points are those of all. Without files they are `shrunk`. InputError for a file that can no longer
        be read.
        """
        if not self.photos or longer_side >= max(max(self.images[index].shape) for index in indices):
            return self.shrunk(indices, longer_side)
        view_of = developer(longer_side)

        def view(index: int) -> View:
            try:
                lens, image, mask = view_of(self.photos[index])
            except PictureError as error:
                raise InputError(f"{error}; it was there when this run began") from None
            camera = self.cameras[index]
            return replace(lens, world_to_camera=camera.world_to_camera, name=camera.name), image, mask

        with ThreadPoolExecutor(WORKERS) as pool:
            return self._of(list(pool.map(view, indices)))

    def _of(self, views: Sequence[View]) -> "Capture":
        """Return a capture of other views of the same scene, which are no longer those of the files."""
        cameras, images, masks = zip(*views, strict=True) if views else ((), (), ())
        masks = masks if self.masks else ()
        return replace(self, cameras=cameras, images=images, masks=masks, photos=(), matches=None)

    def extent(self) -> float:
        """Return 1.1 times the largest distance of a camera from the cameras' mean, world units, > 0.

        It is the scene scale that the INRIA code multiplies position learning rates with.
        """
        centres = np.array([camera.position for camera in self.cameras])
        return max(1.1 * float(np.linalg.norm(centres - centres.mean(0), axis=1).max()), 1e-6)


def shrunk_view(camera: Camera, image: Array, mask: Array | None, size: tuple[int, int]) -> View:
    """Return a view at a smaller (width, height), shrunk as photographs are when they are read.

    Area averages differ from that by a PSNR of 31 to 42 dB, which the scores of good renders would feel. A
    pixel counts where all it is made of count.
    """

    def resized(values: Array, by: Image.Resampling) -> Array:
        return np.asarray(Image.fromarray(values).resize(size, by))

    counts = None if mask is None else np.where(mask, np.uint8(255), np.uint8(0))
    counted = None if counts is None else resized(counts, Image.Resampling.BOX) == 255
    return camera.resized(*size), resized(image, Image.Resampling.LANCZOS), counted


def _rounded(values: Array) -> Array:
    """Return float64 values rounded to `DECIMALS`, without a negative zero."""
    rounded: Array = np.round(values.astype(np.float64), DECIMALS) + 0.0
    return rounded


# The length of a unit of a capture's world, by the places (GPS) that its photographs name.
#
# A phone's places are metres off, so they do not move the cameras. But distances between far ones say how
# long a unit is, where the photographs lie further apart than their places err; which their own spread
# tells.

FEWEST_PLACES = 5  # photographs that name one
FAR = 0.5  # of the longest distance between two cameras: pairs that count
MOST_SPREAD = 0.2  # of the median: by which half of the far pairs may differ from each other
_EQUATOR, _FLATTENED = 6_378_137.0, 6.694_379_990_14e-3  # of WGS 84: radius in metres, squared eccentricity


def metres_of(capture: Capture) -> float | None:
    """Return the metres of a unit of `capture` by its photographs' places; None where they are unsure."""
    places = np.array([place(photo.path) for photo in capture.photos]).reshape(-1, 2)
    named = np.isfinite(places).all(1)
    if named.sum() < FEWEST_PLACES:
        return None
    eyes = np.array([camera.position for camera in capture.cameras])[named]
    metres = metres_per_unit(eyes, places[named])
    if metres is None:
        log.info("the places (GPS) of %d photographs differ too much to say how long a unit is", named.sum())
    else:
        log.info("a unit is about %.3g m long by the places (GPS) of %d photographs", metres, named.sum())
    return metres


def metres_per_unit(eyes: Array, places: Array) -> float | None:
    """Return the median ratio of distances between places to those between cameras, over far pairs.

    eyes: (K, 3) camera positions; places: (K, 2) latitudes and longitudes, degrees. None where a quarter and
    three quarters of the pairs differ by more than `MOST_SPREAD`. Heights are left out, as most cameras know
    them badly: for a climb as steep as a stair that is an eighth too little.
    """
    apart = pdist(eyes)
    far = apart >= FAR * apart.max(initial=0)
    if not apart.any():
        return None
    low, middle, high = np.quantile(pdist(on_the_ground(places))[far] / apart[far], [0.25, 0.5, 0.75])
    sure = middle > 0 and high - low <= MOST_SPREAD * middle
    return float(middle) if sure else None


def on_the_ground(places: Array) -> Array:
    """Return (K, 2) metres to the east and north of the first of (K, 2) latitudes and longitudes, degrees.

    For places within some kilometres, away from the poles.
    """
    latitude, longitude = np.radians(places).T
    bend = 1 - _FLATTENED * np.sin(latitude[0]) ** 2
    north = _EQUATOR * (1 - _FLATTENED) / bend**1.5 * (latitude - latitude[0])
    turn = (longitude - longitude[0] + math.pi) % (2 * math.pi) - math.pi  # also over the date line
    return np.stack([_EQUATOR / math.sqrt(bend) * math.cos(latitude[0]) * turn, north], 1)
