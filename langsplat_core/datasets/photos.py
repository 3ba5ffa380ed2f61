"""Photographs on disk: finding them, reading them whatever their kind, and resampling them to pinholes."""

import hashlib
import logging
import math
import os
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import datetime
from functools import cache, lru_cache
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple
from unicodedata import normalize

import numpy as np
from PIL import ExifTags, Image, ImageOps

from langsplat_core.arrays import Array
from langsplat_core.config import DatasetConfig
from langsplat_core.datasets.colour import as_srgb, coded_as
from langsplat_core.datasets.intrinsics import PhotoIntrinsics, pinhole_for, resample, source_positions
from langsplat_core.errors import InputError, Tell, report_loss, shortened
from langsplat_core.io import hostile
from langsplat_core.scene import Camera

ASPECT_TOLERANCE = 0.02  # shrunk copies round their sizes
WORKERS = 2  # decoding and resampling release the interpreter; more would only hold more pixels

log = logging.getLogger("langsplat")


@dataclass(frozen=True, eq=False)
class Photo:
    """A photograph on disk and the camera it was taken with."""

    path: Path
    label: str  # path inside the dataset, "/" between its parts
    intrinsics: PhotoIntrinsics
    world_to_camera: Array  # (4, 4) float64, rigid
    upright: bool = False  # the lens describes the photograph turned as its EXIF data ask
    mask: Path | None = None  # an image of the same shape, black where the photograph does not count
    held_out: bool = False  # its dataset says that it is not for training


# Finding them.


CAMERA_FILES = ("images.txt", ".bin", ".csv", ".json", ".npy", ".nvm", ".out", ".xml")  # ends of names
NAMED, MASKS = ("images", "photos"), ("masks", "mask")  # folders of a dataset
DEEP = 3  # levels of folders: a phone's photographs lie in DCIM/100APPLE


def find_photos(folder: Path, below: int = 0, ends: tuple[str, ...] = hostile.PHOTO_SUFFIXES) -> list[Path]:
    """Return photographs (`ends` of names) in `folder`, by name, and in levels `below` it; none hidden."""
    if not folder.is_dir():
        return []
    listed = sorted(path for path in folder.iterdir() if path.name[0] != ".")
    found = [path for path in listed if path.name.lower().endswith(ends) and path.is_file()]
    # Work folders hold copies of photographs.
    inside = (path for path in listed if below and path.name not in MASKS and path.suffix != ".work")
    return found + [photo for path in inside for photo in find_photos(path, below - 1, ends)]


def content(path: Path) -> str:
    """Return a digest of a file's content, the same for copies; empty if it may not be read."""
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError:
        return ""


def photo_folder(folder: Path) -> tuple[Path, list[Path]]:
    """Return the folder of the photographs of a dataset, and these; none where there are none.

    That is `folder` itself or a folder "images" or "photos" in it; else photographs lie in folders of those.
    """
    named = [folder / name for name in NAMED]
    for below, candidates in ((0, (folder, *named)), (DEEP, (*named, folder))):
        for candidate in candidates:
            if photos := find_photos(candidate, below):
                return candidate, photos
    return folder, []


def count_photographs(dataset: Path) -> int:
    """Return the number of photographs in a dataset, 0 where it cannot be read; of a video the default."""
    with suppress(OSError):
        if hostile.is_video(dataset):
            return DatasetConfig.frames
        folder = dataset if dataset.is_dir() else dataset.parent
        return len(find_photos(folder / "images") or photo_folder(folder)[1])
    return 0


def say_unread(dataset: Path, folder: Path, photos: Sequence[Path]) -> None:
    """Say which cameras of a dataset, and photographs and videos in and beside `folder`, are not read."""
    known, stems = set(photos), {photo.with_suffix("") for photo in photos}
    more = [path.relative_to(folder).as_posix() for path in find_photos(folder, DEEP) if path not in known]
    beside = [path for at in {photo.parent for photo in photos} for path in at.iterdir()]
    live = [path for path in beside if hostile.is_video(path) and path.with_suffix("") in stems]
    videos = sorted(path.name for path in beside if hostile.is_video(path) and path not in live)
    if lost := sorted(path.name for path in beside if path.name[0] != "." and not os.path.exists(path)):
        report_loss("%d links beside the photographs lead nowhere: %s", len(lost), shortened(lost))
    files = (file for file in find_photos(dataset, DEEP, CAMERA_FILES) if not file.match("*.*.json"))  # ours
    if given := [file.relative_to(dataset).as_posix() for file in files]:
        what = "may hold cameras and are not read; cameras are found anew, in a world of their own"
        log.warning("%d files %s: %s", len(given), what, shortened(given))
    if live:
        log.info("%d videos of Live Photos are not read, their stills are", len(live))
    if videos:
        log.warning("%d videos are not read, train each by itself: %s", len(videos), shortened(videos))
    if more:
        what = f"are not read: {shortened(more)}; move them beside the others if they belong to them"
        log.warning("%d photographs in other folders %s", len(more), what)


