"""COLMAP's sparse models, binary or text, and datasets with one in ``sparse/0``, ``sparse`` or their folder.

pycolmap fills cameras of a truncated file with whatever lies in memory, cuts the names of a text model at
their first blank, refuses a model without points, and may not be installed. Rigs and frames (COLMAP >= 3.12)
add nothing: images.bin still has every image's own pose. Layout: https://colmap.github.io/format.html
"""

import os
import re
import struct
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from langsplat_core.arrays import Array, affine, rotation_matrices
from langsplat_core.config import DatasetConfig
from langsplat_core.datasets.capture import Capture, develop, report_lost_points
from langsplat_core.datasets.intrinsics import BrownDistortion, FisheyeDistortion, PhotoIntrinsics
from langsplat_core.datasets.photos import Photo, find_photos, finder, mask_beside
from langsplat_core.errors import (
    FormatError,
    InputError,
    Tell,
    printable_line,
    report_loss,
    report_losses,
    shortened,
)
from langsplat_core.io.files import shown
from langsplat_core.io.hostile import decimal_comma, decode_name, decode_text
from langsplat_core.io.ply import read_cloud
from langsplat_core.progress import Progress
from langsplat_core.scene import FARTHEST

# Lenses: number in binary files, formula, and parameters in file order; f stands for both fx and fy.
LENSES: Mapping[str, tuple[int, Any, str]] = MappingProxyType({
    "SIMPLE_PINHOLE": (0, BrownDistortion, "f cx cy"),
    "PINHOLE": (1, BrownDistortion, "fx fy cx cy"),
    "SIMPLE_RADIAL": (2, BrownDistortion, "f cx cy k1"),
    "RADIAL": (3, BrownDistortion, "f cx cy k1 k2"),
    "OPENCV": (4, BrownDistortion, "fx fy cx cy k1 k2 p1 p2"),
    "OPENCV_FISHEYE": (5, FisheyeDistortion, "fx fy cx cy k1 k2 k3 k4"),
    "FULL_OPENCV": (6, BrownDistortion, "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6"),
    "SIMPLE_RADIAL_FISHEYE": (8, FisheyeDistortion, "f cx cy k1"),
    "RADIAL_FISHEYE": (9, FisheyeDistortion, "f cx cy k1 k2"),
    "SIMPLE_FISHEYE": (14, FisheyeDistortion, "f cx cy"),
    "FISHEYE": (15, FisheyeDistortion, "fx fy cx cy"),
})  # fmt: skip

CLOUDS = ("points3D.ply", "points3d.ply", "points.ply")  # of tools that do not write COLMAP's points

# Records of the binary files, each of which begins with their number. An image goes on with its name, a zero
# byte, and the number of its observations of 24 bytes; a point with `track` observations of 8 bytes.
CAMERA = np.dtype([("id", "<i4"), ("lens", "<i4"), ("width", "<u8"), ("height", "<u8")])
IMAGE = np.dtype([("id", "<i4"), ("pose", "<f8", 7), ("camera", "<i4")])
POINT = np.dtype([
    ("id", "<u8"), ("position", "<f8", 3), ("colour", "u1", 3), ("error", "<f8"), ("track", "<u8"),
])  # fmt: skip


@dataclass(frozen=True, eq=False)
class ModelImage:
    """An image of a model, without its 2D points."""

    name: str
    camera_id: int
    world_to_camera: Array  # (4, 4) float64


@dataclass(frozen=True, eq=False)
class SparseModel:
    """Content of a COLMAP model."""

    lenses: dict[int, PhotoIntrinsics]  # by the number of the camera
    images: list[ModelImage]
    # (M,) of POINT: position in world units, mean reprojection error in pixels (-1 where unknown), number of
    # images that see the point (0 where unknown)
    points: Array


def model_suffix(folder: Path) -> str | None:
    """Return the suffix of both cameras and images in `folder`, None without such; binary is preferred."""
    parts = ("cameras", "images")
    kinds = (".bin", ".txt")
    return next((k for k in kinds if all((folder / f"{part}{k}").is_file() for part in parts)), None)


