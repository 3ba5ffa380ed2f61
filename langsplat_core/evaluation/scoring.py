"""Answers scored against labels, query by query, and images of both."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw
from scipy.ndimage import binary_erosion

from langsplat_core.arrays import Array
from langsplat_core.datasets.capture import read_photo
from langsplat_core.evaluation.labels import Frame, Label, LabelledScene, Size, check_same_image
from langsplat_core.evaluation.profiles import Prediction, Profile, SilhouetteRule
from langsplat_core.evaluation.sources import Source, file_name
from langsplat_core.io.files import atomic_path
from langsplat_core.progress import Progress, silent
from langsplat_core.scene import LEVELS


def intersection_over_union(found: Array, truth: Array) -> float:
    """Return the intersection over union of two (H, W) boolean masks; 1 where both are empty."""
    union = np.logical_or(found, truth).sum()
    return float(np.logical_and(found, truth).sum() / union) if union else 1.0


# One image per answer: photograph, mask that was found, the label's outline and boxes, the place.

FOUND = np.array([250, 115, 25])  # tint of the mask
TRUTH = (60, 220, 90)  # the label's outline and boxes
PLACE = (40, 130, 255)
OPACITY = 0.55
MAX_MARKS = 100  # of a flat map every pixel is a peak


def write_image(folder: Path, frame: Frame, label: Label, answer: Prediction, truth: Array) -> None:
    """`folder`/<frame>/<phrase>.png on the scored grid; over black where the photograph is not there."""
    rows, columns = answer.mask.shape
    photo = np.zeros((rows, columns, 3))
    if frame.photograph is not None:
        photo = np.asarray(read_photo(frame.photograph, upright=False).resize((columns, rows)), np.float64)
    photo = np.where(answer.mask[..., None], (1 - OPACITY) * photo + OPACITY * FOUND, photo)
    photo[truth & ~binary_erosion(truth)] = TRUTH
    canvas = Image.fromarray(photo.astype(np.uint8))
    brush = ImageDraw.Draw(canvas)
    scale = np.array([columns / frame.size[0], rows / frame.size[1]] * 2)
    for box in [] if label.boxes is None else label.boxes * scale:
        corners = np.concatenate([np.minimum(box[:2], box[2:]), np.maximum(box[:2], box[2:])])
        brush.rectangle([float(value) for value in corners], outline=TRUTH)
    for column, row in answer.peaks[:MAX_MARKS]:
        brush.ellipse([column - 4, row - 4, column + 4, row + 4], outline=PLACE, width=2)
    with atomic_path(folder / frame.name / f"{file_name(label.phrase)}.png") as path:
        canvas.save(path, "PNG")


# Every labelled query against its answer.


@dataclass(frozen=True)
class QueryScore:
    """One phrase in one labelled view. What was not answered is wrong: a mean is over all queries."""

    scene: str
    frame: str
    phrase: str
    iou: float
    hit: bool | None  # whether the place lies in a box of the label; None: not scored
    level: str = ""  # whose map was cut
    unanswered: str = ""  # why there is no answer
    trained_on: bool | None = None  # whether the view is a training view; None: not known
    grid: Size = (0, 0)  # width and height that were scored


@dataclass(frozen=True)
class SceneScores:
    """The scores of all queries of a scene."""

    queries: tuple[QueryScore, ...]
    left_out: tuple[str, ...]  # labels that cannot be asked, each "frame: phrase (why)"


def score_scene(
    labelled: LabelledScene,
    source: Source,
    profile: Profile,
    pictures: Path | None = None,
    progress: Progress = silent,
) -> SceneScores:
    """Score every query of a scene; `pictures`: a folder for one image per answer.

    A frame's answers are complete, cut and all, before any mask of it is drawn. Raises InputError where a map
    has another shape than the labelled image.
    """
    scores: list[QueryScore] = []
    left_out = list(labelled.left_out)
    for done, frame in enumerate(labelled.frames):
        answers = source.answers(
            frame.name, scored_size(frame.size, profile.max_rows), [label.phrase for label in frame.labels]
        )
        for label in frame.labels:
            answer = answers[label.phrase]
            size = _grid(answer, frame)
            truth = label.truth.draw(size)
            if not truth.any():
                left_out.append(f"{frame.name}: {label.phrase} (empty mask)")
                continue
            score = _score(labelled.name, frame, label, answer, truth, profile)
            scores.append(replace(score, trained_on=source.trained_on(frame.name), grid=size))
            if pictures is not None and not isinstance(answer, str):
                write_image(pictures / labelled.name, frame, label, answer, truth)
        progress("asking phrases", (done + 1) / len(labelled.frames), labelled.name)
    return SceneScores(tuple(scores), tuple(left_out))


def scored_size(size: Size, max_rows: int) -> Size:
    """`size`, shrunk to `max_rows` rows where it has more."""
    width, height = size
    return size if height <= max_rows else (max(1, int(width * max_rows / height)), max_rows)


def _grid(answer: Prediction | str, frame: Frame) -> Size:
    if isinstance(answer, str):
        return frame.size
    rows, columns = answer.mask.shape
    check_same_image(frame.name, (columns, rows), frame.size)
    return columns, rows


def _score(
    scene: str, frame: Frame, label: Label, answer: Prediction | str, truth: Array, profile: Profile
) -> QueryScore:
    placed = label.boxes is not None and not isinstance(profile.rule, SilhouetteRule)
    if isinstance(answer, str):
        return QueryScore(scene, frame.name, label.phrase, 0.0, False if placed else None, unanswered=answer)
    hit = inside_any_box(answer.peaks, label.boxes, frame.size, truth.shape) if placed else None
    level = "" if answer.level is None else LEVELS[answer.level]
    return QueryScore(
        scene, frame.name, label.phrase, intersection_over_union(answer.mask, truth), hit, level
    )


def inside_any_box(peaks: Array, boxes: Array | None, size: Size, shape: tuple[int, ...]) -> bool:
    """Return True where any of the (P, 2) peaks, column and row on a grid of `shape` (rows, columns), lies in
    any of the (B, 4) boxes on the label's grid of `size`, borders included."""
    if boxes is None or not len(peaks):
        return False
    scale = np.array([shape[1] / size[0], shape[0] / size[1]])
    low, high = np.minimum(boxes[:, :2], boxes[:, 2:]) * scale, np.maximum(boxes[:, :2], boxes[:, 2:]) * scale
    inside = (peaks[:, None] >= low) & (peaks[:, None] <= high)
    return bool(inside.all(-1).any())