def finder(folder: Path) -> Callable[[str], Path]:
    r"""Return a function from the name of a file, as written in another file of `folder`, to its path.

    Folders stand before "/" or "\\"; accents may be composed or not (NFC, NFD), in the name and on disk.
    """

    @cache
    def listed(inside: Path) -> dict[str, str]:
        with suppress(OSError, ValueError):
            return {
                normalize("NFC", hostile.decode_name(os.fsencode(name))): name for name in os.listdir(inside)
            }
        return {}

    def find(label: str) -> Path:
        path = folder / label
        if not os.path.lexists(path):
            path = folder
            for part in PurePosixPath(label.replace("\\", "/")).parts:
                there = os.path.lexists(path / part)
                path /= part if there else listed(path).get(normalize("NFC", part), part)
        return path

    return find


def mask_beside(photo: Path) -> Path | None:
    """Return a photograph's mask: NAME.jpg.png or NAME.png in masks or masks/FOLDER, in or beside FOLDER."""
    folder, above = photo.parent, photo.parent.parent
    places = [(at, folder.name) for at in (above.parent, above)] + [(folder, ""), (above, "")]
    folders = [at / word / inside for at, inside in places for word in MASKS]
    candidates = (folder / name for folder in folders for name in (f"{photo.name}.png", f"{photo.stem}.png"))
    # os.path.isfile, unlike Path.is_file, also says no to names that no file system could hold.
    return next((path for path in candidates if path != photo and os.path.isfile(path)), None)


def stray_masks(photos: Sequence[Photo]) -> list[str]:
    """Return the names of images in folders of masks that belong to no photograph."""
    folders = {photo.path.parent for photo in photos}
    named = {at.parent for folder in folders for at in (folder, folder.parent) if at.name in NAMED}
    beside = [folder / word for folder in folders | named for word in MASKS]
    used = {photo.mask for photo in photos} | {photo.path for photo in photos}
    unused = [mask for folder in beside for mask in find_photos(folder, 1) if mask not in used]
    alike = (photo for folder in folders if unused for photo in find_photos(folder))
    known = {name for photo in alike for name in (photo.name, photo.stem)}
    return [mask.name for mask in unused if mask.suffix != ".png" or mask.stem not in known]


def unique_names(labels: Sequence[str]) -> list[str]:
    """Return file stems where those differ, else paths with "_" for "/" and for the suffix's dot."""
    labels = [label.replace("\\", "/") for label in labels]
    stems = [PurePosixPath(label).stem for label in labels]
    paths = [str(PurePosixPath(label).with_suffix("")).replace("/", "_") for label in labels]
    for names in (stems, paths):
        if len(set(names)) == len(names):
            return names
    return [label.replace("/", "_").replace(".", "_") for label in labels]


# EXIF data: the focal length, as COLMAP learns of it, and when, where (GPS) and by what it was taken.

_MAKER, _MODEL, _CHANGED, _TAKEN = 0x010F, 0x0110, 0x0132, 0x9003
_FOCAL, _FOCAL_ON_FILM = 0x920A, 0xA405  # mm; mm of a lens with the same view on film of 36 x 24 mm
_PLANE_X, _PLANE_UNIT, _WIDTH = 0xA20E, 0xA210, 0xA002  # pixels per unit on the sensor; the unit; pixels
_MILLIMETRES = {2: 25.4, 3: 10.0, 4: 1.0}  # of the unit


def optics(path: Path) -> Image.Exif:
    """Return only those EXIF data that tell the focal length.

    Other tags, such as the orientation, would be wrong for a copy. Pixels per inch of a sensor become the
    length on film: COLMAP would compare them with the size of the image, which is another for a copy.
    """
    kept = Image.Exif()
    with suppress(hostile.PictureError), hostile.opened(path) as image:
        source = image.getexif()
        kept.update({tag: source[tag] for tag in (_MAKER, _MODEL) if tag in source})
        inner = source.get_ifd(ExifTags.IFD.Exif)
        lens = {tag: inner[tag] for tag in (_FOCAL, _FOCAL_ON_FILM) if inner.get(tag)}
        lens = _on_film(inner, image.size) | lens
        kept.get_ifd(ExifTags.IFD.Exif).update(lens)
        kept.tobytes()
        return kept
    return Image.Exif()