def read_model(folder: Path) -> SparseModel:
    """Return the model in `folder`; binary is preferred. FormatError names the file that is broken."""
    if (suffix := model_suffix(folder)) is None:
        raise InputError(f"{folder} holds no cameras.bin and images.bin (or .txt)")
    lenses, images = _content(folder / f"cameras{suffix}"), _content(folder / f"images{suffix}")
    last = {image.name: image for image in images}
    again = {i.name for i in images if not np.array_equal(i.world_to_camera, last[i.name].world_to_camera)}
    if again:
        report_loss("%s: images listed twice, of which the last counts: %s", shown(folder), shortened(again))
    for image in images:
        if image.camera_id not in lenses:
            raise FormatError(
                f"{folder / f'images{suffix}'}: {printable_line(image.name, 80)} was taken with camera "
                f"{printable_line(image.camera_id, 40)}, which the model lacks; export the model again"
            )
    return SparseModel(lenses, images, _points(folder, suffix))


def _points(folder: Path, suffix: str) -> Array:
    """Return the points beside cameras and images: the model's own, else a PLY, as MASt3R and VGGT write."""
    for name in (f"points3D{suffix}", "points3D.bin", "points3D.txt"):
        if (folder / name).is_file() and len(points := _content(folder / name)):
            return np.asarray(points)
    for name in CLOUDS:
        if (folder / name).is_file():
            positions, colours = read_cloud(folder / name)
            points = np.zeros(len(positions), POINT)
            points["position"], points["colour"], points["error"] = positions, colours, -1
            return points
    return np.zeros(0, POINT)


def _content(path: Path, quiet: bool = False) -> Any:
    """Return the content of a file, read by the reader for its name, and report what was ignored."""
    data, told = path.read_bytes(), list[str]()
    try:
        if path.suffix == ".bin":
            found, stated = _READERS[path.name](data, told.append), None
        else:
            text = decode_text(data, path)
            found = _READERS[path.name](text, told.append)
            stated = re.search(r"^#\s*Number of \w+:\s*(\d{1,18})", text, re.MULTILINE)
        if stated and int(stated[1]) != len(found):
            told.append(f"has {len(found)} rows, and says that it had {stated[1]}")
        if told and not quiet:
            report_losses(shown(path), [*told, "was it written whole?"])
        return found
    except (struct.error, ValueError, IndexError, OverflowError) as error:
        reason = f"{printable_line(error, 160)}{decimal_comma(error)}"
        raise FormatError(f"{path} is no readable COLMAP file ({reason}); export the model again") from None


def lens_of(name: str, width: int, height: int, parameters: Array) -> PhotoIntrinsics:
    """Return the lens of a model's camera; ValueError for an unknown kind or impossible parameters."""
    if name not in LENSES:
        raise ValueError(f"{printable_line(name, 40)} is not read; run `colmap image_undistorter` first")
    _, formula, keys = LENSES[name]
    values = dict(zip(keys.split(), map(float, parameters), strict=True))
    if not np.isfinite(parameters).all():
        raise ValueError(f"a {name} camera with {values}")
    fx = values.pop("f" if "f" in values else "fx")
    fy, cx, cy = values.pop("fy", fx), values.pop("cx"), values.pop("cy")
    return PhotoIntrinsics(width, height, fx, fy, cx, cy, formula(**values))


def _image(name: str, camera_id: int, pose: Array) -> ModelImage:
    """Return the image of a pose, which is a quaternion wxyz of any length and a translation."""
    quaternion, translation = pose[:4], pose[4:]
    if not ((np.abs(translation) <= FARTHEST).all() and 1e-9 < np.abs(quaternion).max() < 1e9):
        raise ValueError(f"image {name} has an impossible pose")
    return ModelImage(name, camera_id, affine(rotation_matrices(quaternion), translation))


# Binary files: a number, and as many records.


