"""Captures: photographs, read and developed in bounded memory, with known cameras and the length of a
unit."""

import hashlib
import logging
import math
import os
import tempfile
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from PIL import Image, ImageOps
from PIL.Image import Exif
from scipy.spatial.distance import pdist

from langsplat_core.arrays import Array, check_array
from langsplat_core.datasets.intrinsics import PhotoIntrinsics, pinhole_for, resample, source_positions
from langsplat_core.datasets.matches import Matches
from langsplat_core.errors import InputError, shortened
from langsplat_core.io.hostile import PHOTO_SUFFIXES, PictureError, opened
from langsplat_core.progress import Progress
from langsplat_core.scene import Camera

IN_MEMORY = 512_000_000  # bytes of photographs


class Album:
    """Images in bounded memory: beyond a limit they lie in files without a name in the temporary folder
    (`TMPDIR`), which the system reads in where they are looked at and which end with the process."""

    def __init__(self, in_memory: int = IN_MEMORY) -> None:
        self._left = in_memory

    def keep(self, picture: Array) -> Array:
        """The same (H, W, 3) uint8 image, in memory as long as there is room, else in a file."""
        self._left -= picture.nbytes
        if self._left >= 0:
            return picture
        try:
            with tempfile.TemporaryFile(prefix="langsplat-") as file:
                # Written, not mapped and filled: on a full disk that would kill the process without a word.
                file.write(np.ascontiguousarray(picture).data)
                file.flush()
                return np.memmap(file, np.uint8, "c", shape=picture.shape)
        except OSError as error:
            raise OSError(error.errno, error.strerror, tempfile.gettempdir()) from error


# Photographs: finding them, reading them whatever their kind, and making pinhole images of them.

log = logging.getLogger("langsplat")

HALF = 128  # grey of a mask's pixels, from which they count
ASPECT_TOLERANCE = 0.02  # shrunk copies round their sizes
WORKERS = 2  # decoding and resampling release the interpreter; more would only hold more pixels
_MAIN_TAGS, EXIF_IFD = (0x010F, 0x0110), 0x8769  # maker, model
_FOCAL, _FOCAL_ON_FILM = 0x920A, 0xA405  # mm; mm of a lens with the same view on film of 36 x 24 mm
_PLANE_X, _PLANE_UNIT, _WIDTH = 0xA20E, 0xA210, 0xA002  # pixels per unit on the sensor; the unit; pixels
_MILLIMETRES = {2: 25.4, 3: 10.0, 4: 1.0}  # of the unit
_FILM = math.hypot(36, 24)  # mm, its diagonal
_PLAUSIBLE = (1, 5_000)  # mm on film, of any lens that is sold


@dataclass(frozen=True, eq=False)
class Photo:
    """A photograph on disk and the camera it was taken with."""

    path: Path
    label: str  # path inside the dataset, "/" between its parts
    intrinsics: PhotoIntrinsics
    world_to_camera: Array  # (4, 4) float64, rigid
    upright: bool = False  # the lens describes the photograph turned as its EXIF data ask
    mask: Path | None = None  # an image of the same shape, black where the photograph does not count


def find_photos(folder: Path) -> list[Path]:
    """Photographs directly in `folder`, by name; hidden files do not count."""
    if not folder.is_dir():
        return []
    found = (p for p in folder.iterdir() if p.suffix.lower() in PHOTO_SUFFIXES and p.name[0] != ".")
    return sorted(p for p in found if p.is_file())


def mask_beside(photo: Path) -> Path | None:
    """The mask of a photograph where COLMAP and nerfstudio keep it: masks/NAME.jpg.png or masks/NAME.png, in
    its folder or beside that."""
    folders = (photo.parent / "masks", photo.parent.parent / "masks")
    names = (f"{photo.name}.png", f"{photo.stem}.png")
    candidates = (folder / name for folder in folders for name in names)
    # os.path.isfile, unlike Path.is_file, also says no to names that no file system could hold.
    return next((path for path in candidates if path != photo and os.path.isfile(path)), None)


def unique_names(labels: Sequence[str]) -> list[str]:
    """File stems where those differ from each other, else paths with "_" for "/" and for the suffix's dot."""
    stems = [PurePosixPath(label).stem for label in labels]
    if len(set(stems)) == len(stems):
        return stems
    paths = [str(PurePosixPath(label).with_suffix("")).replace("/", "_") for label in labels]
    if len(set(paths)) == len(paths):
        return paths
    return [label.replace("/", "_").replace(".", "_") for label in labels]


