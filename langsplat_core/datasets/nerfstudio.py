"""Datasets with a ``transforms.json``, as nerfstudio and instant-ngp write it.

Poses are camera-to-world in OpenGL's frame (y up, looking along -z). An ``applied_transform`` has already
been applied to both poses and points, so the world is taken as it stands.
Layout: https://docs.nerf.studio/quickstart/data_conventions.html
"""

import math
import os
import reprlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import accumulate
from pathlib import Path, PureWindowsPath
from typing import Any

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.config import DatasetConfig
from langsplat_core.datasets.capture import Capture, develop, report_lost_points
from langsplat_core.datasets.intrinsics import BrownDistortion, Distortion, FisheyeDistortion, PhotoIntrinsics
from langsplat_core.datasets.photos import Photo, find_photos, finder, mask_beside
from langsplat_core.errors import FormatError, InputError, printable_line, quoted, report_loss, shortened
from langsplat_core.io.hostile import PHOTO_SUFFIXES, PictureError, picture_size, read_json_file
from langsplat_core.io.ply import read_cloud
from langsplat_core.progress import Progress
from langsplat_core.scene import FARTHEST

DISTORTING = ("k1", "k2", "k3", "k4", "p1", "p2")
OPENGL_TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
PERSPECTIVE = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")
OTHER_LENSES = ("ftheta_p0", "latlong", "equirectangular", "orthographic")  # instant-ngp's keys
JSON_LIMIT = 256 * 1024 * 1024  # bytes; a frame takes about 700
Json = dict[str, Any]


def load_nerfstudio(file: Path, config: DatasetConfig, progress: Progress) -> Capture:
    """Return the photographs and cameras that `file` lists; points only if it names a PLY.

    Those that are not among its "train_filenames" are held out from training. So are, of the synthetic scenes
    of NeRF, which list photographs apart, those of transforms_test.json, or else of transforms_val.json.
    """
    top = _content(file)
    if os.path.islink(file) and _photo_file(finder(file.parent), top["frames"][0]["file_path"]) is None:
        file = Path(os.path.realpath(file))  # its photographs are beside the file itself
    photos = _photos(file, top, held_out=False)
    others = (file.with_name(file.name.replace("_train", f"_{word}")) for word in ("test", "val"))
    held_out = next((other for other in others if other != file and other.is_file()), None)
    if held_out is not None:
        photos |= _photos(held_out, _content(held_out), held_out=True)
    try:  # a key of our own: nerfstudio's files do not state it
        metres = _number(top, "metres_per_unit") if top.get("metres_per_unit") is not None else None
        if metres is not None and metres <= 0:
            raise ValueError(f'"metres_per_unit" must be above 0, got {metres:g}')
    except ValueError as error:
        raise FormatError(f"{file}: {error}") from None
    points, colours = _points(file, top.get("ply_file_path"))
    capture = develop(list(photos.values()), config, progress, points, colours)
    # ours, of `python -m assets.making dataset`
    return replace(capture, metres_per_unit=metres, drawn=top.get("drawn") is True)


def _content(file: Path) -> Json:
    """Return the content of a transforms.json, which lists frames; FormatError."""
    top = read_json_file(file, JSON_LIMIT)
    frames = top.get("frames") if isinstance(top, dict) else None
    if not isinstance(frames, list) or not frames:
        raise FormatError(f'{file} has no list of "frames"; it is not a nerfstudio dataset')
    for number, frame in enumerate(frames):
        if not isinstance(frame, dict) or not isinstance(frame.get("file_path"), str):
            raise FormatError(f'{file}: frame {number} has no "file_path"; it is not a nerfstudio dataset')
    return dict(top)


