"""ScanNet's labelled vertices, and answers whose scores are known by construction."""

import json
from dataclasses import replace

import numpy as np
import pytest
from plyfile import PlyData, PlyElement

from langsplat_core.errors import FormatError, InputError
from langsplat_core.evaluation.run import Subject
from langsplat_core.evaluation.scannet import (
    CLASS_SETS,
    NYU40,
    point_table,
    read_points,
    read_scannet,
    run_scannet,
    save_point_json,
    scene_classes,
)
from langsplat_core.io.scenes import save_scene
from langsplat_core.query.engine import QueryEngine
from langsplat_core.scene import Scene
from tests.support.fakes import CENTRES, axis, blobs, language

NAME = "scene0000_00"


def write_labels(folder, positions, labels):
    folder.mkdir(parents=True, exist_ok=True)
    table = np.empty(len(labels), [("x", "f4"), ("y", "f4"), ("z", "f4"), ("red", "u1"), ("label", "u2")])
    for column, name in enumerate("xyz"):
        table[name] = np.asarray(positions)[:, column]
    table["label"], table["red"] = labels, 0
    path = folder / f"{NAME}_vh_clean_2.labels.ply"
    PlyData([PlyElement.describe(table, "vertex")]).write(str(path))
    return path


@pytest.fixture
def labelled(tmp_path):
    """Ten vertices: 4 walls, 3 beds, 2 pictures, and one that nobody labelled."""
    labels = [NYU40["wall"]] * 4 + [NYU40["bed"]] * 3 + [NYU40["picture"]] * 2 + [0]
    write_labels(tmp_path / "data" / NAME, np.zeros((10, 3)), labels)
    return tmp_path


def run(tmp_path, ids, **more):
    (tmp_path / "maps").mkdir(exist_ok=True)
    np.save(tmp_path / "maps" / f"{NAME}.npy", np.asarray(ids))
    return run_scannet(read_scannet(tmp_path / "data"), Subject(maps=tmp_path / "maps"), None, **more)


def test_means_over_the_classes_that_are_there(labelled):
    wall, bed, picture = (NYU40[name] for name in ("wall", "bed", "picture"))
    # 3 of 4 walls right, all beds, one of which more on a wall; 1 of 2 pictures; the unlabelled one anything
    report = run(labelled, [wall, wall, wall, bed, bed, bed, bed, picture, 0, wall])
    nineteen, fifteen, ten = report.scores
    assert (nineteen.classes, nineteen.present, nineteen.points) == (19, 3, 9)
    assert nineteen.iou == pytest.approx((3 / 4 + 3 / 4 + 1 / 2) / 3)
    assert nineteen.accuracy == pytest.approx((3 / 4 + 1 + 1 / 2) / 3)
    for score, classes in ((fifteen, 15), (ten, 10)):  # without pictures
        assert (score.classes, score.present, score.points) == (classes, 2, 7)
        assert score.iou == pytest.approx(3 / 4)
        assert score.accuracy == pytest.approx(7 / 8)
    assert "| macro, mean of scenes | 19 |" in point_table(report)
    assert "fixed before a label was read" in point_table(report)


def test_json_and_nested_class_sets(labelled, tmp_path):
    save_point_json(tmp_path / "out.json", run(labelled, np.full(10, 1)))
    said = json.loads((tmp_path / "out.json").read_text())
    assert said["scores"][0]["accuracy"] == pytest.approx(1 / 3)
    nineteen, fifteen, ten = (set(names) for names in CLASS_SETS)
    assert [len(nineteen), len(fifteen), len(ten)] == [19, 15, 10]
    assert ten < fifteen < nineteen


def test_vertices_take_the_nearest_meaning(tmp_path):
    """The blobs are called wall, floor and bed; vertices stand near their middles."""
    known = {name: axis(3) for name in NYU40} | {"wall": axis(0), "floor": axis(1), "bed": axis(2)}
    field = language()
    confidence = field.confidence.copy()
    confidence[1] = 0  # at part level all blobs are alike
    field = replace(field, phrasebook=known, confidence=confidence)
    save_scene(tmp_path / f"{NAME}.ply", Scene(blobs(), field))
    positions = np.repeat(CENTRES, 2, 0) + 0.01
    names = ["wall", "wall", "floor", "floor", "bed", "sofa"]  # the last is called bed
    write_labels(tmp_path / "data", positions, [NYU40[name] for name in names])
    report = run_scannet(read_scannet(tmp_path / "data"), Subject(scene=tmp_path), None)
    assert report.scores[0].iou == pytest.approx((1 + 1 + 1 / 2 + 0) / 4)
    assert report.scores[0].accuracy == pytest.approx(3 / 4)


def test_words_that_the_encoder_lacks_are_wrong_everywhere(tmp_path):
    class Half:
        def encode_texts(self, texts):
            return np.stack([axis(3) for _ in texts])

        def unknown_words(self, text):
            return ("bathtub",) if text == "bathtub" else ()

    engine = QueryEngine(Scene(blobs(), language()), lambda _: Half())
    path = write_labels(tmp_path, CENTRES, [NYU40["bathtub"]] * 3)
    found, unknown = scene_classes(engine, read_points(path, NAME))
    assert unknown == ("bathtub",)
    assert not any((ids == NYU40["bathtub"]).any() for ids in found)


@pytest.mark.parametrize("ids", [np.zeros(9, int), np.zeros(10), np.zeros((2, 10), int)])
def test_maps_of_another_length(labelled, ids):
    with pytest.raises(FormatError, match="one per vertex"):
        run(labelled, ids)


def test_other_layouts(labelled, tmp_path):
    with pytest.raises(InputError, match="not in the layout of ScanNet"):
        read_scannet(tmp_path / "absent")
    path = tmp_path / f"{NAME}_vh_clean_2.labels.ply"
    table = np.zeros(3, [("x", "f4"), ("y", "f4"), ("z", "f4")])
    PlyData([PlyElement.describe(table, "vertex")]).write(str(path))
    with pytest.raises(FormatError, match="lack x, y, z or label"):
        read_points(path, NAME)
    with pytest.raises(InputError, match="--only other"):
        run(labelled, np.zeros(10, int), only=("other",))
    with pytest.raises(InputError, match="no such file"):
        run_scannet(read_scannet(labelled / "data"), Subject(maps=tmp_path / "nothing"), None)
