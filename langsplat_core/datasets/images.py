"""Photographs: finding them, reading them whatever their kind, and making pinhole pictures of them."""

import logging
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path, PurePosixPath

import numpy as np
from PIL import Image, ImageOps

from langsplat_core.arrays import Array
from langsplat_core.datasets.album import Album
from langsplat_core.datasets.intrinsics import PhotoIntrinsics
from langsplat_core.datasets.undistort import pinhole_for, resample, source_positions
from langsplat_core.errors import InputError, printable_line
from langsplat_core.parsing.pictures import PHOTO_SUFFIXES, PictureError, opened
from langsplat_core.progress import Progress
from langsplat_core.scene import Camera

log = logging.getLogger("langsplat")

ASPECT_TOLERANCE = 0.02  # shrunk copies round their sizes
WORKERS = 2  # decoding and resampling release the interpreter; more would only hold more pixels


@dataclass(frozen=True, eq=False)
class Photo:
    """A photograph on disk and the camera it was taken with."""

    path: Path
    label: str  # path inside the dataset, "/" between its parts
    intrinsics: PhotoIntrinsics
    world_to_camera: Array  # (4, 4) float64, rigid
    upright: bool = False  # the lens describes the photograph turned as its EXIF data ask


def find_photos(folder: Path) -> list[Path]:
    """Photographs directly in `folder`, by name; hidden files do not count."""
    if not folder.is_dir():
        return []
    found = (p for p in folder.iterdir() if p.suffix.lower() in PHOTO_SUFFIXES and p.name[0] != ".")
    return sorted(p for p in found if p.is_file())


def shortened(names: Iterable[str], limit: int = 5, width: int = 200) -> str:
    """``a, b, c and 4 more``, about `width` characters at most; long names lose their middle."""
    listed = sorted(names)
    rest = len(listed) - limit
    shown = printable_line(", ".join(printable_line(name, 80) for name in listed[:limit]), width)
    return shown + (f" and {rest} more" if rest > 0 else "")


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
    """An RGB picture; transparent pixels are laid over black, 16 bits become 8.

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
    """Turned as the EXIF data ask; unreadable EXIF data count as none."""
    picture.load()  # so that nothing but the EXIF data can fail below
    try:
        return ImageOps.exif_transpose(picture)
    except Exception:  # noqa: BLE001  Pillow's parser lets through what damaged tags cause
        return picture.copy()


def _read_for(photo: Photo) -> tuple[Image.Image, PhotoIntrinsics]:
    """The picture, and the photo's lens on its pixel grid.

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


def _fits(size: tuple[int, int], intrinsics: PhotoIntrinsics) -> bool:
    ratio = (size[0] * intrinsics.height) / (size[1] * intrinsics.width)
    return (
        abs(ratio - 1) < ASPECT_TOLERANCE
        or max(abs(size[0] - intrinsics.width), abs(size[1] - intrinsics.height)) <= 1
    )


def developer(max_side: int) -> Callable[[Photo], tuple[Camera, Array]]:
    """What makes a pinhole camera, yet without a name, and a (H, W, 3) uint8 picture of at most `max_side`
    pixels of a photograph. It raises PictureError for a file that cannot be read."""

    # Photographs of one lens share its pinhole and its map; a few maps are kept, not one per photograph.
    @lru_cache(maxsize=4)
    def plan(intrinsics: PhotoIntrinsics) -> tuple[Camera, Array | None]:
        camera = pinhole_for(intrinsics, max_side)
        return camera, None if intrinsics.distortion is None else source_positions(intrinsics, camera)

    def one(photo: Photo) -> tuple[Camera, Array]:
        picture, intrinsics = _read_for(photo)
        camera, positions = plan(intrinsics)
        pose = replace(camera, world_to_camera=photo.world_to_camera)
        return pose, resample(picture, intrinsics, camera, positions)

    return one


def develop(
    photos: Sequence[Photo], max_side: int, progress: Progress
) -> tuple[tuple[Camera, ...], tuple[Array, ...], tuple[Photo, ...]]:
    """Pinhole cameras and (H, W, 3) uint8 pictures of `photos`, sorted by name, and what each is made from.

    Files that cannot be read are reported once and left out; InputError when none is left.
    """
    if not photos:
        raise InputError("the dataset lists no photographs")
    names = unique_names([photo.label for photo in photos])
    order = sorted(range(len(photos)), key=names.__getitem__)
    read = developer(max_side)

    def one(index: int) -> tuple[Camera, Array, Photo] | str:
        photo = photos[index]
        try:
            camera, picture = read(photo)
        except PictureError as error:
            return f"{photo.label} ({error.reason})"
        return replace(camera, name=names[index]), picture, photo

    album = Album()
    done: list[tuple[Camera, Array, Photo]] = []
    broken: list[str] = []
    with ThreadPoolExecutor(WORKERS) as pool:
        for count, result in enumerate(pool.map(one, order), 1):
            if isinstance(result, str):
                broken.append(result)
            else:
                camera, picture, photo = result
                done.append((camera, album.keep(picture), photo))
            progress("reading photographs", count / len(order))
    if not done:
        raise InputError(f"no photograph can be read: {shortened(broken)}")
    if broken:
        log.warning("%d photographs cannot be read and are left out: %s", len(broken), shortened(broken))
    cameras, images, files = zip(*done, strict=True)
    return cameras, images, files