def _records(
    data: bytes, kind: Any, rest: Callable[[Any, int], int], tell: Tell
) -> Iterator[tuple[Any, bytes]]:
    """Yield every record with the bytes behind it; rest: their number, from the record and its end."""
    end = 8
    for _ in range(*struct.unpack_from("<Q", data)):
        record = np.frombuffer(data, kind, 1, end)[0]
        begin = end + kind.itemsize
        end = begin + rest(record, begin)
        if end > len(data):
            raise ValueError("the file ends inside a record")
        yield record, data[begin:end]
    if end < len(data):
        tell(f"{len(data) - end} bytes behind its last record are not read")


def _binary_cameras(data: bytes, tell: Tell) -> dict[int, PhotoIntrinsics]:
    rows = {number: (name, 8 * len(keys.split())) for name, (number, _, keys) in LENSES.items()}
    lenses: dict[int, PhotoIntrinsics] = {}

    def rest(camera: Any, _: int) -> int:
        return rows.get(camera["lens"], ("", 0))[1]

    for camera, parameters in _records(data, CAMERA, rest, tell):
        name, _ = rows.get(camera["lens"], (f"number {camera['lens']}", 0))
        size = int(camera["width"]), int(camera["height"])
        _add(lenses, int(camera["id"]), lens_of(name, *size, np.frombuffer(parameters)), tell)
    return lenses


def _add(lenses: dict[int, PhotoIntrinsics], number: int, lens: PhotoIntrinsics, tell: Tell) -> None:
    if lenses.setdefault(number, lens) != lens:
        tell(f"camera {number} is listed twice, and the last counts")
    lenses[number] = lens


def _binary_images(data: bytes, tell: Tell) -> list[ModelImage]:
    def rest(_: Any, begin: int) -> int:
        end = data.index(b"\0", begin) + 1
        return int(end + 8 + 24 * struct.unpack_from("<Q", data, end)[0] - begin)

    return [
        _image(decode_name(behind.partition(b"\0")[0]), int(image["camera"]), image["pose"])
        for image, behind in _records(data, IMAGE, rest, tell)
    ]


def _binary_points(data: bytes, tell: Tell) -> Array:
    points = _records(data, POINT, lambda point, _: 8 * int(point["track"]), tell)
    return np.array([point for point, _ in points], POINT)


# Text files: a line for each row, after comments.


def _lines(text: str) -> list[str]:
    return [line.strip() for line in text.split("\n") if not line.startswith("#")]


def _text_cameras(text: str, tell: Tell) -> dict[int, PhotoIntrinsics]:
    lenses: dict[int, PhotoIntrinsics] = {}
    for line in filter(None, _lines(text)):
        camera_id, name, width, height, *parameters = line.split()
        lens = lens_of(name, int(width), int(height), np.array(parameters, np.float64))
        _add(lenses, int(camera_id), lens, tell)
    return lenses


def _text_images(text: str, tell: Tell) -> list[ModelImage]:
    images, stray, bare = [], 0, 0
    lines = _lines(text)
    at = 0
    while at < len(lines):
        line, at = lines[at], at + 1
        if _lists_2d_points(line):
            stray += bool(line)
            continue
        _, *pose, camera_id, name = line.split(maxsplit=9)
        images.append(_image(name, int(camera_id), np.array(pose, np.float64)))
        if at < len(lines) and _lists_2d_points(lines[at]):  # the 2D points of this image
            at += 1
        elif at < len(lines):
            bare += 1
    if stray or bare:
        tell(f"{stray} lines belong to no image, and {bare} images lack their 2D points")
    return images


def _lists_2d_points(line: str) -> bool:
    """Return True for triples of x, y and a whole number, or nothing; lines of images end with a name."""
    fields = line.split()
    try:
        return len(fields) % 3 == 0 and all(int(number) >= -1 for number in (*fields[2:3], *fields[-1:]))
    except ValueError:
        return False


