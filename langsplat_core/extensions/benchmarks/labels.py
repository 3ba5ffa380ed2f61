"""Labels of the benchmarks: phrases in frames with true masks, which are drawn on demand."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, TypeVar
from unicodedata import normalize

import msgspec
import numpy as np
from PIL import Image, ImageDraw

from langsplat_core.arrays import Array
from langsplat_core.errors import FormatError, InputError
from langsplat_core.io.hostile import PHOTO_SUFFIXES, opened, picture_size, read_json_file, read_text

T = TypeVar("T")
Size = tuple[int, int]  # width and height, pixels
SAME_SHAPE = 0.02  # relative difference of aspect up to which two sizes may be of one image


@dataclass(frozen=True, eq=False)
class PolygonMask:
    """A polygon on the label's grid."""

    size: Size
    corners: Array  # (K, 2) float x, y, K >= 3

    def draw(self, size: Size) -> Array:
        """Return the mask on a grid of `size`, (H, W) bool."""
        canvas = Image.new("L", self.size)
        corners = [(int(x), int(y)) for x, y in self.corners]
        ImageDraw.Draw(canvas).polygon(corners, fill=1, outline=1)
        return resized(np.asarray(canvas) > 0, size)


@dataclass(frozen=True)
class MaskFile:
    """An image file of a mask, bright inside."""

    path: Path

    def draw(self, size: Size) -> Array:
        """Return the (H, W) bool mask on a grid of `size`: above half of 255, or above 0 of 0 and 1."""
        grey = read_grey(self.path)
        return resized(grey > (127 if grey.max(initial=0) > 1 else 0), size)


@dataclass(frozen=True, eq=False)
class LabelledPhrase:
    """A phrase in a frame, with its true masks and boxes."""

    phrase: str
    masks: tuple[PolygonMask | MaskFile, ...]  # of its instances; empty if it names nothing in the frame
    # (B, 4) left, top, right, bottom on the label's grid, inclusive; None: no position is scored
    boxes: Array | None
    targets: int | None = None  # number of its instances in the frame; None: at least one

    def truth(self, size: Size) -> Array:
        """Return the union of the masks on a grid of `size`, (H, W) bool."""
        return np.any([mask.draw(size) for mask in self.masks] or [np.zeros(size[::-1], bool)], axis=0)


@dataclass(frozen=True, eq=False)
class Frame:
    """A labelled view of a scene."""

    name: str  # of its photograph, without extension; other dots are kept
    size: Size  # of the label's grid
    labels: tuple[LabelledPhrase, ...]


@dataclass(frozen=True, eq=False)
class LabelledScene:
    """A scene of a benchmark."""

    name: str
    frames: tuple[Frame, ...]
    dataset: Path  # folder of its photographs and cameras, if it has them
    left_out: tuple[str, ...] = ()  # labels that cannot be scored, each "frame: phrase (why)"


@dataclass(frozen=True, eq=False)
class Benchmark:
    """A benchmark's scenes in a folder."""

    name: str
    scenes: Mapping[str, LabelledScene]


def read_grey(path: Path) -> Array:
    """Return (H, W) uint8 brightness of an image file; FormatError if it cannot be read."""
    with opened(path) as image:
        return np.asarray(image.convert("L"))


def resized(mask: Array, size: Size) -> Array:
    """Return (H, W) bool mask on a grid of `size`, by the nearest pixel."""
    image = Image.fromarray(mask.astype(np.uint8))
    return np.asarray(image.resize(size, Image.Resampling.NEAREST)) > 0


def check_same_image(frame: str, drawn: Size, labelled: Size) -> None:
    """Raise InputError if a map or camera has another aspect ratio than the labelled image."""
    (columns, rows), (width, height) = drawn, labelled
    slack = max(SAME_SHAPE * width * rows, width, height, columns, rows)  # a pixel of rounding is allowed
    if abs(columns * height - width * rows) > slack:
        raise InputError(
            f"frame {frame}: the view is {columns}x{rows}, the labels are {width}x{height}: not of one "
            "image; use views and labels of the same photographs"
        )


def without_suffix(name: str) -> str:
    """Return a view's name without a photograph's extension; other dots stay."""
    stem, dot, suffix = name.rpartition(".")
    return stem if dot and f".{suffix.lower()}" in PHOTO_SUFFIXES else name


def photograph_of(folder: Path, name: str) -> Path | None:
    """Return the photograph called `name`, of any kind, in a folder; None without one."""
    candidates = (folder / f"{name}{suffix}" for suffix in (*PHOTO_SUFFIXES, ".JPG", ".JPEG", ".PNG"))
    return next((path for path in candidates if path.is_file()), None)


# LERF-OVS as LangSplat released it: polygons in JSON files of the ISAT tool.
#
# lerf_ovs/label/<scene>/<frame>.json  info {name, width, height}, objects [{category,
#                                      bbox [x1, y1, x2, y2], segmentation [[x, y]...]}]
# lerf_ovs/<scene>/                    photographs and cameras
#
# An object has one polygon; a category that occurs several times in a frame is one query with all its
# polygons.

