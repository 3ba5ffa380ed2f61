"""Rooms drawn in the layouts of LERF-OVS and 3D-OVS, read and scored as the benchmarks are."""

import json

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from assets.making import dataset
from assets.making.dataset import MIN_PIXELS, outlines, write_labelled
from assets.making.truth import read_truth
from langsplat_core.cli.app import parse
from langsplat_core.extensions.benchmarks.labels import Outlines, read_3d_ovs, read_lerf_ovs
from langsplat_core.progress import silent

pytestmark = pytest.mark.long

SEED, VIEWS, SIZE = 2, 9, (160, 120)  # the room of the bundled scene


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("sigma", [0.0, 0.7, 2.0])
def test_polygons_reproduce_the_mask(seed, sigma):
    """Pieces, holes, islands in holes, single pixels, diagonal lines, the picture's border."""
    values = gaussian_filter(np.random.default_rng(seed).normal(size=(40, 50)), sigma)
    mask = values > np.quantile(values, 0.35 if seed % 2 else 0.6)
    polygons = outlines(mask)
    assert all(len(polygon) >= 3 for polygon in polygons)
    size = (mask.shape[1], mask.shape[0])
    drawn = Outlines(size, tuple(polygon.astype(float) for polygon in polygons)).draw(size)
    np.testing.assert_array_equal(drawn, mask)


@pytest.fixture(scope="module")
def rooms(tmp_path_factory):
    """The same room in both layouts, in plain light."""
    out = tmp_path_factory.mktemp("rooms")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(dataset, "LIGHT_SAMPLES", 2)
        patch.setattr(dataset, "LIGHT_CELL", 0.0)
        for layout in ("lerf-ovs", "3d-ovs"):
            write_labelled(out / layout, layout, SEED, VIEWS, SIZE, silent)
    return out


@pytest.mark.parametrize(
    ("layout", "read", "kinds", "names"),
    [
        ("lerf-ovs", read_lerf_ovs, ("object", "colour+object", "part"), ["frame_00001", "frame_00009"]),
        ("3d-ovs", read_3d_ovs, ("object",), ["00", "08"]),
    ],
)
def test_labels_state_the_truth_of_their_view(rooms, layout, read, kinds, names):
    (scene,) = read(rooms / layout).scenes.values()
    assert [frame.name for frame in scene.frames] == names
    truth, several = read_truth(scene.dataset), 0
    for frame in scene.frames:
        labels = truth.labels(frame.name)
        masks = {p.text: np.isin(labels, p.ids).any(0) for p in truth.phrases if p.kind in kinds}
        masks = {text: mask for text, mask in masks.items() if mask.sum() >= MIN_PIXELS}
        assert {label.phrase for label in frame.labels} == set(masks)
        for label in frame.labels:
            np.testing.assert_array_equal(label.truth.draw(SIZE), masks[label.phrase])
            several += layout == "lerf-ovs" and len(label.boxes) > 1
    assert several > 5 or layout == "3d-ovs"


@pytest.mark.parametrize(("layout", "protocol"), [("lerf-ovs", "langsplat-code"), ("3d-ovs", "ours")])
def test_eval_scores_the_bundled_scene_on_a_written_set(rooms, tmp_path, capsys, layout, protocol):
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
