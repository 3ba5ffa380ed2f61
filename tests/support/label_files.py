"""Small label folders in the layouts of the field's benchmarks, of masks and polygons that a test chooses."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from langsplat_core.arrays import Array

Polygon = list[list[float]]
SIZE = (40, 30)  # width and height, pixels


def rectangle(left: int, top: int, right: int, bottom: int) -> Polygon:
    """Corners, all of them inside the mask."""
    return [[left, top], [right, top], [right, bottom], [left, bottom]]


def block(left: int, top: int, right: int, bottom: int, size: tuple[int, int] = SIZE) -> Array:
    """The mask of `rectangle`."""
    mask = np.zeros((size[1], size[0]), bool)
    mask[top : bottom + 1, left : right + 1] = True
    return mask


def lerf_frame(
    folder: Path, name: str, objects: Sequence[tuple[str, Polygon]], size: tuple[int, int] = SIZE
) -> Path:
    """label file `name`.json in `folder`; boxes are the polygons' own."""
    folder.mkdir(parents=True, exist_ok=True)
    rows = []
    for category, polygon in objects:
        corners = np.array(polygon or [[0, 0]])
        box = [*corners.min(0).tolist(), *corners.max(0).tolist()]
        rows.append({"category": category, "bbox": box, "segmentation": polygon, "group": 1})
    path = folder / f"{name}.json"
    info = {"name": f"{name}.jpg", "width": size[0], "height": size[1], "depth": 3, "note": ""}
    path.write_text(json.dumps({"info": info, "objects": rows}))
    return path


def ovs_view(
    scene: Path, name: str, masks: Mapping[str, Array], photo: tuple[int, int] | None = SIZE
) -> None:
    """segmentations/`name`/<class>.png and images/`name`.jpg; classes.txt is extended by what is new."""
    folder = scene / "segmentations" / name
    folder.mkdir(parents=True, exist_ok=True)
    for phrase, mask in masks.items():
        Image.fromarray((255 * mask).astype(np.uint8)).save(folder / f"{phrase}.png")
    listed = scene / "segmentations" / "classes.txt"
    known = listed.read_text().splitlines() if listed.exists() else []
    listed.write_text("\n".join([*known, *(phrase for phrase in masks if phrase not in known)]) + "\n")
    if photo is not None:
        (scene / "images").mkdir(exist_ok=True)
        Image.new("RGB", photo).save(scene / "images" / f"{name}.jpg")


def mask_map(folder: Path, phrase: str, mask: Array) -> None:
    """A relevancy map that is 1 in the mask and 0 outside, as another system might have rendered it."""
    folder.mkdir(parents=True, exist_ok=True)
    np.save(folder / f"{phrase}.npy", mask.astype(np.float32))


def silhouette(folder: Path, phrase: str, mask: Array) -> None:
    """The drawn selection, white on black."""
    folder.mkdir(parents=True, exist_ok=True)
    Image.fromarray((255 * mask).astype(np.uint8)).save(folder / f"{phrase}.png")
