"""A scene with the numbers of its instances, parts and classes as properties of its Gaussians."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from langsplat_core.io.files import atomic_path, check_output_file
from langsplat_core.io.scenes import check_writable, save_scene
from langsplat_core.query.describe import OR, Describer
from langsplat_core.query.instances import axis_aligned_box
from langsplat_core.query.inventory import Outline, scene_outline
from langsplat_core.scene import LEVELS, NO_NODE


def export_labels(describer: Describer, path: Path) -> Path:
    """Write the scene as a .ply of that name with labels, and return the `<name>.labels.json` beside it.

    Its Gaussians have the int properties `instance`, `part` and `class`. An instance is a node at the top of
    the outline, a part the smallest node of it that a Gaussian is in, both by their numbers in the tree; a
    class is the place of the instance's likeliest word in the JSON's `classes`. -1 is none. The JSON has the
    nodes of the outline, each with its parent, level, word and class, Gaussians, axis-aligned box (lower and
    upper corner, between 2 % and 98 % of the Gaussians) and votes.
    """
    scene, members = describer.engine.scene, describer.engine.tree.gaussians()
    labels = {
        name: np.full(len(scene.gaussians), NO_NODE, np.int32) for name in ("instance", "part", "class")
    }
    classes: list[str] = []
    nodes: list[dict[str, Any]] = []

    def place(outline: Outline, parent: int) -> None:
        rows, word = members[outline.node], outline.word
        name = None if word is None else word.phrase.split(OR)[0]
        if name is not None and name not in classes:
            classes.append(name)
        number = NO_NODE if name is None else classes.index(name)
        labels["part"][rows] = outline.node
        if parent == NO_NODE:
            labels["instance"][rows], labels["class"][rows] = outline.node, number
        node: dict[str, Any] = {"node": outline.node, "parent": parent, "level": LEVELS[outline.level]}
        node |= {"word": None if word is None else word.phrase, "class": number}
        if word is not None and describer.engine.basis.calibration is not None:
            node["probability"] = word.probability
        positions = scene.gaussians.means[rows].astype(np.float64)
        node |= {"gaussians": outline.count, "centre": outline.centre.tolist()}
        nodes.append(node | {"box": axis_aligned_box(positions).tolist(), "votes": list(outline.votes)})
        for part in outline.parts:  # whose Gaussians are among these, and take their own number
            place(part, outline.node)

    for outline in scene_outline(describer):
        place(outline, NO_NODE)
    beside = path.with_suffix(".labels.json")
    check_writable(path)
    check_output_file(beside)
    kept = {name: values for name, values in scene.extras.items() if name not in labels}
    with atomic_path(beside) as temporary:
        counts = {"gaussians": len(scene.gaussians), "classes": classes, "nodes": nodes}
        temporary.write_text(json.dumps({"scene": path.name, **counts}, indent=1) + "\n", encoding="utf-8")
        save_scene(path, replace(scene, extras=kept | labels, path=path))
    return beside
