"""COLMAP's sparse models, binary or text, read by ourselves: pycolmap does not notice where a file ends
and fills cameras of a truncated one with whatever lies in memory.

Layout: https://colmap.github.io/format.html. Rigs and frames (COLMAP >= 3.12) add nothing here, because
images.bin still carries every image's own pose.
"""

import logging
import os
import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from langsplat_core.arrays import Array, number, rotation_matrices, whole_number
from langsplat_core.datasets.capture import (
    Capture,
    Photo,
    develop,
    find_photos,
    mask_beside,
    tell_of_lost_points,
)
from langsplat_core.datasets.intrinsics import (
    BrownDistortion,
    ColmapDistortion,
    Distortion,
    FisheyeDistortion,
    PhotoIntrinsics,
)
from langsplat_core.errors import FormatError, InputError, printable_line, shortened
from langsplat_core.io.files import shown
from langsplat_core.progress import Progress
from langsplat_core.scene import FARTHEST

Result = TypeVar("Result")

MOST_DIGITS = 20  # of a whole number of 64 bits

# id -> name and parameters, in file order
CAMERA_MODELS = {
    0: ("SIMPLE_PINHOLE", "f cx cy"),
    1: ("PINHOLE", "fx fy cx cy"),
    2: ("SIMPLE_RADIAL", "f cx cy k1"),
    3: ("RADIAL", "f cx cy k1 k2"),
    4: ("OPENCV", "fx fy cx cy k1 k2 p1 p2"),
    5: ("OPENCV_FISHEYE", "fx fy cx cy k1 k2 k3 k4"),
    6: ("FULL_OPENCV", "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6"),
    7: ("FOV", "fx fy cx cy omega"),
    8: ("SIMPLE_RADIAL_FISHEYE", "f cx cy k1"),
    9: ("RADIAL_FISHEYE", "f cx cy k1 k2"),
    10: ("THIN_PRISM_FISHEYE", "fx fy cx cy k1 k2 p1 p2 k3 k4 sx1 sy1"),
    11: ("RAD_TAN_THIN_PRISM_FISHEYE", "fx fy cx cy k0 k1 k2 k3 k4 k5 p0 p1 s0 s1 s2 s3"),
    12: ("SIMPLE_DIVISION", "f cx cy k"),
    13: ("DIVISION", "fx fy cx cy k"),
    14: ("SIMPLE_FISHEYE", "f cx cy"),
    15: ("FISHEYE", "fx fy cx cy"),
    16: ("EUCM", "fx fy cx cy alpha beta"),
}


@dataclass(frozen=True)
class ModelCamera:
    """A row of cameras.bin."""

    model: str  # name in CAMERA_MODELS
    width: int
    height: int
    params: tuple[float, ...]

    def named(self) -> dict[str, float]:
        """Parameters by name; a single focal length appears as both fx and fy."""
        keys = next(keys for name, keys in CAMERA_MODELS.values() if name == self.model)
        values = dict(zip(keys.split(), self.params, strict=True))
        if "f" in values:
            values["fx"] = values["fy"] = values.pop("f")
        return values


@dataclass(frozen=True, eq=False)
class ModelImage:
    """A row of images.bin, without its 2D points."""

    name: str
    camera_id: int
    world_to_camera: Array  # (4, 4) float64


@dataclass(frozen=True, eq=False)
class SparseModel:
    """Content of a COLMAP model."""

    cameras: dict[int, ModelCamera]
    images: list[ModelImage]
    points: Array  # (M, 3) float64 world units
    colours: Array  # (M, 3) uint8
    errors: Array  # (M,) float64 mean reprojection error, pixels; -1 where unknown
    track_lengths: Array  # (M,) int64 how many images see the point; 0 where unknown


def has_model(folder: Path) -> bool:
    """Return True where cameras and images lie in `folder`, both binary or both text."""
    return any(_complete(folder, suffix) for suffix in (".bin", ".txt"))


def _complete(folder: Path, suffix: str) -> bool:
    return all((folder / f"{part}{suffix}").is_file() for part in ("cameras", "images"))


def _suffix(folder: Path) -> str:
    if not has_model(folder):
        raise InputError(f"{folder} holds no cameras.bin and images.bin (or .txt)")
    return ".bin" if _complete(folder, ".bin") else ".txt"


def read_images(folder: Path) -> list[ModelImage]:
    """Read the images of the model in `folder` alone. FormatError where they are damaged."""
    suffix = _suffix(folder)
    return _guarded((_BINARY if suffix == ".bin" else _TEXT)[1], folder / f"images{suffix}")


def read_model(folder: Path) -> SparseModel:
    """Read the model in `folder`; binary is preferred. FormatError names the file that is broken."""
    suffix = _suffix(folder)
    read_cameras, _, read_points = _BINARY if suffix == ".bin" else _TEXT
    cameras = _guarded(read_cameras, folder / f"cameras{suffix}")
    images = read_images(folder)
    for image in images:
        if image.camera_id not in cameras:
            raise FormatError(
                f"{folder / f'images{suffix}'}: {printable_line(image.name, 80)} was taken with camera "
                f"{image.camera_id}, "
                "which the model lacks; export the model again"
            )
    points_file = folder / f"points3D{suffix}"
    points = _guarded(read_points, points_file) if points_file.is_file() else _points([])
    return SparseModel(cameras, images, *points)


def _guarded(read: Callable[[bytes], Result], path: Path) -> Result:
    try:
        return read(path.read_bytes())
    except (struct.error, ValueError, IndexError, OverflowError) as error:
        raise FormatError(
            f"{path} is no readable COLMAP file ({printable_line(error, 120)}); export the model again"
        ) from None


