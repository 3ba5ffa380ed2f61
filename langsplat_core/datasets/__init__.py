"""Photographs with cameras: COLMAP's, nerfstudio's, or found from the photographs."""

import os
from dataclasses import replace
from pathlib import Path

from langsplat_core.config import DatasetConfig, check_settings
from langsplat_core.datasets.capture import Capture, centred, split_views, with_taken
from langsplat_core.datasets.colmap import find_model, load_colmap
from langsplat_core.datasets.nerfstudio import load_nerfstudio
from langsplat_core.datasets.photos import photo_folder, say_unread
from langsplat_core.datasets.sfm import add_points, load_photos
from langsplat_core.datasets.video import kept_frames
from langsplat_core.errors import STRICTNESS, InputError
from langsplat_core.io.files import shown
from langsplat_core.io.hostile import is_video
from langsplat_core.progress import Progress, silent

__all__ = ["Capture", "load_capture", "load_photographs"]

TRANSFORMS = ("transforms.json", "transforms_train.json")
ACCEPTED = (
    "a folder with transforms.json (nerfstudio) or that file, a folder with sparse/0 and images (COLMAP), "
    "a folder of at least three photographs (jpg, png, webp, tif, bmp, avif, heic), or a video"
)


def load_capture(path: Path, config: DatasetConfig, work: Path, progress: Progress = silent) -> Capture:
    """Return undistorted photographs of at most ``config.max_side`` pixels, their cameras and points.

    Recognises, in this order, a nerfstudio ``transforms.json``, a COLMAP model, and plain photographs, whose
    cameras are found by structure from motion, kept in ``work/sfm-*``. Without points, some are triangulated.
    The world is the dataset's own, about `Capture.origin` where that is far off; `config`, the dataset or
    the places (GPS) of the photographs tell how long its unit is. InputError where nothing usable remains.
    """
    capture = load_photographs(path, config, work, progress)
    metres = config.metres_per_unit or capture.metres_per_unit
    capture = with_taken(replace(capture, metres_per_unit=metres))
    if len(capture.points):
        return capture
    return add_points(capture, split_views(capture, config)[0], work, progress)


def check_dataset(path: Path) -> None:
    """Raise InputError unless what may be a dataset, by names alone, lies at `path`."""
    if not os.path.exists(path) or (path.is_dir() and not os.listdir(path)):  # Path.exists may raise
        raise InputError(f"{shown(path)} does not exist or is empty; expected {ACCEPTED}")
    marks = *TRANSFORMS, "sparse", "colmap", "cameras.bin", "cameras.txt"
    signs = any((path / name).exists() for name in marks)
    if not (signs or path.suffix.lower() == ".json" or is_video(path) or photo_folder(path)[1]):
        raise InputError(f"{shown(path)} is no dataset; expected {ACCEPTED}")


def load_photographs(path: Path, config: DatasetConfig, work: Path, progress: Progress = silent) -> Capture:
    """Return what `load_capture` does, with the points and the scale that the dataset states, or none."""
    path = Path(path)
    STRICTNESS.said.clear()
    check_settings(config, "--dataset.")
    try:
        check_dataset(path)
        listed = [path] if path.suffix.lower() == ".json" else [path / name for name in TRANSFORMS]
        if (frames := next(filter(Path.is_file, listed), None)) is not None:
            return centred(load_nerfstudio(frames, config, progress))
        if (model := find_model(path)) is not None:
            return centred(load_colmap(path, model, config, progress))
        if is_video(path):
            path = kept_frames(path, config.frames, work, progress)
        folder, photos = photo_folder(path)
        say_unread(path, folder, photos)
        return load_photos(folder, photos, config, work, progress)
    except PermissionError as error:
        raise InputError(f"{error.filename}: may not be read ({error.strerror}); see to its rights") from None