def _text_points(text: str, tell: Tell) -> Array:
    rows = [line.split() for line in _lines(text) if line]
    points = np.array(
        [
            (int(row[0]), [*map(float, row[1:4])], [*map(int, row[4:7])], float(row[7]), len(row[8:]) // 2)
            for row in rows
        ],
        POINT,
    )
    first = np.sort(np.unique(points["id"], return_index=True)[1])
    if len(first) < len(points):
        tell(f"{len(points) - len(first)} points are listed twice")
    return points[first]


_READERS: dict[str, Callable[..., Any]] = {
    "cameras.bin": _binary_cameras,
    "cameras.txt": _text_cameras,
    "images.bin": _binary_images,
    "images.txt": _text_images,
    "points3D.bin": _binary_points,
    "points3D.txt": _text_points,
}


# Datasets.


def find_model(folder: Path) -> Path | None:
    """Return the folder of the COLMAP model of a dataset, if it has one.

    Photographs that COLMAP cannot place together end in several models, of which the first is not always the
    largest. The model with most photographs is taken, the first of equal ones, and a warning names it.
    """
    sparse = next(filter(Path.is_dir, (folder / "sparse", folder / "colmap/sparse")), folder / "sparse")
    inside = sorted(sparse.iterdir(), key=lambda f: (len(f.name), f.name)) if sparse.is_dir() else []
    found = [f for f in inside if model_suffix(f)]
    if len(found) < 2:
        return next((f for f in (*found, sparse, folder) if model_suffix(f)), None)
    best = max(found, key=_photographs_of)
    name = printable_line(best.name, 60)
    report_loss("%s has %d models; %s is taken, with most photographs", shown(sparse), len(found), name)
    return best


def _photographs_of(model_folder: Path) -> int:
    try:
        images = _content(model_folder / f"images{model_suffix(model_folder)}", quiet=True)
        return len({image.name for image in images})
    except FormatError:
        return 0


def load_colmap(folder: Path, model_folder: Path, config: DatasetConfig, progress: Progress) -> Capture:
    """Return the photographs of `folder` with the cameras and points of the model; see `load_capture`."""
    model = read_model(model_folder)
    # Without a folder of their own, photographs lie in the dataset's.
    images = folder / "images" if (folder / "images").is_dir() or not model.images else folder
    photos = located_photos(model, images)
    there = [photo for photo in photos if os.path.isfile(photo.path)]
    missing = {photo.label for photo in photos} - {photo.label for photo in there}
    if photos and not there:
        raise InputError(
            f"{shown(model_folder)}: none of its {len(photos)} photographs exists "
            f"(first: {printable_line(photos[0].label, 60)}); put them into {shown(folder / 'images')}"
        )
    if missing:
        share = f"{len(missing)} of {len(photos)} photographs of the model"
        report_loss("%s do not exist and are left out: %s", share, shortened(missing))
    present = find_photos(images) or find_photos(images, below=int(images.name == "images"))
    if without := {path.name for path in present} - {photo.path.name for photo in there}:
        share = f"cameras for only {len(there)} of the {len(present)} photographs beside it"
        lost = shortened(without)
        report_loss("%s has %s; another model may have more: without %s", shown(model_folder), share, lost)
    return develop(there, config, progress, *good_points(model, "the COLMAP model"))


def located_photos(model: SparseModel, folder: Path) -> list[Photo]:
    """Return the model's images as photographs in `folder`, each name once."""
    find = finder(folder)
    photos = []
    for name, image in {image.name: image for image in model.images}.items():
        path, lens = find(name), model.lenses[image.camera_id]
        photos.append(Photo(path, name, lens, image.world_to_camera, mask=mask_beside(path)))
    return photos


def good_points(model: SparseModel, source: str = "") -> tuple[Array, Array]:
    """Return (M, 3) points and (M, 3) colours without those that are plainly wrong, reported by their source.

    Those are not finite, seen in one image alone, or over 4 px off, as COLMAP drops; unknown errors pass.
    """
    points = model.points
    good = np.isfinite(points["position"]).all(1) & ~(points["error"] > 4) & (points["track"] != 1)
    if source:
        report_lost_points(good, source)
    return points["position"][good], points["colour"][good]