LIMIT = 2**26  # bytes of a label file; real ones have some hundred kilobytes
WANTED = "expected label/<scene>/<frame>.json in it, or one scene's folder of those"
_Side = Annotated[int, msgspec.Meta(gt=0, le=20_000)]  # px of a label's grid


class _Info(msgspec.Struct):
    width: _Side
    height: _Side


class _Object(msgspec.Struct):
    category: Annotated[str, msgspec.Meta(pattern=r"\S")]
    segmentation: list[tuple[float, float]] = []
    bbox: Any = None


class _LabelFile(msgspec.Struct):
    info: _Info
    objects: list[_Object]


def read_lerf_ovs(folder: Path) -> Benchmark:
    """Return the labels in `folder`.

    The folder is the benchmark's, one scene's of `label`, or one scene's dataset beside `label`. Raises
    InputError for a folder of another layout and FormatError for a file that breaks it.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; {WANTED}")
    if (folder / "label").is_dir():
        folders = {path.name: (path, folder / path.name) for path in sorted((folder / "label").iterdir())}
        found = {name: pair for name, pair in folders.items() if any(pair[0].glob("*.json"))}
    elif (folder.parent / "label" / folder.name).is_dir():
        found = {folder.name: (folder.parent / "label" / folder.name, folder)}
    elif folder.resolve().parent.name == "label":
        found = {folder.name: (folder, folder.parent.parent / folder.name)}
    else:
        found = {}
    if not found:
        raise InputError(f"{folder}: not in the layout of LERF-OVS; {WANTED}")
    return Benchmark("lerf-ovs", {name: _read_scene(name, *pair) for name, pair in found.items()})


def _read_scene(name: str, labels: Path, dataset: Path) -> LabelledScene:
    frames, left_out = [], []
    for path in sorted(labels.glob("*.json")):
        frame, without = _read_frame(path)
        frames.append(frame)
        left_out += [f"{frame.name}: {phrase} (no outline)" for phrase in without]
    if not any(frame.labels for frame in frames):
        raise FormatError(f"{labels}: its files label nothing; expected objects with a polygon each")
    return LabelledScene(name, tuple(frames), dataset, tuple(left_out))


def _stated(path: Path, kind: type[T], benchmark: str) -> T:
    """Return the content of a label file; FormatError if it does not fit `kind`."""
    try:
        return msgspec.convert(read_json_file(path, LIMIT), kind)
    except msgspec.ValidationError as error:
        raise FormatError(f"{path}: no label file of {benchmark}: {error}") from None


def _read_frame(path: Path) -> tuple[Frame, list[str]]:
    """Return the frame, and the categories of its objects that have no polygon with an inside."""
    content = _stated(path, _LabelFile, "LERF-OVS")
    size = content.info.width, content.info.height
    drawn: dict[str, list[tuple[PolygonMask, Array]]] = {}  # each with its box
    without: list[str] = []
    for number, item in enumerate(content.objects):
        own = drawn.setdefault(item.category.strip(), [])
        corners = _corners(item.segmentation, size, f"{path}: object {number}")
        if len(corners) >= 3:
            own.append((PolygonMask(size, corners), _box(item.bbox, corners)))
        else:
            without.append(item.category.strip())
    labels = tuple(
        LabelledPhrase(phrase, tuple(outline for outline, _ in own), np.stack([box for _, box in own]))
        for phrase, own in drawn.items()
        if own
    )
    return Frame(path.stem, size, labels), without


def _corners(stored: list[tuple[float, float]], size: Size, where: str) -> Array:
    corners = np.array(stored, np.float64).reshape(-1, 2)
    if not (np.abs(corners) <= 10 * max(size)).all():  # NaN fails too
        raise FormatError(f"{where} has corners far outside of the image")
    return corners


def _box(stored: Any, polygon: Array) -> Array:
    """Return the (4,) box of a label, else that of its polygon."""
    try:
        box = np.array(msgspec.convert(stored, tuple[float, float, float, float]))
    except msgspec.ValidationError:
        box = np.full(4, np.nan)
    return box if np.isfinite(box).all() else np.concatenate([polygon.min(0), polygon.max(0)])


# 3D-OVS (Liu et al. 2023): one mask image per view and class.
#
# <scene>/segmentations/classes.txt           one class a line
# <scene>/segmentations/<view>/<class>.png    bright inside, of any size and kind
# <scene>/images/<view>.jpg                   the photograph, whose grid is scored

WANTED_PICTURES = "expected segmentations/classes.txt in it, or in folders of it, one per scene"


def read_3d_ovs(folder: Path) -> Benchmark:
    """Return labels of a scene's `folder` or of several; InputError: another layout, FormatError: broken."""
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; {WANTED_PICTURES}")
    scenes = [folder] if _is_scene(folder) else [path for path in sorted(folder.iterdir()) if _is_scene(path)]
    if not scenes:
        raise InputError(f"{folder}: not in the layout of 3D-OVS; {WANTED_PICTURES}")
    return Benchmark("3d-ovs", {scene.resolve().name: _read_ovs3d_scene(scene) for scene in scenes})