def _on_film(inner: dict[int, Any], size: tuple[int, int]) -> dict[int, int]:
    """Return the focal length on film of an image of `size`, from the one on a sensor of known pixels."""
    try:
        width = inner.get(_WIDTH, size[0]) * _MILLIMETRES[inner.get(_PLANE_UNIT, 2)] / inner[_PLANE_X]
        diagonal = width * math.hypot(*size) / size[0]
        length = float(inner[_FOCAL] / diagonal * math.hypot(36, 24))
    except (KeyError, TypeError, ValueError, ZeroDivisionError):  # absent, or not what the standard says
        return {}
    return {_FOCAL_ON_FILM: round(length)} if 1 <= length <= 5_000 else {}  # mm, of any lens that is sold


@dataclass(frozen=True)
class ExifFacts:
    """When, where and by what a photograph was taken, as far as its EXIF data say."""

    taken: datetime | None = None  # by the camera's clock
    place: tuple[float, float] = (math.nan, math.nan)  # latitude, longitude: degrees, north and east positive
    camera: str = ""  # maker and model


def exif_facts(path: Path) -> ExifFacts:
    """Return when, where and by what a photograph was taken; fields stay empty without readable EXIF data."""
    exif, inner, places = Image.Exif(), dict[int, Any](), dict[int, Any]()
    with suppress(hostile.PictureError), hostile.opened(path) as image:
        if image.format != "PNG" or "exif" in image.info:  # behind a PNG's pixels it is read by decoding them
            exif = image.getexif()
            inner, places = exif.get_ifd(ExifTags.IFD.Exif), exif.get_ifd(ExifTags.IFD.GPSInfo)
    taken, place = None, (math.nan, math.nan)
    with suppress(TypeError, ValueError):  # absent, or not what the standard says
        taken = datetime.strptime(str(inner.get(_TAKEN) or exif.get(_CHANGED)), "%Y:%m:%d %H:%M:%S")
    with suppress(KeyError, TypeError, ValueError, ZeroDivisionError):
        latitude = _degrees(places[2]) * {"N": 1, "S": -1}[places[1]]
        longitude = _degrees(places[4]) * {"E": 1, "W": -1}[places[3]]
        if abs(latitude) <= 90 and abs(longitude) <= 180 and (latitude, longitude) != (0, 0):
            place = latitude, longitude
    return ExifFacts(taken, place, " ".join(str(exif[tag]) for tag in (_MAKER, _MODEL) if tag in exif))


def _degrees(parts: Any) -> float:
    degrees, minutes, seconds = map(float, parts)
    return degrees + minutes / 60 + seconds / 3600


# Reading them.