def _photos(file: Path, top: Json, held_out: bool) -> dict[str, Photo]:
    """Return the photographs of a file's frames by their names, those that can be opened."""
    photos: dict[str, Photo] = {}
    missing: list[str] = []
    guessed: set[str] = set()
    find = finder(file.parent)
    training = _training_photos(file, top, find)
    for number, frame in enumerate(top["frames"]):
        where = f"{file}: frame {number}"
        label = frame["file_path"]
        if (path := _photo_file(find, label)) is None:
            missing.append(label)
            continue
        try:
            size = picture_size(path)
        except PictureError as error:
            missing.append(f"{label} ({error.reason})")
            continue
        try:
            mask = _mask_file(find, frame) or mask_beside(path)
            lens, pose = _lens({**top, **frame}, size), _pose(frame)
        except ValueError as error:
            raise FormatError(f"{where} ({printable_line(label, 60)}): {error}") from None
        guessed.update(_guesses({**top, **frame}))
        apart = held_out or (bool(training) and path not in training)
        photo = Photo(path, label, lens, pose, mask=mask, held_out=apart)
        if not np.array_equal(photos.setdefault(label, photo).world_to_camera, pose):
            guessed.add("photographs are listed twice, of which the last counts")
        photos[label] = photo
    if missing:
        lost = f"{len(missing)} of {len(top['frames'])} photographs in {file.name} cannot be opened"
        if not photos and not held_out:
            raise InputError(f"{file}: {lost}: {shortened(missing)}; its paths begin at its folder")
        report_loss("%s and are left out: %s", lost, shortened(missing))
    if not held_out and (beside := _without_camera(photos, top["frames"])):
        guessed.add(f"{len(beside)} photographs beside its own have no camera: {shortened(beside)}")
    for what in sorted(guessed):
        report_loss("%s: %s", file, what)
    return photos


def _training_photos(file: Path, top: Json, find: Callable[[str], Path]) -> set[Path | None]:
    """Return the photographs that a file lists for training; none: all are. FormatError."""
    names = top.get("train_filenames") or []
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise FormatError(f'{file}: "train_filenames" is no list of names')
    found = {_photo_file(find, name) for name in names}
    if names and found.isdisjoint(_photo_file(find, frame["file_path"]) for frame in top["frames"]):
        raise FormatError(f'{file}: "train_filenames" names none of its frames; mend or remove it')
    return found


def _without_camera(photos: Mapping[str, Photo], frames: Sequence[Json]) -> set[str]:
    """Return the names of photographs beside `photos` that no frame names and that are not made of these."""
    known = {PureWindowsPath(frame["file_path"]).stem for frame in frames}
    known |= {photo.path.stem for photo in photos.values()}
    folders = {photo.path.parent for photo in photos.values()}
    beside = (path for folder in folders for path in find_photos(folder))
    # r_1_depth_0001 is made of the photograph r_1.
    return {p.name for p in beside if known.isdisjoint(accumulate(p.stem.split("_"), "{}_{}".format))}


TOGETHER = ("fl_x", "fl_y"), ("cx", "cy"), ("w", "h")  # keys of which a file has all or none
OF_LENSES = ("k1", "k2", "p1", "p2"), ("k1", "k2", "k3", "k4")  # perspective, fisheye: it has one of these


def _guesses(values: Json) -> Iterator[str]:
    """Yield what had to be guessed of a lens; the field of view alone is a whole one."""
    known = values.keys()
    is_whole_lens = any(known >= set(keys) for keys in OF_LENSES)
    for keys in TOGETHER if is_whole_lens else (*TOGETHER, *OF_LENSES):
        absent = [key for key in keys if key not in known]
        if absent == ["fl_y"] and "camera_angle_y" in known:
            continue
        if 0 < len(absent) < len(keys):
            yield f"{', '.join(absent)} not given: taken from the others, or as none"
    if "fl_x" in known and not known & {"cx", "cy"}:
        yield "cx and cy not given: the middle of the photograph is taken"
    told = known & {"camera_model", "is_fisheye"} or known >= {"k1", "k2", "p1", "p2"}  # instant-ngp's keys
    if any(values.get(key) for key in DISTORTING) and not told:
        yield "camera_model not given: OPENCV is taken"


def _photo_file(find: Callable[[str], Path], label: str) -> Path | None:
    """Return the photograph called `label`, None for none; some datasets leave its suffix away."""
    for suffix in ("", *PHOTO_SUFFIXES):
        # Unlike Path.is_file, also no for names that no file system could hold.
        if os.path.isfile(candidate := find(f"{label}{suffix}")):
            return candidate
    return None


def _mask_file(find: Callable[[str], Path], frame: Json) -> Path | None:
    if (label := frame.get("mask_path")) is None:
        return None
    if not isinstance(label, str) or not os.path.isfile(find(label)):
        raise ValueError(f'"mask_path" names no file: {reprlib.repr(label)}')
    return find(label)