def _is_scene(folder: Path) -> bool:
    return (folder / "segmentations" / "classes.txt").is_file()


def _read_ovs3d_scene(folder: Path) -> LabelledScene:
    classes = _classes(folder / "segmentations" / "classes.txt")
    stray, frames = [], []
    for view in sorted(path for path in (folder / "segmentations").iterdir() if path.is_dir()):
        masks = (path for path in sorted(view.iterdir()) if path.suffix.lower() in PHOTO_SUFFIXES)
        files = {normalize("NFC", path.stem): path for path in masks}
        stray += [f"{view.name}: {name} (not in classes.txt)" for name in files if name not in classes]
        labels = tuple(
            LabelledPhrase(name, (MaskFile(files[name]),), None) for name in classes if name in files
        )
        if labels:
            photograph = photograph_of(folder / "images", view.name)
            grid = picture_size(photograph or files[labels[0].phrase])
            frames.append(Frame(view.name, grid, labels))
    if not frames:
        raise FormatError(f"{folder / 'segmentations'}: no <view>/<class>.png for any line of classes.txt")
    return LabelledScene(folder.resolve().name, tuple(frames), folder, tuple(stray))


def _classes(path: Path) -> tuple[str, ...]:
    lines = normalize("NFC", read_text(path)).split("\n")
    classes = tuple(dict.fromkeys(line.strip() for line in lines if line.strip()))
    if not classes:
        raise FormatError(f"{path}: is empty; expected one class a line")
    return classes


# GR-LERF (ZeroSplat, ECCV 2026): phrases for none, one or several instances in LERF's scenes. Its files were
# not available; the layout is that of Ref-LERF (ReferSplat, ICML 2025), which has one instance per phrase.
#
# <scene>/json/test_json/<frame>.json   object or objects [{category, sentence [...], segmentation}]; the last
#                                       a file in <scene>/mask or gt_mask, or a polygon; none: no target
# <scene>/                              photographs and cameras
#
# Instances of a frame with the same sentence are its targets. The phrase of one without is its category.


class _Referred(msgspec.Struct):
    category: str = ""
    sentence: list[str] = []
    segmentation: str | list[tuple[float, float]] | None = None


class _ReferredFile(msgspec.Struct):
    info: _Info | None = None
    object: list[_Referred] = []
    objects: list[_Referred] = []


def read_gr_lerf(folder: Path) -> Benchmark:
    """Return the labels in `folder`, which is the benchmark's or one scene's; errors as `read_lerf_ovs`."""
    found = [
        path.parents[1] for path in sorted({*folder.glob("json/test_json"), *folder.glob("*/json/test_json")})
    ]
    if not found:
        raise InputError(f"{folder}: not in the layout of GR-LERF; expected <scene>/json/test_json/*.json")
    scenes = {}
    for scene in found:
        paths = sorted((scene / "json" / "test_json").glob("*.json"))
        frames = tuple(_referred_frame(path, scene) for path in paths)
        if not any(frame.labels for frame in frames):
            raise FormatError(f"{scene}: its files label nothing; expected objects with a sentence each")
        scenes[scene.resolve().name] = LabelledScene(scene.resolve().name, frames, scene)
    return Benchmark("gr-lerf", scenes)


def _referred_frame(path: Path, scene: Path) -> Frame:
    content = _stated(path, _ReferredFile, "GR-LERF")
    photograph = photograph_of(scene / "images", path.stem)
    if content.info is not None:
        size = content.info.width, content.info.height
    elif photograph is not None:
        size = picture_size(photograph)
    else:
        raise FormatError(f"{path}: has no info of width and height; add it, or images/{path.stem}.jpg")
    masks: dict[str, list[PolygonMask | MaskFile]] = {}
    for item in (*content.object, *content.objects):
        for sentence in item.sentence or [item.category]:
            own = masks.setdefault(" ".join(sentence.split()), [])
            if isinstance(item.segmentation, str) and item.segmentation:
                own.append(_mask_in(scene, item.segmentation, path))
            elif item.segmentation:
                corners = _corners(item.segmentation, size, f"{path}: {sentence!r}")
                own.append(PolygonMask(size, np.resize(corners, (max(len(corners), 3), 2))))
    labels = (LabelledPhrase(phrase, tuple(own), None, len(own)) for phrase, own in masks.items() if phrase)
    return Frame(path.stem, size, tuple(labels))


def _mask_in(scene: Path, name: str, path: Path) -> MaskFile:
    """Return the mask file of a scene that a label names; FormatError if it is missing."""
    inside = not Path(name).is_absolute() and ".." not in Path(name).parts
    candidates = [scene / folder / name for folder in ("mask", "gt_mask", ".")] if inside else []
    found = next((one for one in candidates if one.is_file()), None)
    if found is None:
        raise FormatError(f"{path}: no mask file {name!r} in {scene / 'mask'}")
    return MaskFile(found)