def read_photo(path: Path, upright: bool) -> Image.Image:
    """An RGB image; transparent pixels are laid over black, 16 bits become 8.

    With `upright` it is turned as its EXIF data ask. Raises PictureError.
    """
    with opened(path) as stored:
        picture = upright_copy(stored) if upright else stored
        if picture.mode.startswith("I") or picture.mode == "F":  # Pillow's own conversion would clip
            values = np.asarray(picture)
            if picture.mode == "F" or not 0 <= values.min(initial=0) <= values.max(initial=0) <= 65535:
                raise PictureError(path, "more than 16 bits per channel")
            # the nearest of 256 shades: v / 257 rounded, in whole numbers
            return Image.fromarray(((values.astype(np.uint32) + 128) // 257).astype(np.uint8)).convert("RGB")
        if picture.has_transparency_data:
            black = Image.new("RGBA", picture.size, (0, 0, 0, 255))
            return Image.alpha_composite(black, picture.convert("RGBA")).convert("RGB")
        return picture.convert("RGB")


def upright_copy(picture: Image.Image) -> Image.Image:
    """A copy of an image, turned as its EXIF data ask; unreadable EXIF data count as none."""
    picture.load()  # so that nothing but the EXIF data can fail below
    try:
        return ImageOps.exif_transpose(picture)
    except Exception:  # noqa: BLE001  Pillow's parser lets through what damaged tags cause
        return picture.copy()


def optics(path: Path) -> Image.Exif:
    """EXIF data that tell the focal length alone: other tags, orientation first of all, would be wrong for a
    copy.

    Where a camera gives pixels per inch of its sensor instead of the length on film, that is worked out:
    COLMAP compares those with the size of the image, which is another for a copy.
    """
    kept = Image.Exif()
    try:
        with opened(path) as picture:
            source = picture.getexif()
            kept.update({tag: source[tag] for tag in _MAIN_TAGS if tag in source})
            inner = source.get_ifd(EXIF_IFD)
            kept_inner = {tag: inner[tag] for tag in (_FOCAL, _FOCAL_ON_FILM) if tag in inner}
            if not kept_inner.get(_FOCAL_ON_FILM):
                kept_inner |= _on_film(inner, picture.size)
            kept.get_ifd(EXIF_IFD).update(kept_inner)
            kept.tobytes()
    except PictureError:
        return Image.Exif()
    return kept


def _on_film(inner: dict[int, Any], size: tuple[int, int]) -> dict[int, int]:
    """The focal length on film from the one on a sensor whose pixels are counted by the inch; `size`: of the
    image, pixels."""
    try:
        width = inner.get(_WIDTH, size[0]) * _MILLIMETRES[inner.get(_PLANE_UNIT, 2)] / inner[_PLANE_X]
        diagonal = width * math.hypot(*size) / size[0]
        length = float(inner[_FOCAL] / diagonal * _FILM)
    except (KeyError, TypeError, ValueError, ZeroDivisionError):  # absent, or not what the standard says
        return {}
    known = math.isfinite(length) and _PLAUSIBLE[0] <= length <= _PLAUSIBLE[1]
    return {_FOCAL_ON_FILM: round(length)} if known else {}


def _read_for(photo: Photo) -> tuple[Image.Image, PhotoIntrinsics]:
    """Read a photograph, and return its intrinsics on the pixel grid of the file.

    COLMAP reads pixels as stored, other tools turn them first; when the stored shape does not fit the
    lens but the turned one does, the latter is meant.
    """
    picture = read_photo(photo.path, photo.upright)
    if not photo.upright and not _fits(picture.size, photo.intrinsics):
        picture = read_photo(photo.path, upright=True)
    if not _fits(picture.size, photo.intrinsics):
        intrinsics = photo.intrinsics
        raise InputError(
            f"{photo.path} is {picture.width}x{picture.height} pixels but its camera is "
            f"{intrinsics.width}x{intrinsics.height}; use the photographs that the cameras were computed from"
        )
    try:
        return picture, photo.intrinsics.regridded(*picture.size)
    except ValueError as error:  # a camera of one or two pixels, at the edge of what a lens may be
        raise InputError(f"{photo.path}: {error}; export the cameras again") from None


def _read_mask(path: Path, size: tuple[int, int]) -> Image.Image:
    """The mask of a photograph of `size` pixels, as large. InputError for one of another shape."""
    mask = read_photo(path, upright=False)
    if abs(mask.width * size[1] / (mask.height * size[0]) - 1) > ASPECT_TOLERANCE:
        raise InputError(
            f"{path}: is {mask.width}x{mask.height} pixels, its photograph {size[0]}x{size[1]}; a mask has "
            "the shape of the photograph as it is shown"
        )
    return mask.resize(size, Image.Resampling.NEAREST)


def _fits(size: tuple[int, int], intrinsics: PhotoIntrinsics) -> bool:
    ratio = (size[0] * intrinsics.height) / (size[1] * intrinsics.width)
    return (
        abs(ratio - 1) < ASPECT_TOLERANCE
        or max(abs(size[0] - intrinsics.width), abs(size[1] - intrinsics.height)) <= 1
    )


def developer(max_side: int) -> Callable[[Photo], tuple[Camera, Array, Array | None]]:
    """Return the function that makes a pinhole camera, yet without a name, a (H, W, 3) uint8 image of at most
    `max_side` pixels of a photograph, and its (H, W) bool mask, if it has one. It raises PictureError for a
    file that cannot be read."""

    # Photographs of one lens share its pinhole and its map; a few maps are kept, not one per photograph.
    @lru_cache(maxsize=4)
    def plan(intrinsics: PhotoIntrinsics) -> tuple[Camera, Array | None]:
        camera = pinhole_for(intrinsics, max_side)
        return camera, None if intrinsics.distortion is None else source_positions(intrinsics, camera)

    def one(photo: Photo) -> tuple[Camera, Array, Array | None]:
        picture, intrinsics = _read_for(photo)
        camera, positions = plan(intrinsics)
        pose = replace(camera, world_to_camera=photo.world_to_camera)
        image = resample(picture, intrinsics, camera, positions)
        if photo.mask is None:
            return pose, image, None
        mask = resample(_read_mask(photo.mask, picture.size), intrinsics, camera, positions)
        return pose, image, np.asarray(mask[..., 0] >= HALF)

    return one


def develop(
    photos: Sequence[Photo], max_side: int, progress: Progress
) -> tuple[tuple[Camera, ...], tuple[Array, ...], tuple[Photo, ...], tuple[Array | None, ...]]:
    """Pinhole cameras and (H, W, 3) uint8 images of `photos`, sorted by name, what each is made from, and
    (H, W) bool masks; none at all where no photograph has one.

    Files that cannot be read are reported once and left out; InputError when none is left.
    """
    if not photos:
        raise InputError("the dataset lists no photographs")
    names = unique_names([photo.label for photo in photos])
    order = sorted(range(len(photos)), key=names.__getitem__)
    read = developer(max_side)

    def one(index: int) -> tuple[Camera, Array, Photo, Array | None] | str:
        photo = photos[index]
        try:
            camera, picture, mask = read(photo)
        except PictureError as error:
            return f"{photo.label} ({error.reason})"
        if mask is not None and not mask.any():
            return f"{photo.label} (its mask leaves nothing of it)"
        return replace(camera, name=names[index]), picture, photo, mask

    album = Album()
    done: list[tuple[Camera, Array, Photo, Array | None]] = []
    broken: list[str] = []
    with ThreadPoolExecutor(WORKERS) as pool:
        for count, result in enumerate(pool.map(one, order), 1):
            if isinstance(result, str):
                broken.append(result)
            else:
                camera, picture, photo, mask = result
                done.append((camera, album.keep(picture), photo, mask))
            progress("reading photographs", count / len(order))
    if not done:
        raise InputError(f"no photograph can be read: {shortened(broken)}")
    if broken:
        log.warning("%d photographs cannot be used and are left out: %s", len(broken), shortened(broken))
    cameras, images, files, masks = zip(*done, strict=True)
    return cameras, images, files, masks if any(mask is not None for mask in masks) else ()


# A capture: photographs with known cameras, as every loader returns them.

DECIMALS = 9  # of world units: what a digest tells apart, far above rounding and far below a pixel


def tell_of_lost_points(good: Array, source: str) -> None:
    """A warning where most of the points of `source` had to be left out; `good`: (M,) bool, those that were
    not."""
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
    drawn: bool = False  # by `assets.making`, where encoders are calibrated, see `scene.Reading.elsewhere`
    masks: tuple[Array | None, ...] = ()  # (H, W) bool each, pixels that count; None: all; (): no masks
    matches: Matches | None = None  # of all photographs, where cameras came from structure from motion

    def __post_init__(self) -> None:
        if len(self.cameras) != len(self.images):
            raise ValueError(f"{len(self.cameras)} cameras for {len(self.images)} photographs")
        for camera, image in zip(self.cameras, self.images, strict=True):
            check_array(f"photograph {camera.name}", image, (camera.height, camera.width, 3), dtype=np.uint8)
        dims = check_array("points", self.points, ("M", 3))
        check_array("colours", self.colours, ("M", 3), dims)
        if self.photos and len(self.photos) != len(self.images):
            raise ValueError(f"{len(self.photos)} files for {len(self.images)} photographs")
        if self.masks and len(self.masks) != len(self.images):
            raise ValueError(f"{len(self.masks)} masks for {len(self.images)} photographs")
        for camera, mask in zip(self.cameras, self.masks, strict=False):
            if mask is not None:
                check_array(f"mask of {camera.name}", mask, (camera.height, camera.width), dtype=np.bool_)

    def __len__(self) -> int:
        return len(self.cameras)

    def mask(self, index: int) -> Array | None:
        """(H, W) bool, pixels of photograph `index` that count; None: all of them."""
        return self.masks[index] if self.masks else None

    def split(self, test_every: int) -> tuple[list[int], list[int]]:
        """Indices of (training, held-out) views; every `test_every`-th is held out, 0 holds out none.

        Never leaves fewer than one training view.
        """
        test = [i for i in range(len(self)) if test_every > 1 and i % test_every == 0 and len(self) > 1]
        return [i for i in range(len(self)) if i not in test], test

    def digest(self, indices: Sequence[int]) -> str:
        """Digest of all that a training on the photographs at `indices` sees: these in their order, their
        cameras, and the points. Structure from motion run again may place the same photographs in another
        world, so names alone do not identify a capture. Poses and points count to `DECIMALS`, so that a work
        folder is taken up on another processor too, whose products of matrices differ in their last
        digits."""
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
        """The photographs at `indices`, at most `longer_side` pixels long, with the points of all."""
        views = []
        for index in indices:
            camera, share = self.cameras[index], longer_side / max(self.images[index].shape)
            size = max(round(camera.width * share), 1), max(round(camera.height * share), 1)
            view = camera, self.images[index], self.mask(index)
            views.append(view if share >= 1 else shrunk_view(*view, size))
        cameras, images, masks = zip(*views, strict=True) if views else ((), (), ())
        return replace(self, cameras=cameras, images=images, masks=masks, photos=(), matches=None)

    def read_at(self, indices: Sequence[int], longer_side: int) -> "Capture":
        """The photographs at `indices` as they are when a dataset is read at that size, bit for bit, with the
        points of all; `shrunk` where there are no files. InputError for a file that can no longer be read."""
        if not self.photos or longer_side >= max(max(self.images[index].shape) for index in indices):
            return self.shrunk(indices, longer_side)
        read = developer(longer_side)

        def view(index: int) -> tuple[Camera, Array, Array | None]:
            try:
                lens, image, mask = read(self.photos[index])
            except PictureError as error:
                raise InputError(f"{error}; it was there when this run began") from None
            camera = self.cameras[index]
            return replace(lens, world_to_camera=camera.world_to_camera, name=camera.name), image, mask

        with ThreadPoolExecutor(WORKERS) as pool:
            cameras, images, masks = zip(*pool.map(view, indices), strict=True)
        masks = masks if self.masks else ()
        return replace(self, cameras=cameras, images=images, masks=masks, photos=(), matches=None)

    def extent(self) -> float:
        """1.1 times the largest distance of a camera from the cameras' mean: the scene scale that the
        INRIA code multiplies position learning rates with. World units, > 0."""
        centres = np.array([camera.position for camera in self.cameras])
        return max(1.1 * float(np.linalg.norm(centres - centres.mean(0), axis=1).max()), 1e-6)


def shrunk_view(
    camera: Camera, image: Array, mask: Array | None, size: tuple[int, int]
) -> tuple[Camera, Array, Array | None]:
    """A view at a smaller (width, height), shrunk as photographs are when they are read (`intrinsics`).
    Area averages differ from that by a PSNR of 31 to 42 dB, which the scores of good renders would feel. A
    pixel counts where all it is made of count."""

    def resized(picture: Array, by: Image.Resampling) -> Array:
        return np.asarray(Image.fromarray(picture).resize(size, by))

    counts = None if mask is None else np.where(mask, np.uint8(255), np.uint8(0))
    counted = None if counts is None else resized(counts, Image.Resampling.BOX) == 255
    return camera.resized(*size), resized(image, Image.Resampling.LANCZOS), counted


def _rounded(values: Array) -> Array:
    """Values rounded to `DECIMALS`, float64, without a negative zero."""
    rounded: Array = np.round(values.astype(np.float64), DECIMALS) + 0.0
    return rounded


# How long a unit of a capture's world is, by the places (GPS) that its photographs name.
#
# A phone's places are metres off, so they do not move the cameras. But distances between far ones say how
# long a unit is, where the photographs lie further apart than their places err; which their own spread
# tells.

FEWEST = 5  # photographs that name a place
FAR = 0.5  # of the longest distance between two cameras: pairs that count
MOST_SPREAD = 0.2  # of the median: by which half of the far pairs may differ from each other
_GPS_IFD, _NORTH_OR_SOUTH, _LATITUDE, _EAST_OR_WEST, _LONGITUDE = 0x8825, 1, 2, 3, 4
_EQUATOR, _FLATTENED = 6_378_137.0, 6.694_379_990_14e-3  # of WGS 84: radius in metres, squared eccentricity


def metres_of(capture: Capture) -> float | None:
    """Metres a unit of `capture` by its photographs' places; None where they do not say so surely."""
    places = np.array([place(photo.path) for photo in capture.photos]).reshape(-1, 2)
    named = np.isfinite(places).all(1)
    if named.sum() < FEWEST:
        return None
    eyes = np.array([camera.position for camera in capture.cameras])[named]
    metres = metres_per_unit(eyes, places[named])
    if metres is None:
        log.info("the places (GPS) of %d photographs differ too much to say how long a unit is", named.sum())
    else:
        log.info("a unit is about %.3g m long by the places (GPS) of %d photographs", metres, named.sum())
    return metres


def metres_per_unit(eyes: Array, places: Array) -> float | None:
    """(K, 3) camera positions and (K, 2) latitudes and longitudes in degrees -> the median ratio of distances
    over far pairs; None where a quarter and three quarters of the pairs differ by more than `MOST_SPREAD`.

    Heights are left out, as most cameras know them badly: for a climb as steep as a stair that is an eighth
    too little.
    """
    apart = pdist(eyes)
    far = apart >= FAR * apart.max(initial=0)
    if not apart.any():
        return None
    low, middle, high = np.quantile(pdist(on_the_ground(places))[far] / apart[far], [0.25, 0.5, 0.75])
    sure = middle > 0 and high - low <= MOST_SPREAD * middle
    return float(middle) if sure else None


def on_the_ground(places: Array) -> Array:
    """(K, 2) latitudes and longitudes in degrees -> (K, 2) metres to the east and to the north of the first,
    for places within some kilometres, away from the poles."""
    latitude, longitude = np.radians(places).T
    bend = 1 - _FLATTENED * np.sin(latitude[0]) ** 2
    north = _EQUATOR * (1 - _FLATTENED) / bend**1.5 * (latitude - latitude[0])
    turn = (longitude - longitude[0] + math.pi) % (2 * math.pi) - math.pi  # also over the date line
    return np.stack([_EQUATOR / math.sqrt(bend) * math.cos(latitude[0]) * turn, north], 1)


def place(path: Path) -> tuple[float, float]:
    """Latitude and longitude of a photograph, degrees, north and east positive; NaN where it names none."""
    try:
        with opened(path) as picture:
            # What stands behind a PNG's pixels is read by decoding them all.
            if picture.format != "PNG" or "exif" in picture.info:
                return _place(picture.getexif())
    except PictureError:
        pass
    return math.nan, math.nan


def _place(exif: Exif) -> tuple[float, float]:
    tags = exif.get_ifd(_GPS_IFD)
    try:
        latitude = _degrees(tags[_LATITUDE]) * {"N": 1, "S": -1}[tags[_NORTH_OR_SOUTH]]
        longitude = _degrees(tags[_LONGITUDE]) * {"E": 1, "W": -1}[tags[_EAST_OR_WEST]]
    except (KeyError, TypeError, ValueError, ZeroDivisionError):  # absent, or not what the standard says
        return math.nan, math.nan
    known = abs(latitude) <= 90 and abs(longitude) <= 180 and (latitude, longitude) != (0, 0)
    return (latitude, longitude) if known else (math.nan, math.nan)


def _degrees(parts: tuple[float, float, float]) -> float:
    """Degrees, minutes and seconds as degrees."""
    degrees, minutes, seconds = map(float, parts)
    return degrees + minutes / 60 + seconds / 3600