def read_photo(path: Path, upright: bool, tell: Tell = lambda _: None) -> Image.Image:
    """Return an RGB image of sRGB colours, or RGBA where a pixel is transparent; 16 bits become 8.

    With `upright` it is turned as its EXIF data ask; unreadable EXIF data count as none. Images above
    `MOST_PIXELS` are reduced as they are read. tell: is told what was guessed. Raises PictureError.
    """
    with hostile.opened(path, most=hostile.MOST_PIXELS_REDUCED) as stored:
        image: Image.Image = stored
        coded = coded_as(stored)
        if large := stored.width * stored.height > hostile.MOST_PIXELS:
            stored.draft(None, (stored.width // 2, stored.height // 2))
        if upright:
            stored.load()  # so that nothing but the EXIF data can fail below
            try:
                image = ImageOps.exif_transpose(stored)
            except Exception:  # noqa: BLE001  Pillow's parser lets through what damaged tags cause
                image = stored.copy()
        if large and image.width * image.height > hostile.MOST_PIXELS:
            image = image.reduce(2)
        if image.mode.startswith("I") or image.mode == "F":  # Pillow's own conversion would clip
            image = _of_8_bits(image, path, tell)
        shown = as_srgb(image, coded, tell)
        if image.has_transparency_data:
            alpha = image.convert("RGBA").getchannel("A")
            if alpha.getextrema() != (255, 255):
                shown.putalpha(alpha)
        return shown


def _of_8_bits(image: Image.Image, path: Path, tell: Tell) -> Image.Image:
    """Return a grey image of 16 bits as one of 8; it counts as 12 bits if no pixel has more."""
    values = np.asarray(image)
    if image.mode == "F" or not 0 <= values.min(initial=0) <= values.max(initial=0) <= 65535:
        raise hostile.PictureError(path, "more than 16 bits per channel")
    most = int(values.max(initial=0))
    if 255 < most <= 4095:
        tell("no value is above 4095 of 65535, and 12 bits are taken for white")
    white = 4095 if 255 < most <= 4095 else 65535
    shades = (values.astype(np.uint32) * 255 + white // 2) // white
    grey = Image.fromarray(shades.astype(np.uint8))
    grey.info = image.info
    return grey


def over_black(image: Image.Image) -> Image.Image:
    """Return an RGB image without its transparency."""
    if image.mode != "RGBA":
        return image
    return Image.alpha_composite(Image.new("RGBA", image.size, (0, 0, 0, 255)), image).convert("RGB")


def _read_for(photo: Photo, tell: Tell) -> tuple[Image.Image, PhotoIntrinsics]:
    """Read a photograph, and return its intrinsics on the pixel grid of the file.

    COLMAP reads pixels as stored, other tools turn them first: the one whose shape fits the lens is meant.
    """
    intrinsics = photo.intrinsics
    image = read_photo(photo.path, photo.upright, tell)
    if not photo.upright and not _fits(image.size, intrinsics):
        image = read_photo(photo.path, upright=True)
    if not _fits(image.size, intrinsics):
        raise InputError(
            f"{photo.path} is {image.width}x{image.height} pixels but its camera is "
            f"{intrinsics.width}x{intrinsics.height}; use the photographs that the cameras were computed from"
        )
    try:
        return image, intrinsics.resized(*image.size)
    except ValueError as error:  # a camera of one or two pixels, at the edge of what a lens may be
        raise InputError(f"{photo.path}: {error}; export the cameras again") from None


def _fits(size: tuple[int, int], intrinsics: PhotoIntrinsics) -> bool:
    ratio = (size[0] * intrinsics.height) / (size[1] * intrinsics.width)
    off = max(abs(size[0] - intrinsics.width), abs(size[1] - intrinsics.height))
    return abs(ratio - 1) < ASPECT_TOLERANCE or off <= 1


def _read_mask(path: Path, size: tuple[int, int]) -> Image.Image:
    """Return the mask of a photograph of `size` pixels, resized to it; InputError if its shape differs."""
    mask = over_black(read_photo(path, upright=False))
    if np.asarray(mask).max(initial=0) == 1:  # of 0 and 1
        mask = mask.point(lambda value: 255 * value)
    if abs(mask.width * size[1] / (mask.height * size[0]) - 1) > ASPECT_TOLERANCE:
        raise InputError(
            f"{path}: is {mask.width}x{mask.height} pixels, its photograph {size[0]}x{size[1]}; a mask has "
            "the shape of the photograph as it is shown"
        )
    return mask.resize(size, Image.Resampling.NEAREST)


# A pinhole, its (H, W, 3) uint8 image, and its (H, W) bool pixels that count (None: all).
View = tuple[Camera, Array, Array | None]
OPAQUE, SOLID = 250, 5  # alpha, of 255, from which a pixel is opaque, and from which it shows anything


class Developed(NamedTuple):
    """A photograph resampled to a pinhole."""

    camera: Camera
    image: Array  # (H, W, 3) uint8
    mask: Array | None  # (H, W) bool pixels that count by its mask; None: all
    alpha: Array | None  # (H, W) uint8; None: opaque

    def view(self, cut_out: bool) -> View:
        """Return its view, whose pixels count where they are opaque, with `cut_out` where partly so, too."""
        if self.alpha is None:
            return self.camera, self.image, self.mask
        solid = np.asarray(self.alpha >= (SOLID if cut_out else OPAQUE))
        return self.camera, self.image, solid if self.mask is None else self.mask & solid


class Developer:
    """Reads photographs, and resamples them to pinholes of at most `max_side` px."""

    def __init__(self, max_side: int) -> None:
        # Photographs of one lens share its pinhole and its map; a few maps are kept, not one per photograph.
        @lru_cache(maxsize=4)
        def plan(intrinsics: PhotoIntrinsics) -> tuple[Camera, Array | None]:
            camera = pinhole_for(intrinsics, max_side)
            return camera, None if intrinsics.distortion is None else source_positions(intrinsics, camera)

        self._plan = plan

    def __call__(self, photo: Photo, tell: Tell = lambda _: None) -> Developed:
        """Develop a photograph; tell: is told what was guessed. Raises PictureError."""
        image, intrinsics = _read_for(photo, tell)
        camera, positions = self._plan(intrinsics)
        camera = replace(camera, world_to_camera=photo.world_to_camera)

        def shown(source: Image.Image) -> Array:
            return resample(source, intrinsics, camera, positions)

        alpha = shown(image.getchannel("A").convert("RGB"))[..., 0] if image.mode == "RGBA" else None
        mask = None if photo.mask is None else shown(_read_mask(photo.mask, image.size))[..., 0] >= 128
        return Developed(camera, shown(over_black(image)), mask, alpha)
