"""A rendered room whose truth is also written as the field's benchmarks write their labels."""

import json
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

import numpy as np
from PIL import Image
from scipy.ndimage import find_objects
from scipy.ndimage import label as connected

from langsplat_core.arrays import Array
from langsplat_core.io.files import atomic_path
from langsplat_core.lab.config import LabelLayout, Tier
from langsplat_core.lab.rooms.outlines import outlines
from langsplat_core.lab.rooms.scoring import MIN_PIXELS
from langsplat_core.lab.rooms.truth import Phrase, Truth, read_truth
from langsplat_core.lab.world.photographs import PLAIN, Naming, write_dataset
from langsplat_core.progress import Progress

SCENE = "room"  # the benchmark's name for it
LABELLED_EVERY = 8  # views; those that training holds out unless told otherwise
NAMES: Mapping[LabelLayout, Naming] = MappingProxyType(
    {"plain": PLAIN, "lerf-ovs": Naming("frame_{:05d}", ".jpg", 1), "3d-ovs": Naming("{:02d}", ".jpg")}
)
ASKED = ("object", "colour+object", "part")  # kinds of phrases that LERF-OVS's labels are like
PIECES = np.ones((3, 3), int)  # pixels that touch at a corner are of one piece


def write_labelled(
    out: Path,
    layout: LabelLayout,
    seed: int,
    views: int,
    size: tuple[int, int],
    progress: Progress,
    tier: Tier = "clutter",
) -> Path:
    """Render a room as `write_dataset` does, into `out` itself or, in a benchmark's layout, into `out`/room,
    and label every eighth view in that layout. Returns the photographs' folder. Raises as `write_dataset`."""
    folder = out if layout == "plain" else out / SCENE
    write_dataset(folder, seed, views, size, progress, tier, NAMES[layout])
    if layout == "plain":
        return folder
    truth = read_truth(folder)
    names = sorted(path.stem for path in (folder / "truth").glob("*.npz"))[::LABELLED_EVERY]
    if layout == "lerf-ovs":
        write_lerf_ovs(folder, out / "label" / SCENE, truth, names)
    else:
        write_3d_ovs(folder, truth, names)
    return folder


def _visible(truth: Truth, name: str, kinds: tuple[str, ...]) -> dict[Phrase, Array]:
    """The phrases that are true for enough of a view to be asked there, and where."""
    labels = truth.labels(name)
    masks = {p: np.asarray(np.isin(labels, p.ids).any(axis=0)) for p in truth.phrases if p.kind in kinds}
    return {phrase: mask for phrase, mask in masks.items() if mask.sum() >= MIN_PIXELS}


def write_lerf_ovs(dataset: Path, labels: Path, truth: Truth, names: list[str]) -> None:
    """label/<scene>/<frame>.json and .jpg. A mask of several pieces, or with holes, becomes several objects
    of one category, whose polygons joined are the mask."""
    for name in names:
        photograph = (dataset / "images" / f"{name}.jpg").read_bytes()
        with atomic_path(labels / f"{name}.jpg") as path:
            path.write_bytes(photograph)
        height, width = truth.labels(name).shape[1:]
        objects = [
            {"category": phrase.text, "bbox": box, "segmentation": polygon}
            for phrase, mask in _visible(truth, name, ASKED).items()
            for polygon, box in _objects(mask)
        ]
        info = {"name": f"{name}.jpg", "width": width, "height": height}
        with atomic_path(labels / f"{name}.json") as path:
            path.write_text(json.dumps({"info": info, "objects": objects}) + "\n", encoding="utf-8")


def _objects(mask: Array) -> list[tuple[list[list[int]], list[int]]]:
    """(polygon, box) of every piece of a mask; what a piece is cut into for its holes keeps its box."""
    pieces, _ = connected(mask, PIECES)
    found = []
    for number, (rows, columns) in enumerate(find_objects(pieces), 1):
        box = [columns.start, rows.start, columns.stop - 1, rows.stop - 1]
        found += [(polygon.tolist(), box) for polygon in outlines(pieces == number)]
    return found


def write_3d_ovs(dataset: Path, truth: Truth, names: list[str]) -> None:
    """segmentations/<view>/<class>.png and, last, classes.txt; a class is what one calls a whole thing."""
    folder = dataset / "segmentations"
    classes: dict[str, None] = {}
    for name in names:
        for phrase, mask in _visible(truth, name, ("object",)).items():
            classes[phrase.text] = None
            with atomic_path(folder / name / f"{phrase.text}.png") as path:
                Image.fromarray(np.where(mask, 255, 0).astype(np.uint8)).save(path)
    with atomic_path(folder / "classes.txt") as path:
        path.write_text("\n".join(sorted(classes)) + "\n", encoding="utf-8")
