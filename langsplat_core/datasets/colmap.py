"""Datasets with a COLMAP model: ``sparse/0`` (or another number) or ``sparse``, beside ``images``."""

import logging
import os
from pathlib import Path

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.datasets.capture import Capture, tell_of_lost_points
from langsplat_core.datasets.colmap_model import (
    ModelCamera,
    SparseModel,
    has_model,
    read_images,
    read_model,
)
from langsplat_core.datasets.images import Photo, develop, find_photos, shortened
from langsplat_core.datasets.intrinsics import (
    BrownDistortion,
    ColmapDistortion,
    Distortion,
    FisheyeDistortion,
    PhotoIntrinsics,
)
from langsplat_core.errors import FormatError, InputError, printable_line
from langsplat_core.files import shown
from langsplat_core.progress import Progress

log = logging.getLogger("langsplat")

# COLMAP's mapper drops points above 4 px itself, so only models that were made otherwise lose any here.
MAX_POINT_ERROR = 4.0  # pixels
_BROWN = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")
_FISHEYE = ("SIMPLE_FISHEYE", "FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "OPENCV_FISHEYE")
_INTRINSICS = ("fx", "fy", "cx", "cy")


def find_model(folder: Path) -> Path | None:
    """The folder of the COLMAP model of a dataset, if it has one.

    Photographs that COLMAP cannot place together end in several models, of which the first is not always the
    largest: that with most photographs is taken, of equal ones the first, and a warning says which.
    """
    sparse = folder / "sparse"
    inside = sorted(sparse.iterdir(), key=lambda f: (len(f.name), f.name)) if sparse.is_dir() else []
    found = [f for f in inside if has_model(f)]
    if len(found) < 2:
        return next((f for f in (*found, sparse) if has_model(f)), None)
    counts = [_photographs_of(f) for f in found]
    best = found[counts.index(max(counts))]
    if max(counts):
        each = ", ".join(f"{f.name}: {count}" for f, count in zip(found[:5], counts, strict=False))
        log.warning(
            "%s has %d models; %s is taken, which has most photographs (%s%s)",
            shown(sparse),
            len(found),
            printable_line(best.name, 60),
            printable_line(each, 200),
            ", ..." if len(found) > 5 else "",
        )
    return best


def _photographs_of(model_folder: Path) -> int:
    """How many a model has cameras for; none if it is damaged."""
    try:
        return len({image.name for image in read_images(model_folder)})
    except FormatError:
        return 0


def intrinsics_of(camera: ModelCamera) -> PhotoIntrinsics:
    """The lens of a COLMAP camera; ValueError if its focal length is impossible."""
    named = camera.named()
    fx, fy, cx, cy = (named[key] for key in _INTRINSICS)
    rest = {key: value for key, value in named.items() if key not in _INTRINSICS}
    distortion: Distortion
    if camera.model in _BROWN:
        distortion = BrownDistortion(**rest)
    elif camera.model in _FISHEYE:
        distortion = FisheyeDistortion(**rest)
    else:
        distortion = ColmapDistortion(camera.model, camera.params, fx, fy, cx, cy)
    return PhotoIntrinsics(camera.width, camera.height, fx, fy, cx, cy, distortion)


def load_colmap(folder: Path, model_folder: Path, max_side: int, progress: Progress) -> Capture:
    """The photographs of `folder` with the cameras and points of the model; see `load_capture`."""
    model = read_model(model_folder)
    photos = located_photos(model, _photo_folder(folder, model), model_folder)
    # os.path.isfile, unlike Path.is_file, also says no to names that no file system could hold.
    missing = {photo.label for photo in photos if not os.path.isfile(photo.path)}
    if missing and len(missing) == len(photos):
        raise InputError(
            f"{shown(model_folder)}: none of its {len(photos)} photographs exists "
            f"(first: {printable_line(photos[0].label, 60)}); put them into {shown(folder / 'images')}"
        )
    if missing:
        log.warning(
            "%d of %d photographs of the model do not exist and are left out: %s",
            len(missing),
            len(photos),
            shortened(missing),
        )
    there = [photo for photo in photos if photo.label not in missing]
    present = len(find_photos(_photo_folder(folder, model)))
    if 2 * len(there) < present:
        log.warning(
            "%s has cameras for only %d of the %d photographs beside it; another model may have more",
            shown(model_folder),
            len(there),
            present,
        )
    cameras, images, files = develop(there, max_side, progress)
    return Capture(cameras, images, *good_points(model), photos=files)


def _photo_folder(folder: Path, model: SparseModel) -> Path:
    """``images`` if it is there, else the dataset's own folder."""
    return folder / "images" if (folder / "images").is_dir() or not model.images else folder


def located_photos(model: SparseModel, photo_folder: Path, source: Path) -> list[Photo]:
    """The model's images as photographs in `photo_folder`; FormatError names `source` for a bad camera."""
    by_id = {}
    for camera_id, camera in model.cameras.items():
        try:
            by_id[camera_id] = intrinsics_of(camera)
        except ValueError as error:
            raise FormatError(f"{source}: camera {camera_id}: {error}; export the model again") from None
    by_name = {image.name: image for image in model.images}
    return [
        Photo(photo_folder / name, name, by_id[image.camera_id], image.world_to_camera)
        for name, image in by_name.items()
    ]


def good_points(model: SparseModel) -> tuple[Array, Array]:
    """(M, 3) points and (M, 3) colours without those that are plainly wrong: not finite, seen by a single
    image, or reprojected more than `MAX_POINT_ERROR` off. Unknown errors and tracks count as good."""
    good = np.isfinite(model.points).all(1)
    good &= ~(model.errors > MAX_POINT_ERROR)
    good &= model.track_lengths != 1
    tell_of_lost_points(good, "the COLMAP model")
    return model.points[good], model.colours[good]
