"""One picture per answer: photograph, mask that was found, the label's outline and boxes, the place."""

from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw
from scipy.ndimage import binary_erosion

from langsplat_core.arrays import Array
from langsplat_core.datasets.images import read_photo
from langsplat_core.evaluation.protocols.labels import Frame, Label
from langsplat_core.evaluation.protocols.map_files import file_name
from langsplat_core.evaluation.protocols.reading import Prediction
from langsplat_core.files import atomic_path

FOUND = np.array([250, 115, 25])  # tint of the mask
TRUTH = (60, 220, 90)  # the label's outline and boxes
PLACE = (40, 130, 255)
OPACITY = 0.55
MAX_MARKS = 100  # of a flat map every pixel is a peak


def write_picture(folder: Path, frame: Frame, label: Label, answer: Prediction, truth: Array) -> None:
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