def _image(name: str, camera_id: int, quaternion_wxyz: Array, translation: Array) -> ModelImage:
    largest = np.abs(quaternion_wxyz).max()
    if not ((np.abs(translation) <= FARTHEST).all() and 1e-9 < largest < 1e9):
        raise ValueError(f"image {name} has an impossible pose")
    matrix = np.eye(4)
    matrix[:3, :3] = rotation_matrices(quaternion_wxyz[None])[0]
    matrix[:3, 3] = translation
    return ModelImage(name, camera_id, matrix)


def _camera(model: str, width: int, height: int, params: tuple[float, ...]) -> ModelCamera:
    if not (width > 0 and height > 0 and np.isfinite(params).all()):
        raise ValueError(f"a {model} camera of {width}x{height} pixels with parameters {params}")
    return ModelCamera(model, width, height, params)


PointRow = tuple[Any, Any, float, int]  # position (3,), colour (3,), error, track length
Points = tuple[Array, Array, Array, Array]


def _points(rows: list[PointRow]) -> Points:
    positions, colours, errors, tracks = zip(*rows, strict=True) if rows else ((), (), (), ())
    return (
        np.array(positions, np.float64).reshape(-1, 3),
        np.array(colours, np.uint8).reshape(-1, 3),
        np.array(errors, np.float64),
        np.array(tracks, np.int64),
    )


def _binary_cameras(data: bytes) -> dict[int, ModelCamera]:
    (count,) = struct.unpack_from("<Q", data)
    offset, cameras = 8, {}
    for _ in range(count):  # a count too large ends in struct.error at the end of the data
        camera_id, model_id, width, height = struct.unpack_from("<iiQQ", data, offset)
        if model_id not in CAMERA_MODELS:
            raise ValueError(f"camera model number {model_id} is unknown or not a pinhole with a lens")
        model, keys = CAMERA_MODELS[model_id]
        params = struct.unpack_from(f"<{len(keys.split())}d", data, offset + 24)
        cameras[camera_id] = _camera(model, width, height, params)
        offset += 24 + 8 * len(params)
    return cameras


def _binary_images(data: bytes) -> list[ModelImage]:
    (count,) = struct.unpack_from("<Q", data)
    offset, images = 8, []
    for _ in range(count):
        _, *pose, camera_id = struct.unpack_from("<i7di", data, offset)
        end = data.index(b"\0", offset + 64)
        images.append(
            _image(data[offset + 64 : end].decode(), camera_id, np.array(pose[:4]), np.array(pose[4:]))
        )
        (observations,) = struct.unpack_from("<Q", data, end + 1)
        offset = end + 9 + 24 * observations
        if offset > len(data):
            raise ValueError(f"the file ends inside image {images[-1].name}")
    return images


def _binary_points(data: bytes) -> Points:
    (count,) = struct.unpack_from("<Q", data)
    offset, rows = 8, []
    for _ in range(count):
        _, x, y, z, r, g, b, error, track = struct.unpack_from("<Q3d3BdQ", data, offset)
        offset += 51 + 8 * track
        if offset > len(data):
            raise ValueError("the file ends inside a point")
        rows.append(((x, y, z), (r, g, b), error, track))
    return _points(rows)


def _lines(data: bytes) -> list[str]:
    return [line.strip() for line in data.decode().splitlines() if not line.startswith("#")]


def _whole(text: str) -> int:
    """Parse a whole number of at most `MOST_DIGITS` digits; longer ones have no place in a message."""
    if len(text) > MOST_DIGITS:
        raise ValueError(f"a whole number of {len(text)} digits")
    return whole_number(text)


def _text_cameras(data: bytes) -> dict[int, ModelCamera]:
    sizes = {name: len(keys.split()) for name, keys in CAMERA_MODELS.values()}
    cameras = {}
    for line in filter(None, _lines(data)):
        camera_id, model, width, height, *params = line.split()
        if len(params) != sizes.get(model):
            raise ValueError(f"camera {camera_id}: {len(params)} parameters do not make a {model}")
        cameras[_whole(camera_id)] = _camera(model, _whole(width), _whole(height), tuple(map(number, params)))
    return cameras


def _text_images(data: bytes) -> list[ModelImage]:
    lines = _lines(data)
    while lines and not lines[-1]:
        lines.pop()
    images = []
    for line in lines[::2]:  # every second line lists 2D points, and may be empty
        _, *pose, camera_id, name = line.split(maxsplit=9)
        numbers = np.array(list(map(number, pose)))
        images.append(_image(name, _whole(camera_id), numbers[:4], numbers[4:]))
    return images


def _text_points(data: bytes) -> Points:
    rows: list[PointRow] = []
    for line in filter(None, _lines(data)):
        fields = line.split()
        numbers = [number(field) for field in fields[1:4]]
        rows.append((numbers, [_whole(c) for c in fields[4:7]], number(fields[7]), len(fields[8:]) // 2))
    return _points(rows)


_BINARY = (_binary_cameras, _binary_images, _binary_points)
_TEXT = (_text_cameras, _text_images, _text_points)


# Datasets with a COLMAP model: ``sparse/0`` (or another number) or ``sparse``, beside ``images``.

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
    """Number of photographs with a camera in a model; 0 if it is damaged."""
    try:
        return len({image.name for image in read_images(model_folder)})
    except FormatError:
        return 0


def intrinsics_of(camera: ModelCamera) -> PhotoIntrinsics:
    """Intrinsics of a COLMAP camera; ValueError if its focal length is impossible."""
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
    cameras, images, files, masks = develop(there, max_side, progress)
    return Capture(cameras, images, *good_points(model), photos=files, masks=masks)


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
        Photo(
            photo_folder / name,
            name,
            by_id[image.camera_id],
            image.world_to_camera,
            mask=mask_beside(photo_folder / name),
        )
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
