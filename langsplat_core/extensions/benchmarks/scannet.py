"""ScanNet, direct in 3D: every labelled vertex takes the class of the Gaussian nearest to it.

    <scene>/<scene>_vh_clean_2.labels.ply     vertices with x, y, z and `label`, an id of the NYU40 classes

Scored are 19, 15 and 10 classes (OpenGaussian), each time by an argmax over those phrases alone, among the
vertices whose true class is one of them. mIoU and mAcc are means over the classes that the scene has.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from types import MappingProxyType

import numpy as np
from scipy.spatial import cKDTree

from langsplat_core.arrays import Array
from langsplat_core.errors import FormatError, InputError
from langsplat_core.extensions.benchmarks.report import FIXED, Evaluated, chosen_scenes, open_scene
from langsplat_core.io.files import write_json
from langsplat_core.io.hostile import read_npy
from langsplat_core.io.ply_table import open_ply
from langsplat_core.progress import Progress, silent
from langsplat_core.query.engine import LoadEncoder, QueryEngine

ENDING = "_vh_clean_2.labels.ply"
WANTED = f"expected <scene>/<scene>{ENDING} in it, one scene's folder, or such a file"
NYU40: Mapping[str, int] = MappingProxyType({
    "wall": 1, "floor": 2, "cabinet": 3, "bed": 4, "chair": 5, "sofa": 6, "table": 7, "door": 8, "window": 9,
    "bookshelf": 10, "picture": 11, "counter": 12, "desk": 14, "curtain": 16, "refrigerator": 24,
    "shower curtain": 28, "toilet": 33, "sink": 34, "bathtub": 36,
})  # fmt: skip
_NOT_IN_15 = ("picture", "refrigerator", "shower curtain", "bathtub")
_NOT_IN_10 = (*_NOT_IN_15, "cabinet", "counter", "desk", "curtain", "sink")


CLASS_SETS = (
    tuple(NYU40),
    tuple(name for name in NYU40 if name not in _NOT_IN_15),
    tuple(name for name in NYU40 if name not in _NOT_IN_10),
)
SOURCE = (
    "OpenGaussian's task, as VALA and others report it: argmax over the class names per Gaussian, the "
    "highest of its levels; a vertex takes the nearest Gaussian that has a meaning, since ours do not stay "
    "on the vertices"
)


@dataclass(frozen=True, eq=False)
class LabelledPoints:
    """Labelled vertices of one scene."""

    name: str
    positions: Array  # (V, 3) float32 world units
    labels: Array  # (V,) int32 ids of NYU40; 0: none


@dataclass(frozen=True)
class PointScore:
    """One scene and one set of classes."""

    scene: str
    classes: int  # in the set
    present: int  # of them in the scene
    points: int  # vertices that are scored
    iou: float  # mean over the present classes
    accuracy: float  # mean over the present classes of the share of their vertices that is right
    # present classes whose words the encoder was never taught: wrong everywhere
    unknown: tuple[str, ...] = ()


def read_scannet(folder: Path) -> dict[str, Path]:
    """Return the file of labels of each scene; InputError for another layout."""
    if folder.is_file() and folder.name.endswith(ENDING):
        files = [folder]
    else:
        files = sorted([*folder.glob(f"*{ENDING}"), *folder.glob(f"*/*{ENDING}")]) if folder.is_dir() else []
    if not files:
        raise InputError(f"{folder}: not in the layout of ScanNet; {WANTED}")
    return {path.name.removesuffix(ENDING): path for path in files}


def read_points(path: Path, name: str) -> LabelledPoints:
    """Return the labelled vertices of a scene; raises as the PLY reader does."""
    with open_ply(path) as ply:
        vertex = ply.elements.get("vertex")
        if vertex is None or not {"x", "y", "z", "label"} <= vertex.numbers.keys():
            raise FormatError(f"{path}: its vertices lack x, y, z or label; it is no label file of ScanNet")
        (positions,), columns = ply.read(vertex, ["xyz"], ["label"])
    with np.errstate(invalid="ignore"):
        labels = columns["label"].astype(np.int32)
    if not np.isfinite(positions).all():
        raise FormatError(f"{path}: holds positions that are not finite")
    return LabelledPoints(name, positions, labels)


def scene_classes(engine: QueryEngine, points: LabelledPoints) -> tuple[list[Array], tuple[str, ...]]:
    """Return the class that every vertex is given, and the class names that the encoder does not know.

    The classes are (V,) int32 ids for each set of classes, 0 for none, found without a look at the labels.
    """
    field, gaussians = engine.field, engine.scene.gaussians
    rows = np.flatnonzero(field.known.any(0) & gaussians.valid())
    if not len(rows):
        raise InputError("no Gaussian of the scene has a meaning; make its language field again")
    _, nearest = cKDTree(gaussians.means[rows]).query(points.positions)
    names = sorted({name for names in CLASS_SETS for name in names}, key=list(NYU40).index)
    unknown = tuple(name for name in names if engine.unknown_words(name))
    values = np.full((len(names), len(rows)), -1.0, np.float32)
    for row, name in enumerate(names):
        if name not in unknown:
            values[row] = engine.relevancy(engine.text_vector(name)).max(0)[rows]
    found = []
    for chosen in CLASS_SETS:
        part = [names.index(name) for name in chosen]
        ids = np.array([NYU40[name] for name in chosen], np.int32)
        best = values[part].argmax(0)
        found.append(np.where(values[part].max(0) >= 0, ids[best], 0)[nearest].astype(np.int32))
    return found, unknown


def map_classes(folder: Path, points: LabelledPoints) -> list[Array]:
    """Return another system's answer, read from `folder`/<scene>.npy, for each set of classes.

    The file holds (V,) whole ids of NYU40 in the vertices' order, or (S, V) with one row per set of classes.
    """
    path = folder / f"{points.name}.npy"
    ids = read_npy(path)
    count = len(CLASS_SETS)
    if ids.dtype.kind not in "iu" or ids.shape not in ((len(points.labels),), (count, len(points.labels))):
        raise FormatError(
            f"{path}: {ids.dtype} {ids.shape}; expected whole numbers of shape ({len(points.labels)},), one "
            f"per vertex, or ({count}, {len(points.labels)})"
        )
    return [ids] * count if ids.ndim == 1 else list(ids)


def score_points(
    points: LabelledPoints, found: list[Array], unknown: tuple[str, ...] = ()
) -> list[PointScore]:
    """Score the points, once for each set of classes."""
    scores = []
    for names, ids in zip(CLASS_SETS, found, strict=True):
        counted = np.isin(points.labels, [NYU40[name] for name in names])
        truth, given = points.labels[counted], ids[counted]
        present = [name for name in names if (truth == NYU40[name]).any()]
        ious, accuracies = [], []
        for name in present:
            right, said = truth == NYU40[name], given == NYU40[name]
            ious.append((right & said).sum() / (right | said).sum())
            accuracies.append(said[right].mean())
        mean_iou = float(np.mean(ious)) if ious else 0.0
        accuracy = float(np.mean(accuracies)) if accuracies else 0.0
        lost = tuple(name for name in present if name in unknown)
        scores.append(PointScore(points.name, len(names), len(present), len(truth), mean_iou, accuracy, lost))
    return scores


# ScanNet's scenes, whoever answers them, and the report.


@dataclass(frozen=True)
class PointReport:
    """One system on ScanNet."""

    subject: str
    scores: tuple[PointScore, ...]


def run_scannet(
    files: Mapping[str, Path],
    subject: Evaluated,
    load_encoder: LoadEncoder,
    only: Sequence[str] = (),
    progress: Progress = silent,
) -> PointReport:
    """Score `subject` on the scenes whose label files are given, or those named by `only`.

    Raises InputError for a scene or maps that do not belong to them.
    """
    names = chosen_scenes(list(files), only, subject)
    scores: list[PointScore] = []
    for done, name in enumerate(names):
        points = read_points(files[name], name)
        if subject.maps is not None:
            scores += score_points(points, map_classes(subject.maps, points))
        else:
            engine = open_scene(subject, name, load_encoder)
            found, unknown = scene_classes(engine, points)
            scores += score_points(points, found, unknown)
        progress("asking classes", (done + 1) / len(names))
    return PointReport(str(subject.scene or subject.maps), tuple(scores))


def point_table(report: PointReport) -> str:
    """Return the scores as a Markdown table, with notes below it."""
    lines = ["| | classes | of them present | vertices | mIoU % | mAcc % |", "|---|---|---|---|---|---|"]
    for s in report.scores:
        shares = f"{100 * s.iou:.1f} | {100 * s.accuracy:.1f}"
        lines.append(f"| {s.scene} | {s.classes} | {s.present} | {s.points} | {shares} |")
    for classes in dict.fromkeys(score.classes for score in report.scores):
        rows = [score for score in report.scores if score.classes == classes]
        shares = (
            f"{100 * np.mean([s.iou for s in rows]):.1f} | {100 * np.mean([s.accuracy for s in rows]):.1f}"
        )
        total = sum(score.points for score in rows)
        lines.append(f"| macro, mean of scenes | {classes} | | {total} | {shares} |")
    lines += ["", f"scannet, protocol direct-3d: {SOURCE}"]
    lines += [f"scored: {report.subject}", FIXED]
    unknown = dict.fromkeys(name for score in report.scores for name in score.unknown)
    if unknown:
        lines.append(
            f"the encoder does not know {', '.join(unknown)}: counted as wrong at each of their vertices"
        )
    return "\n".join(lines)


def save_point_json(path: Path, report: PointReport) -> None:
    """Write the whole report as JSON."""
    profile = {"name": "direct-3d", "source": SOURCE, "class_sets": CLASS_SETS}
    write_json(path, {"profile": profile, **asdict(report)})
