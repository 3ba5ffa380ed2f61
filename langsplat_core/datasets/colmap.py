"""COLMAP's sparse models, binary or text, and datasets with one in ``sparse/0`` or ``sparse``.

Models are read here and not by pycolmap, which fills cameras of a truncated file with whatever lies in
memory, cuts the names of a text model at their first blank, and refuses a model without points. So cameras
open without the extra that brings pycolmap, too. Layout: https://colmap.github.io/format.html. Rigs and
frames (COLMAP >= 3.12) add nothing here, because images.bin still carries every image's own pose.
"""

import logging
import os
import struct
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from langsplat_core.arrays import Array, rotation_matrices
from langsplat_core.datasets.capture import Capture, warn_of_lost_points
from langsplat_core.datasets.intrinsics import (
    BrownDistortion,
    ColmapDistortion,
    Distortion,
    FisheyeDistortion,
    PhotoIntrinsics,
)
from langsplat_core.datasets.photos import Photo, develop, find_photos, mask_beside
from langsplat_core.errors import FormatError, InputError, printable_line, shortened
from langsplat_core.io.files import shown
from langsplat_core.progress import Progress
from langsplat_core.scene import FARTHEST

# COLMAP's mapper drops points above 4 px itself, so only models that were made otherwise lose any here.
MAX_POINT_ERROR = 4.0  # pixels
CAMERA_MODELS = MappingProxyType({  # id -> name and parameters, in file order
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
})  # fmt: skip
_PARAMETERS = dict(CAMERA_MODELS.values())
_BROWN = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")
_FISHEYE = ("SIMPLE_FISHEYE", "FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "OPENCV_FISHEYE")

log = logging.getLogger("langsplat")


@dataclass(frozen=True)
class ModelCamera:
    """A camera of a model; ValueError where no camera has such numbers."""

    model: str  # name in CAMERA_MODELS
    width: int
    height: int
    params: tuple[float, ...]

    def __post_init__(self) -> None:
        if len(self.params) != len(_PARAMETERS.get(self.model, "").split()):
            raise ValueError(f"{len(self.params)} parameters do not make a {self.model} camera")
        if not (self.width > 0 and self.height > 0 and np.isfinite(self.params).all()):
            raise ValueError(f"a {self.model} camera of {self.width}x{self.height} pixels, {self.params}")

    def named(self) -> dict[str, float]:
        """Return parameters by name; a single focal length appears as both fx and fy."""
        values = dict(zip(_PARAMETERS[self.model].split(), self.params, strict=True))
        if "f" in values:
            values["fx"] = values["fy"] = values.pop("f")
        return values


@dataclass(frozen=True, eq=False)
class ModelImage:
    """An image of a model, without its 2D points."""

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
    return any(
        all((folder / f"{part}{suffix}").is_file() for part in ("cameras", "images"))
        for suffix in (".bin", ".txt")
    )


def read_images(folder: Path) -> list[ModelImage]:
    """Return the images of the model in `folder` alone. FormatError where they are damaged."""
    images: list[ModelImage] = _content(_file(folder, "images"))
    return images


def read_model(folder: Path) -> SparseModel:
    """Return the model in `folder`; binary is preferred. FormatError names the file that is broken."""
    cameras, images = _content(_file(folder, "cameras")), read_images(folder)
    for image in images:
        if image.camera_id not in cameras:
            raise FormatError(
                f"{_file(folder, 'images')}: {printable_line(image.name, 80)} was taken with camera "
                f"{printable_line(image.camera_id, 40)}, which the model lacks; export the model again"
            )
    points = _file(folder, "points3D")
    return SparseModel(cameras, images, *(_content(points) if points.is_file() else _points(())))


def _file(folder: Path, part: str) -> Path:
    """Return the file of a part of the model in `folder`."""
    if not has_model(folder):
        raise InputError(f"{folder} holds no cameras.bin and images.bin (or .txt)")
    is_binary = (folder / "cameras.bin").is_file() and (folder / "images.bin").is_file()
    return folder / f"{part}{'.bin' if is_binary else '.txt'}"


def _content(path: Path) -> Any:
    """Return what the reader of a file's name makes of it."""
    try:
        return _READERS[path.name](path.read_bytes())
    except (struct.error, ValueError, IndexError, OverflowError) as error:
        raise FormatError(
            f"{path} is no readable COLMAP file ({printable_line(error, 120)}); export the model again"
        ) from None


def _image(name: str, camera_id: int, pose: list[float]) -> ModelImage:
    """Return the image of a pose, which is a quaternion wxyz of any length and a translation."""
    quaternion, translation = np.array(pose[:4]), np.array(pose[4:])
    largest = np.abs(quaternion).max()
    if not ((np.abs(translation) <= FARTHEST).all() and 1e-9 < largest < 1e9):
        raise ValueError(f"image {name} has an impossible pose")
    matrix = np.eye(4)
    matrix[:3, :3] = rotation_matrices(quaternion[None])[0]
    matrix[:3, 3] = translation
    return ModelImage(name, camera_id, matrix)


def _points(rows: Iterable[tuple[Any, Any, float, int]]) -> tuple[Array, Array, Array, Array]:
    """Return the arrays of rows of position, colour, error and track length."""
    positions, colours, errors, tracks = [list(column) for column in zip(*rows, strict=True)] or [[]] * 4
    return (
        np.array(positions, np.float64).reshape(-1, 3),
        np.array(colours, np.uint8).reshape(-1, 3),
        np.array(errors, np.float64),
        np.array(tracks, np.int64),
    )


# Binary files: a count, and rows; a count too large ends in struct.error at the end of the data.


def _binary_cameras(data: bytes) -> dict[int, ModelCamera]:
    offset, cameras = 8, {}
    for _ in range(*struct.unpack_from("<Q", data)):
        camera_id, model_id, width, height = struct.unpack_from("<iiQQ", data, offset)
        if model_id not in CAMERA_MODELS:
            raise ValueError(f"camera model number {model_id} is unknown or not a pinhole with a lens")
        model, keys = CAMERA_MODELS[model_id]
        params = struct.unpack_from(f"<{len(keys.split())}d", data, offset + 24)
        cameras[camera_id] = ModelCamera(model, width, height, params)
        offset += 24 + 8 * len(params)
    return cameras


def _binary_images(data: bytes) -> Iterator[ModelImage]:
    offset = 8
    for _ in range(*struct.unpack_from("<Q", data)):
        _, *pose, camera_id = struct.unpack_from("<i7di", data, offset)
        end = data.index(b"\0", offset + 64)
        name = data[offset + 64 : end].decode()
        (observations,) = struct.unpack_from("<Q", data, end + 1)
        offset = end + 9 + 24 * observations
        if offset > len(data):
            raise ValueError(f"the file ends inside image {name}")
        yield _image(name, camera_id, pose)


def _binary_points(data: bytes) -> Iterator[tuple[Any, Any, float, int]]:
    offset = 8
    for _ in range(*struct.unpack_from("<Q", data)):
        _, x, y, z, r, g, b, error, track = struct.unpack_from("<Q3d3BdQ", data, offset)
        offset += 51 + 8 * track
        if offset > len(data):
            raise ValueError("the file ends inside a point")
        yield (x, y, z), (r, g, b), error, track


# Text files: a line for each row, after comments.


def _lines(data: bytes) -> list[str]:
    return [line.strip() for line in data.decode().splitlines() if not line.startswith("#")]


def _text_cameras(data: bytes) -> dict[int, ModelCamera]:
    cameras = {}
    for line in filter(None, _lines(data)):
        camera_id, model, width, height, *params = line.split()
        cameras[int(camera_id)] = ModelCamera(model, int(width), int(height), tuple(map(float, params)))
    return cameras


def _text_images(data: bytes) -> Iterator[ModelImage]:
    lines = _lines(data)
    while lines and not lines[-1]:
        lines.pop()
    for line in lines[::2]:  # every second line lists 2D points, and may be empty
        _, *pose, camera_id, name = line.split(maxsplit=9)
        yield _image(name, int(camera_id), list(map(float, pose)))


def _text_points(data: bytes) -> Iterator[tuple[Any, Any, float, int]]:
    for line in filter(None, _lines(data)):
        fields = line.split()
        position, colour = list(map(float, fields[1:4])), list(map(int, fields[4:7]))
        yield position, colour, float(fields[7]), len(fields[8:]) // 2


_READERS: dict[str, Callable[[bytes], Any]] = {
    "cameras.bin": _binary_cameras,
    "cameras.txt": _text_cameras,
    "images.bin": lambda data: list(_binary_images(data)),
    "images.txt": lambda data: list(_text_images(data)),
    "points3D.bin": lambda data: _points(_binary_points(data)),
    "points3D.txt": lambda data: _points(_text_points(data)),
}


# Datasets.


def find_model(folder: Path) -> Path | None:
    """Return the folder of the COLMAP model of a dataset, if it has one.

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
    """Return the number of photographs with a camera in a model; 0 if it is damaged."""
    try:
        return len({image.name for image in read_images(model_folder)})
    except FormatError:
        return 0


def intrinsics_of(camera: ModelCamera) -> PhotoIntrinsics:
    """Return the intrinsics of a COLMAP camera; ValueError if its focal length is impossible."""
    rest = camera.named()
    fx, fy, cx, cy = (rest.pop(key) for key in ("fx", "fy", "cx", "cy"))
    distortion: Distortion
    if camera.model in _BROWN:
        distortion = BrownDistortion(**rest)
    elif camera.model in _FISHEYE:
        distortion = FisheyeDistortion(**rest)
    else:
        distortion = ColmapDistortion(camera.model, camera.params, fx, fy, cx, cy)
    return PhotoIntrinsics(camera.width, camera.height, fx, fy, cx, cy, distortion)


def load_colmap(folder: Path, model_folder: Path, max_side: int, progress: Progress) -> Capture:
    """Return the photographs of `folder` with the cameras and points of the model; see `load_capture`."""
    model = read_model(model_folder)
    # Without a folder of their own, photographs lie in the dataset's.
    images = folder / "images" if (folder / "images").is_dir() or not model.images else folder
    photos = located_photos(model, images, model_folder)
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
    present = len(find_photos(images))
    if 2 * len(there) < present:
        log.warning(
            "%s has cameras for only %d of the %d photographs beside it; another model may have more",
            shown(model_folder),
            len(there),
            present,
        )
    cameras, pixels, files, masks = develop(there, max_side, progress)
    return Capture(cameras, pixels, *good_points(model), photos=files, masks=masks)


def located_photos(model: SparseModel, folder: Path, source: Path) -> list[Photo]:
    """Return the model's images as photographs in `folder`; FormatError names `source` for a bad camera."""
    lenses = {}
    for camera_id, camera in model.cameras.items():
        try:
            lenses[camera_id] = intrinsics_of(camera)
        except ValueError as error:
            raise FormatError(f"{source}: camera {camera_id}: {error}; export the model again") from None
    return [
        Photo(path, name, lenses[image.camera_id], image.world_to_camera, mask=mask_beside(path))
        for name, image in {image.name: image for image in model.images}.items()
        for path in (folder / name,)
    ]


def good_points(model: SparseModel) -> tuple[Array, Array]:
    """Return (M, 3) points and (M, 3) colours without those that are plainly wrong.

    These are not finite, seen by a single image, or reprojected more than `MAX_POINT_ERROR` off. Unknown
    errors and tracks count as good.
    """
    good = np.isfinite(model.points).all(1)
    good &= ~(model.errors > MAX_POINT_ERROR)
    good &= model.track_lengths != 1
    warn_of_lost_points(good, "the COLMAP model")
    return model.points[good], model.colours[good]
