"""Camera files as the INRIA code writes them beside a scene: `scene.cameras.json`.

A JSON list with one object per camera:
    id            number in the list
    img_name      file name of the photograph, without its suffix
    width, height pixels
    position      [x, y, z] of the camera in the world
    rotation      camera-to-world, three rows; OpenCV axes (x right, y down, z forward)
    fx, fy        pixels; of a camera that is also "orthographic": true, pixels per world unit
    cx, cy        pixels, principal point from the top left corner; absent, as in INRIA's files: the centre
"""

import json
from pathlib import Path
from typing import Annotated

import numpy as np
from msgspec import Meta, Raw, Struct

from langsplat_core.arrays import affine
from langsplat_core.errors import malformed, quoted, report_losses, unread
from langsplat_core.io.files import write_whole
from langsplat_core.io.hostile import PHOTO_SUFFIXES, decode_json, read_file
from langsplat_core.scene import FARTHEST, Camera

SUFFIX = ".cameras.json"
SIZE_LIMIT = 64 * 1024 * 1024  # bytes; a camera takes about 500

# Side of an image; larger ones would make a renderer allocate gigabytes.
Pixels = Annotated[float, Meta(ge=1, le=1 << 16, multiple_of=1)]
Coordinate = Annotated[float, Meta(ge=-FARTHEST, le=FARTHEST)]
Cosine = Annotated[float, Meta(ge=-2, le=2)]  # only a coarse bound: `Camera` checks rotations
Row = tuple[Cosine, Cosine, Cosine]


class _Entry(Struct):
    width: Pixels
    height: Pixels
    position: tuple[Coordinate, Coordinate, Coordinate]
    rotation: tuple[Row, Row, Row]
    fx: float
    fy: float
    img_name: str = ""
    cx: float | None = None
    cy: float | None = None
    orthographic: bool = False


def read_cameras(path: Path | str) -> tuple[Camera, ...]:
    """Return the cameras in a file, in order, and report losses. Raises InputError and FormatError."""
    path = Path(path)
    text = read_file(path, SIZE_LIMIT)
    entries = decode_json(text, list[_Entry], path)
    stated = decode_json(text, list[dict[str, Raw]], path)
    known = {*_Entry.__struct_encode_fields__, "id"}
    told = [unread("entries", {quoted(name, 40) for one in stated for name in one if name not in known})]
    if half := sum((entry.cx is None) != (entry.cy is None) for entry in entries):
        told.append(f"{half} cameras have one of cx and cy alone, and the middle is taken for the other")
    report_losses(path, told)
    return tuple(_camera(entry, f"{path}: camera {index}") for index, entry in enumerate(entries))


def write_cameras(path: Path | str, cameras: tuple[Camera, ...]) -> None:
    """Write `cameras` in INRIA's form, atomically."""
    entries = [
        {
            "id": index,
            "img_name": camera.name,
            **vars(camera.intrinsics),
            **({"orthographic": True} if camera.orthographic else {}),
            "position": camera.position.tolist(),
            "rotation": camera.rotation.T.tolist(),
        }
        for index, camera in enumerate(cameras)
    ]
    lines = ",\n".join(json.dumps(entry, ensure_ascii=False, default=float) for entry in entries)
    write_whole(path, f"[\n{lines}\n]\n")


def _camera(entry: _Entry, what: str) -> Camera:
    """Return the camera of an entry; `what` names the file and the camera in messages."""
    rotation = np.array(entry.rotation)
    pose = affine(rotation.T, -rotation.T @ np.array(entry.position))
    # Newer INRIA files have the photograph's suffix; the dot in a name such as "frame.01" is kept.
    stem, dot, suffix = entry.img_name.rpartition(".")
    name = stem if dot + suffix.lower() in PHOTO_SUFFIXES else entry.img_name
    cx = entry.width / 2 if entry.cx is None else entry.cx
    cy = entry.height / 2 if entry.cy is None else entry.cy
    size = int(entry.width), int(entry.height)
    try:
        return Camera(*size, entry.fx, entry.fy, cx, cy, pose, name, entry.orthographic)
    except ValueError as error:  # such as fx = 0
        raise malformed(what, f"{error}") from None
