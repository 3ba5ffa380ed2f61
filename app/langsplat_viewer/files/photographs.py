"""The photograph of a training camera: where it lies, and its pixels. No window here."""

from dataclasses import dataclass
from itertools import islice
from pathlib import Path, PurePath

import numpy as np
from PIL import Image, ImageOps

from langsplat_core.arrays import Array
from langsplat_core.errors import InputError, printable_line
from langsplat_core.io.hostile import PHOTO_SUFFIXES, opened
from langsplat_core.scene import Camera

LONGEST_SIDE = 2048  # pixels of what is kept: more than an area of a window has
MOST_FILES = 20_000  # of a folder that are looked at
ASPECT_TOLERANCE = 0.02  # shrunk copies round their sizes


@dataclass(frozen=True, eq=False)
class Photograph:
    """The photograph of one camera, or the reason why there is none."""

    camera: Camera
    folder: str  # that was chosen when it was looked for, "" for none
    image: Array | None = None  # (H, W, 3) uint8, row 0 on top; None while it is read and without one
    reason: str = ""


def places(scene: Path) -> tuple[Path, ...]:
    """Folders in which the photographs of a scene usually lie."""
    trained_from = scene.with_suffix("")  # as the panel "Train" names a scene
    beside = scene.parent
    return trained_from / "images", trained_from, beside / "images", beside


def find(name: str, scene: Path, folder: str) -> Path:
    """The photograph of the camera `name`: in the chosen `folder` or the folders in it, or where photographs
    usually lie. InputError where it is in none of them."""
    if not name:
        raise InputError("this camera does not name its photograph")
    looked_in = (Path(folder),) if folder else places(scene)
    for place in looked_in:
        paths = place.rglob("*") if folder else place.glob("*")
        try:
            photographs = [p for p in islice(paths, MOST_FILES) if p.suffix.lower() in PHOTO_SUFFIXES]
        except OSError:  # it may not be looked into
            continue
        found = [path for path in sorted(photographs) if name in _names(path.relative_to(place))]
        if found:
            return found[0]
    where = folder or f"{scene.parent} and its folders images and {scene.stem}"
    raise InputError(f"no photograph '{printable_line(name, 60)}' in {where}")


def _names(path: PurePath) -> set[str]:
    """Return the names that a camera of this photograph may have: training names cameras by the stem, where
    two have the same by the path."""
    whole = path.with_suffix("").as_posix()
    return {path.stem, whole, whole.replace("/", "_")}


def read(path: Path, camera: Camera) -> Array:
    """(H, W, 3) uint8, at most `LONGEST_SIDE` pixels long, turned as its EXIF data ask where only that fits
    the camera. Raises InputError."""
    with opened(path) as stored:
        stored.draft("RGB", (LONGEST_SIDE, LONGEST_SIDE))
        picture: Image.Image = stored
        if not _fits(picture.size, camera):
            picture = ImageOps.exif_transpose(picture)
        if not _fits(picture.size, camera):
            width, height = picture.size
            raise InputError(
                f"{path} has {width}x{height} pixels, its camera {camera.width}x{camera.height}: "
                "another shape"
            )
        if picture.mode.startswith("I"):  # 16 bits; Pillow's own conversion would clip
            picture = Image.fromarray((np.asarray(picture) >> 8).astype(np.uint8))
        picture = picture.convert("RGB")
        picture.thumbnail((LONGEST_SIDE, LONGEST_SIDE))
        return np.asarray(picture)


def _fits(size: tuple[int, int], camera: Camera) -> bool:
    return abs(size[0] * camera.height / (size[1] * camera.width) - 1) < ASPECT_TOLERANCE


def corners(camera: Camera, shown: Camera) -> tuple[float, float, float, float]:
    """Left, top, right and bottom of a camera's photograph in the image of another with the same pose, in
    pixels of the latter."""
    x, y = shown.fx / camera.fx, shown.fy / camera.fy
    left, top = shown.cx - camera.cx * x, shown.cy - camera.cy * y
    return left, top, left + camera.width * x, top + camera.height * y