def _number(values: Json, key: str, default: float | None = None) -> float:
    value = values.get(key, default)
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < 1e15:
        raise ValueError(f'"{key}" must be a finite number, got {reprlib.repr(value)}')
    return float(value)


def _lens(values: Json, size: tuple[int, int]) -> PhotoIntrinsics:
    """Return the lens of merged top-level and per-frame values; `size` counts where they give none."""
    width, height = (round(_number(values, key, default)) for key, default in zip("wh", size, strict=True))
    fx = _focal(values, "x", width, None)
    fy = _focal(values, "y", height, fx)
    cx, cy = _number(values, "cx", width / 2), _number(values, "cy", height / 2)
    return PhotoIntrinsics(width, height, fx, fy, cx, cy, _distortion(values))


def _focal(values: Json, axis: str, side: int, default: float | None) -> float:
    """Return the focal length in pixels, from ``fl_*`` or the field of view ``camera_angle_*``, radians."""
    if f"fl_{axis}" in values:
        return _number(values, f"fl_{axis}")
    if f"camera_angle_{axis}" in values:
        angle = _number(values, f"camera_angle_{axis}")
        if not 0 < angle < math.pi:
            raise ValueError(f'"camera_angle_{axis}" must lie between 0 and pi, got {angle}')
        return 0.5 * side / math.tan(0.5 * angle)
    if default is None:
        raise ValueError(f'neither "fl_{axis}" nor "camera_angle_{axis}" is given')
    return default


def _distortion(values: Json) -> Distortion:
    model = values.get("camera_model", "OPENCV")
    k1, k2, k3, k4, p1, p2 = (_number(values, key, 0.0) for key in DISTORTING)
    if others := [key for key in OTHER_LENSES if values.get(key, False) is not False]:
        raise ValueError(f'"{others[0]}" is of a lens that is not read; undistort the photographs first')
    if model == "OPENCV_FISHEYE" or values.get("is_fisheye") is True:
        return FisheyeDistortion(k1, k2, k3, k4)
    if model not in PERSPECTIVE:
        raise ValueError(f"camera_model {quoted(model)} is none of {', '.join(PERSPECTIVE)}, OPENCV_FISHEYE")
    if k4 != 0:
        raise ValueError('"k4" has no agreed meaning for a perspective lens; undistort the photographs first')
    return BrownDistortion(k1, k2, p1, p2, k3)


def _pose(frame: Json) -> Array:
    """Return the (4, 4) world-to-camera matrix in OpenCV's frame."""
    try:
        matrix = np.array(frame.get("transform_matrix"), np.float64)
    except (TypeError, ValueError, OverflowError):  # whole numbers have no limit in JSON
        matrix = np.empty(0)
    if matrix.shape not in ((4, 4), (3, 4)) or not (np.abs(matrix) <= FARTHEST).all():
        raise ValueError(f'"transform_matrix" must be 4x4 numbers, none beyond {FARTHEST:g}')
    camera_to_world = np.eye(4)
    camera_to_world[:3] = matrix[:3]
    # Rotations lose their last digits in text; anything further off is no rotation.
    left, stretch, right = np.linalg.svd(camera_to_world[:3, :3])
    if np.abs(stretch - 1).max() > 1e-2 or np.linalg.det(left @ right) < 0:
        raise ValueError('"transform_matrix" is not a rotation with a translation')
    camera_to_world[:3, :3] = left @ right
    return np.linalg.inv(camera_to_world @ OPENGL_TO_OPENCV)


def _points(file: Path, name: object) -> tuple[Array, Array]:
    """Return (M, 3) float64 points and (M, 3) uint8 colours of the PLY; none if there is none."""
    none = np.zeros((0, 3)), np.zeros((0, 3), np.uint8)
    if not isinstance(name, str) or not name:
        return none
    path = file.parent / name
    if not os.path.isfile(path):
        report_loss("%s names the points %s, which do not exist", file.name, quoted(name))
        return none
    try:
        points, colours = read_cloud(path)
    except FormatError as error:
        raise FormatError(f"{error}; mend it or remove ply_file_path from {file.name}") from None
    finite = np.asarray(np.isfinite(points).all(1))
    report_lost_points(finite, path.name)
    return points[finite], colours[finite]
