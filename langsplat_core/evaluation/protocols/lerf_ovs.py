"""LERF-OVS as LangSplat released it: polygons in JSON files of the ISAT tool.

    lerf_ovs/label/<scene>/<frame>.json  info {name, width, height},
                                         objects [{category, bbox [x1, y1, x2, y2], segmentation [[x, y]...]}]
    lerf_ovs/label/<scene>/<frame>.jpg   the photograph again (not needed)
    lerf_ovs/<scene>/                    photographs and cameras

An object has one polygon; a category that occurs several times in a frame is one query with all its polygons.
"""

from pathlib import Path
from typing import Any, TypeGuard

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.errors import FormatError, InputError
from langsplat_core.evaluation.protocols.labels import (
    Benchmark,
    Frame,
    Label,
    LabelledScene,
    Outlines,
    Size,
    photograph_of,
)
from langsplat_core.parsing.opening import read_json_file

LIMIT = 2**26  # bytes of a label file; real ones have some hundred kilobytes
MAX_SIDE = 20_000  # px of a label's grid
WANTED = "expected label/<scene>/<frame>.json in it, or one scene's folder of those"


def read_lerf_ovs(folder: Path) -> Benchmark:
    """The labels in `folder`: the benchmark's, one scene's of `label`, or one scene's dataset beside `label`.

    Raises InputError for a folder of another layout and FormatError for a file that breaks it.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; {WANTED}")
    if (folder / "label").is_dir():
        folders = {path.name: (path, folder / path.name) for path in sorted((folder / "label").iterdir())}
        found = {name: pair for name, pair in folders.items() if any(pair[0].glob("*.json"))}
    elif (folder.parent / "label" / folder.name).is_dir():
        found = {folder.name: (folder.parent / "label" / folder.name, folder)}
    elif _holds_labels(folder):
        found = {folder.name: (folder, folder.parent.parent / folder.name)}
    else:
        found = {}
    if not found:
        other = (folder / "segmentations").is_dir() or any(folder.glob("*/segmentations"))
        hint = "it looks like 3D-OVS: use `langsplat eval 3d-ovs`; " if other else ""
        raise InputError(f"{folder}: not in the layout of LERF-OVS; {hint}{WANTED}")
    return Benchmark("lerf-ovs", {name: _read_scene(name, *pair) for name, pair in found.items()})


def _holds_labels(folder: Path) -> bool:
    first = min((path for path in folder.glob("*.json") if path.name != "transforms.json"), default=None)
    if first is None:
        return False
    content = read_json_file(first, LIMIT)
    return isinstance(content, dict) and "objects" in content


def _read_scene(name: str, labels: Path, dataset: Path) -> LabelledScene:
    frames, left_out = [], []
    for path in sorted(labels.glob("*.json")):
        frame, without = _read_frame(path, dataset)
        frames.append(frame)
        left_out += [f"{frame.name}: {phrase} (no outline)" for phrase in without]
    if not any(frame.labels for frame in frames):
        raise FormatError(f"{labels}: its files label nothing; expected objects with a polygon each")
    return LabelledScene(name, tuple(frames), dataset, tuple(left_out))


def _read_frame(path: Path, dataset: Path) -> tuple[Frame, list[str]]:
    """The frame, and the categories of it that have no polygon with an inside."""
    content = read_json_file(path, LIMIT)
    size = _size(content, path)
    objects = content.get("objects")
    if not isinstance(objects, list):
        raise FormatError(f'{path}: no list of "objects"; it is not a label file of LERF-OVS')
    polygons: dict[str, list[Array]] = {}
    boxes: dict[str, list[Array]] = {}
    for number, item in enumerate(objects):
        phrase, polygon = _object(item, f"{path}: object {number}")
        polygons.setdefault(phrase, [])
        if len(polygon) >= 3:
            polygons[phrase].append(polygon)
            boxes.setdefault(phrase, []).append(_box(item.get("bbox"), polygon))
    labels = tuple(
        Label(phrase, Outlines(size, tuple(outlines)), np.stack(boxes[phrase]))
        for phrase, outlines in polygons.items()
        if outlines
    )
    photograph = photograph_of(path.parent, path.stem) or photograph_of(dataset / "images", path.stem)
    without = [phrase for phrase, outlines in polygons.items() if not outlines]
    return Frame(path.stem, size, labels, photograph), without


def _size(content: Any, path: Path) -> Size:
    info = content.get("info") if isinstance(content, dict) else None
    width, height = (info.get("width"), info.get("height")) if isinstance(info, dict) else (0, 0)
    if not (_is_side(width) and _is_side(height)):
        raise FormatError(
            f'{path}: no "info" with width and height in pixels; it is not a label file of LERF-OVS'
        )
    return width, height


def _is_side(value: Any) -> TypeGuard[int]:
    return isinstance(value, int) and 0 < value <= MAX_SIDE


def _object(item: Any, where: str) -> tuple[str, Array]:
    """Category, and (K, 2) corners."""
    if (
        not isinstance(item, dict)
        or not isinstance(item.get("category"), str)
        or not item["category"].strip()
    ):
        raise FormatError(f'{where} has no "category"')
    try:
        corners = np.array(item.get("segmentation", []), np.float64).reshape(-1, 2)
    except (TypeError, ValueError):
        raise FormatError(f'{where}: "segmentation" is not one polygon [[x, y], ...]') from None
    if not (np.abs(corners) <= 10 * MAX_SIDE).all():  # NaN fails too
        raise FormatError(f'{where}: "segmentation" has corners far outside of any picture')
    return item["category"].strip(), corners


def _box(stored: Any, polygon: Array) -> Array:
    """(4,) the label's box, the polygon's own where there is none."""
    try:
        box = np.array(stored, np.float64)
    except (TypeError, ValueError):
        box = np.empty(0)
    if box.shape == (4,) and np.isfinite(box).all():
        return box
    return np.concatenate([polygon.min(0), polygon.max(0)])
