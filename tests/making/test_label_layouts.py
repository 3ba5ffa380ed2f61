"""A rendered room in the layouts of the benchmarks: the labels say what the truth says."""

import json

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from assets.making import dataset as photographs
from assets.making.dataset import outlines, write_labelled
from assets.making.truth import read_truth
from langsplat_core.cli.app import parse
from langsplat_core.evaluation.labels import Outlines, read_3d_ovs, read_lerf_ovs
from langsplat_core.lab.rooms.scoring import MIN_PIXELS
from langsplat_core.progress import silent

SEED, VIEWS, SIZE = 2, 9, (160, 120)  # the room of the bundled scene


def drawn(mask):
    polygons = outlines(mask)
    assert all(len(polygon) >= 3 for polygon in polygons)
    size = (mask.shape[1], mask.shape[0])
    return Outlines(size, tuple(polygon.astype(float) for polygon in polygons)).draw(size)


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("sigma", [0.0, 0.7, 2.0])
def test_polygons_give_back_the_mask(seed, sigma):
    """Pieces, holes, islands in holes, single pixels, diagonal lines, the picture's border."""
    values = gaussian_filter(np.random.default_rng(seed).normal(size=(40, 50)), sigma)
    mask = values > np.quantile(values, 0.35 if seed % 2 else 0.6)
    np.testing.assert_array_equal(drawn(mask), mask)


def test_polygons_of_simple_shapes():
    ring = np.zeros((9, 9), bool)
    ring[1:8, 1:8], ring[3:6, 3:6] = True, False
    for mask in (ring, ~ring, np.eye(6, dtype=bool), np.ones((3, 4), bool), np.ones((1, 1), bool)):
        np.testing.assert_array_equal(drawn(mask), mask)
    assert outlines(np.zeros((4, 4), bool)) == []


@pytest.fixture(scope="module")
def rooms(tmp_path_factory):
    """The same room in both layouts, in plain light."""
    patch = pytest.MonkeyPatch()
    patch.setattr(photographs, "LIGHT_SAMPLES", 2)
    patch.setattr(photographs, "LIGHT_CELL", 0.0)
    out = tmp_path_factory.mktemp("rooms")
    for layout in ("lerf-ovs", "3d-ovs"):
        write_labelled(out / layout, layout, SEED, VIEWS, SIZE, silent)
    patch.undo()
    return out


def truth_of(folder, name):
    truth = read_truth(folder)
    labels = truth.labels(name)
    masks = {(p.text, p.kind): np.isin(labels, p.ids).any(0) for p in truth.phrases}
    return {key: mask for key, mask in masks.items() if mask.sum() >= MIN_PIXELS}


@pytest.mark.long
def test_lerf_labels_are_the_truth(rooms):
    (scene,) = read_lerf_ovs(rooms / "lerf-ovs").scenes.values()
    assert (scene.name, [frame.name for frame in scene.frames]) == ("room", ["frame_00001", "frame_00009"])
    several = 0
    for frame in scene.frames:
        masks = {
            text: mask
            for (text, kind), mask in truth_of(scene.dataset, frame.name).items()
            if kind != "subpart"
        }
        assert {label.phrase for label in frame.labels} == set(masks)
        assert frame.size == SIZE
        for label in frame.labels:
            np.testing.assert_array_equal(label.truth.draw(SIZE), masks[label.phrase])
            several += len(label.boxes) > 1
    assert several > 5


@pytest.mark.long
def test_3d_ovs_labels_are_the_truth(rooms):
    (scene,) = read_3d_ovs(rooms / "3d-ovs").scenes.values()
    assert [frame.name for frame in scene.frames] == ["00", "08"]
    for frame in scene.frames:
        masks = {
            text: mask
            for (text, kind), mask in truth_of(scene.dataset, frame.name).items()
            if kind == "object"
        }
        assert {label.phrase for label in frame.labels} == set(masks)
        for label in frame.labels:
            np.testing.assert_array_equal(label.truth.draw(SIZE), masks[label.phrase])


@pytest.mark.long
@pytest.mark.parametrize(("layout", "protocol"), [("lerf-ovs", "langsplat-code"), ("3d-ovs", "ours")])
def test_the_whole_command_on_a_complete_set(rooms, tmp_path, capsys, layout, protocol):
    """The bundled scene shows the same room; it has never seen these views, whose cameras the dataset has."""
    out = tmp_path / "out.json"
    words = ["eval", layout, "assets/demo/scene.ply", str(rooms / layout), "--protocol", protocol]
    parse([*words, "--json", str(out), "--pictures", str(tmp_path / "pictures")]).run()
    content = json.loads(out.read_text())
    micro = content["means"]["micro, mean of queries"]
    assert micro["queries"] == len(content["queries"]) > 20
    assert micro["iou"] > 0.4
    assert "macro, mean of frames" in capsys.readouterr().out
    assert len(list((tmp_path / "pictures").rglob("*.png"))) == micro["queries"]
