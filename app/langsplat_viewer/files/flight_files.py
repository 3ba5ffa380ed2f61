"""Camera paths as files: small JSON, with a version.

{"langsplat_flight": 1,
 "keyframes": [{"seconds": 0.0,             rising, 0 to 36000
                "position": [x, y, z],      world units
                "rotation": [[...], ...],   camera to world, three rows; OpenCV axes, as in cameras.json
                "fov_degrees": 50.0,        across the picture's shorter side
                "span": 4.0}]}              world units across it; where it is, there is no perspective
"""

import json
from pathlib import Path
from typing import Any

import numpy as np

from langsplat_core.errors import FormatError, quoted
from langsplat_core.files import atomic_path
from langsplat_core.formats.cameras_json import is_rotation, numbers
from langsplat_core.parsing.opening import read_json_file
from langsplat_core.scene import FARTHEST
from langsplat_viewer.camera.flight import (
    FOV_LIMITS,
    LONGEST,
    SAME_TIME,
    SPAN_LIMITS,
    Flight,
    Keyframe,
    Pose,
)

SUFFIX = ".path.json"  # that ours have
MARK, VERSION = "langsplat_flight", 1
SIZE_LIMIT = 16 * 1024 * 1024  # bytes
MOST = 10_000  # keyframes


def read_flight(path: Path | str) -> Flight:
    """The path in a file. Raises InputError and FormatError, in one line."""
    path = Path(path)
    top = read_json_file(path, SIZE_LIMIT)
    if not isinstance(top, dict) or MARK not in top:
        raise FormatError(f'{path}: no camera path; expected an object with "{MARK}": {VERSION}')
    if top[MARK] != VERSION or isinstance(top[MARK], bool):
        raise FormatError(f"{path}: a camera path of version {quoted(top[MARK], 20)}; this program reads 1")
    entries = top.get("keyframes")
    if not isinstance(entries, list) or not 1 <= len(entries) <= MOST:
        raise FormatError(
            f"{path}: 'keyframes' is not a list of 1 to {MOST} keyframes; record the path again"
        )
    keyframes: list[Keyframe] = []
    for index, entry in enumerate(entries):
        what = f"{path}: keyframe {index}"
        pose = pose_from(entry, what)
        seconds = float(numbers(entry, "seconds", (), what))
        if not 0 <= seconds <= LONGEST:
            raise FormatError(f"{what}: 'seconds' is {seconds:g}; expected 0 to {LONGEST:g}")
        if keyframes and seconds - keyframes[-1].seconds < SAME_TIME:
            raise FormatError(f"{what}: 'seconds' is not later than that of the keyframe before; sort them")
        keyframes.append(Keyframe(seconds, pose))
    return Flight(tuple(keyframes))


def write_flight(path: Path | str, flight: Flight) -> None:
    """Write `flight`, whole or not at all."""
    entries = [{"seconds": key.seconds, **pose_entry(key.pose)} for key in flight.keyframes]
    lines = ",\n".join(json.dumps(entry) for entry in entries)
    with atomic_path(path) as temporary:
        text = f'{{"{MARK}": {VERSION}, "keyframes": [\n{lines}\n]}}\n'
        temporary.write_text(text, encoding="utf-8")


def pose_entry(pose: Pose) -> dict[str, Any]:
    """A pose as JSON has it."""
    entry = {
        "position": np.asarray(pose.position, float).tolist(),
        "rotation": np.asarray(pose.rotation, float).T.tolist(),
        "fov_degrees": float(pose.fov_degrees),
    }
    return entry if pose.span is None else {**entry, "span": float(pose.span)}


def pose_from(entry: Any, what: str) -> Pose:
    """The pose that `pose_entry` wrote; FormatError, beginning with `what`, where there is none."""
    if not isinstance(entry, dict):
        raise FormatError(f"{what}: expected an object with position, rotation, fov_degrees")
    position = numbers(entry, "position", (3,), what)
    if np.abs(position).max() > FARTHEST:
        raise FormatError(f"{what}: 'position' is more than {FARTHEST:g} units from the origin")
    rotation = numbers(entry, "rotation", (3, 3), what)
    if not is_rotation(rotation):
        raise FormatError(f"{what}: 'rotation' is not a rotation matrix")
    fov = float(numbers(entry, "fov_degrees", (), what))
    if not FOV_LIMITS[0] <= fov <= FOV_LIMITS[1]:
        low, high = FOV_LIMITS
        raise FormatError(f"{what}: 'fov_degrees' is {fov:g}; expected {low:g} to {high:g}")
    span = float(numbers(entry, "span", (), what)) if "span" in entry else None
    if span is not None and not SPAN_LIMITS[0] <= span <= SPAN_LIMITS[1]:
        low, high = SPAN_LIMITS
        raise FormatError(f"{what}: 'span' is {span:g}; expected {low:g} to {high:g}")
    return Pose(position, rotation.T, fov, span)
