"""Cameras as the INRIA code stores them beside a scene: `scene.cameras.json`.

A JSON list with one object per camera:

    id            number in the list
    img_name      file name of the photograph, without its suffix
    width, height pixels
    position      [x, y, z] of the camera in the world
    rotation      camera-to-world, three rows; OpenCV axes (x right, y down, z forward)
    fx, fy        pixels
    cx, cy        pixels, principal point from the top left corner; ours, absent in INRIA's own files:
                  then it is the middle
"""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.errors import malformed
from langsplat_core.io.files import atomic_path
from langsplat_core.io.hostile import PHOTO_SUFFIXES, read_json_file
from langsplat_core.scene import FARTHEST, Camera

SUFFIX = ".cameras.json"
SIZE_LIMIT = 64 * 1024 * 1024  # bytes; a camera takes about 500
MAX_PIXELS = 1 << 16  # a side of the image; beyond it a renderer would be asked for gigabytes
ROTATION_TOLERANCE = 1e-3  # of R R^T against the identity; files written in float32 keep 1e-6


def read_cameras(path: Path | str) -> tuple[Camera, ...]:
    """Return the cameras in the file, in its order. Raises InputError and FormatError."""
    path = Path(path)
    entries = read_json_file(path, SIZE_LIMIT)
    if not isinstance(entries, list):
        raise malformed(path, "expected a list of cameras at the top")
    return tuple(_camera(entry, f"{path}: camera {index}") for index, entry in enumerate(entries))


def write_cameras(path: Path | str, cameras: tuple[Camera, ...]) -> None:
    """Write `cameras` in INRIA's form, atomically."""
    entries = [
        {
            "id": index,
            "img_name": camera.name,
            "width": camera.width,
            "height": camera.height,
            "position": camera.position.tolist(),
            "rotation": camera.rotation.T.tolist(),
            "fx": camera.fx,
            "fy": camera.fy,
            "cx": camera.cx,
            "cy": camera.cy,
        }
        for index, camera in enumerate(cameras)
    ]
    lines = ",\n".join(json.dumps(entry, ensure_ascii=False, default=float) for entry in entries)
    with atomic_path(path) as temporary:
        temporary.write_text(f"[\n{lines}\n]\n", encoding="utf-8")


def _camera(entry: Any, what: str) -> Camera:
    """Return the camera of an entry; `what` names the file and the camera in messages."""
    if not isinstance(entry, dict):
        raise malformed(what, "expected an object with width, height, position, rotation, fx, fy")
    width, height = (_pixels(entry, key, what) for key in ("width", "height"))
    position = numbers(entry, "position", (3,), what)
    if np.abs(position).max() > FARTHEST:
        raise malformed(what, f"'position' is more than {FARTHEST:g} units from the origin", "move the world")
    rotation = numbers(entry, "rotation", (3, 3), what)
    if not is_rotation(rotation):
        raise malformed(what, "'rotation' is not a rotation matrix")
    matrix = np.eye(4)
    matrix[:3, :3] = rotation.T
    matrix[:3, 3] = -rotation.T @ position
    name = entry.get("img_name", "")
    if not isinstance(name, str):
        raise malformed(what, "'img_name' is not a text")
    try:
        return Camera(
            width,
            height,
            float(numbers(entry, "fx", (), what)),
            float(numbers(entry, "fy", (), what)),
            float(numbers(entry, "cx", (), what)) if "cx" in entry else width / 2,
            float(numbers(entry, "cy", (), what)) if "cy" in entry else height / 2,
            matrix,
            _without_image_suffix(name),
        )
    except ValueError as error:  # what the camera itself refuses: fx of 0, for one
        raise malformed(what, f"{error}") from None


def is_rotation(matrix: Array) -> bool:
    """Return whether a finite (3, 3) matrix is a rotation, to `ROTATION_TOLERANCE`."""
    if np.abs(matrix).max() > 2:  # products of larger ones could overflow
        return False
    unlike = np.abs(matrix @ matrix.T - np.eye(3)).max()
    return bool(unlike <= ROTATION_TOLERANCE and np.linalg.det(matrix) > 0)


def _without_image_suffix(name: str) -> str:
    """Newer INRIA files keep the suffix; a name such as "frame.01" must keep its own dot."""
    ending = next((suffix for suffix in PHOTO_SUFFIXES if name.lower().endswith(suffix)), "")
    return name[: len(name) - len(ending)]


def _pixels(entry: dict[str, Any], key: str, what: str) -> int:
    value = float(numbers(entry, key, (), what))
    if value != math.floor(value) or not 1 <= value <= MAX_PIXELS:
        raise malformed(what, f"{key!r} is {value:g}; expected whole pixels, 1 to {MAX_PIXELS}")
    return int(value)


def numbers(entry: dict[str, Any], key: str, shape: tuple[int, ...], what: str) -> Array:
    """Return finite float64 numbers of the given shape under `key`: (), (3,), (3, 3) or (4, 4).

    FormatError, beginning with `what`, where there are none.
    """
    if key not in entry:
        raise malformed(what, f"{key!r} is missing")
    kinds = {(): "a number", (3,): "3 numbers", (3, 3): "3 rows of 3 numbers", (4, 4): "4 rows of 4 numbers"}
    kind = kinds[shape]
    try:
        found = np.array(entry[key])
    except ValueError:  # rows of unequal length
        raise malformed(what, f"{key!r} is not {kind}") from None
    if found.dtype.kind not in "iuf" or found.shape != shape or not np.isfinite(found).all():
        raise malformed(what, f"{key!r} is not {kind}, all finite")
    return found.astype(np.float64)
