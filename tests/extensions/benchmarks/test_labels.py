"""Labels of both benchmarks: folders by hand with what goes wrong in them, and rooms drawn in the layouts."""

import json

import numpy as np
import pytest
from PIL import Image
from scipy.ndimage import gaussian_filter

from assets.making import dataset
from assets.making.dataset import MIN_PIXELS, outlines, read_truth, write_labelled
from langsplat_core.cli.app import parse
from langsplat_core.errors import FormatError, InputError
from langsplat_core.extensions.benchmarks.labels import (
    Outlines,
    read_3d_ovs,
    read_lerf_ovs,
    without_suffix,
)
from langsplat_core.progress import silent
from tests.support.photographs import SIZE, block, lerf_frame, ovs_view, rectangle


@pytest.fixture
def lerf(tmp_path):
    """One scene, two frames; the first has two mugs and a label without extent."""
    labels = tmp_path / "label" / "kitchen"
    mugs = [("mug", rectangle(1, 2, 5, 6)), ("mug", rectangle(20, 10, 29, 19))]
    lerf_frame(labels, "frame_00002", [*mugs, ("old camera", rectangle(8, 8, 9, 9)), ("nothing", [])])
    lerf_frame(labels, "frame.00041", [("mug", rectangle(0, 0, 3, 3))])
    return tmp_path


def only_scene(benchmark):
    (scene,) = benchmark.scenes.values()
    return scene


def test_polygons_of_one_category_are_joined(lerf):
    scene = only_scene(read_lerf_ovs(lerf))
    assert [frame.name for frame in scene.frames] == ["frame.00041", "frame_00002"]
    assert scene.left_out == ("frame_00002: nothing (no outline)",)
    mug, camera = scene.frames[1].labels
    assert (scene.frames[1].size, mug.phrase, camera.phrase) == (SIZE, "mug", "old camera")
    mask = mug.truth.draw(SIZE)
    np.testing.assert_array_equal(mask, block(1, 2, 5, 6) | block(20, 10, 29, 19))
    assert mug.boxes.tolist() == [[1, 2, 5, 6], [20, 10, 29, 19]]
    np.testing.assert_array_equal(mug.truth.draw((80, 60)), np.kron(mask, np.ones((2, 2), bool)))
    assert without_suffix("frame.00041") == without_suffix("frame.00041.JPG") == "frame.00041"


def test_every_folder_of_the_benchmark_will_do(lerf):
    (lerf / "kitchen" / "images").mkdir(parents=True)
    found = [only_scene(read_lerf_ovs(lerf / part)) for part in ("", "label/kitchen", "kitchen")]
    assert {scene.dataset.resolve() for scene in found} == {(lerf / "kitchen").resolve()}
    assert {len(scene.frames) for scene in found} == {2}


def test_a_polygon_of_fractions_and_one_that_leaves_the_picture(tmp_path):
    shape = [[-5.0, 3.9], [4.6, 3.2], [4.2, 99.0], [-5.0, 99.0]]
    lerf_frame(tmp_path / "label" / "a", "b", [("mug", shape)])
    mask = only_scene(read_lerf_ovs(tmp_path)).frames[0].labels[0].truth.draw(SIZE)
    np.testing.assert_array_equal(mask, block(0, 3, 4, 29))


@pytest.mark.parametrize(
    "change",
    [
        lambda c: c.pop("objects"),
        lambda c: c.pop("info"),
        lambda c: c["info"].update(width="40"),
        lambda c: c["info"].update(height=10**9),
        lambda c: c["objects"][0].update(category=" "),
        lambda c: c["objects"][0].update(segmentation=[[1, 2], [3]]),
        lambda c: c["objects"][0].update(segmentation=[[1, 2], [float("nan"), 3], [4, 4]]),
        lambda c: c.update(objects=[]),
    ],
)
def test_a_broken_label_file_is_named(tmp_path, change):
    path = lerf_frame(tmp_path / "label" / "a", "b", [("mug", rectangle(1, 1, 4, 4))])
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))
    with pytest.raises(FormatError) as error:
        read_lerf_ovs(tmp_path)
    assert str(path.parent) in str(error.value)


def test_3d_ovs(tmp_path):
    scene = tmp_path / "bench"
    ovs_view(scene, "00", {"red cup": block(1, 1, 8, 8), "wall": block(0, 20, 39, 29)})
    ovs_view(scene, "1.5", {"wall": block(0, 0, 3, 3)})
    found = only_scene(read_3d_ovs(tmp_path))
    frames = [(f.name, f.size, [x.phrase for x in f.labels]) for f in found.frames]
    assert frames == [("00", SIZE, ["red cup", "wall"]), ("1.5", SIZE, ["wall"])]
    assert found.frames[1].photograph.name == "1.5.jpg"
    np.testing.assert_array_equal(found.frames[0].labels[0].truth.draw(SIZE), block(1, 1, 8, 8))
    assert only_scene(read_3d_ovs(scene)).name == found.name == "bench"


def test_masks_of_another_size_of_zeros_and_ones_unlisted_and_broken(tmp_path):
    big = np.kron(block(4, 5, 11, 20), np.ones((3, 3), bool))
    ovs_view(tmp_path, "00", {"cup": big, "jar": big, "pot": big})
    folder = tmp_path / "segmentations" / "00"
    Image.fromarray(block(5, 5, 6, 6).astype(np.uint8)).save(folder / "jar.png")
    Image.new("L", SIZE).save(folder / "cpu.png")
    (folder / "pot.png").write_bytes(b"no picture")
    scene = only_scene(read_3d_ovs(tmp_path))
    assert scene.left_out == ("00: cpu (not in classes.txt)",)
    cup, jar, pot = scene.frames[0].labels
    assert scene.frames[0].size == SIZE  # the photograph's
    np.testing.assert_array_equal(cup.truth.draw(SIZE), block(4, 5, 11, 20))
    np.testing.assert_array_equal(jar.truth.draw(SIZE), block(5, 5, 6, 6))
    with pytest.raises(FormatError, match=r"pot\.png"):
        pot.truth.draw(SIZE)


@pytest.mark.parametrize("content", [b"", b"\n  \n", b"\xff\xfe\x00"])
def test_classes_must_be_listed(tmp_path, content):
    ovs_view(tmp_path, "00", {"cup": block(1, 1, 2, 2)})
    (tmp_path / "segmentations" / "classes.txt").write_bytes(content)
    with pytest.raises(FormatError, match=r"classes\.txt"):
        read_3d_ovs(tmp_path)


def test_the_other_layout_is_recognised(lerf, tmp_path_factory):
    other = tmp_path_factory.mktemp("other")
    ovs_view(other, "00", {"cup": block(1, 1, 2, 2)})
    with pytest.raises(InputError, match="use `langsplat eval 3d-ovs`"):
        read_lerf_ovs(other)
    with pytest.raises(InputError, match="use `langsplat eval lerf-ovs`"):
        read_3d_ovs(lerf)


@pytest.mark.parametrize("read", [read_lerf_ovs, read_3d_ovs])
def test_no_layout_at_all(read, tmp_path):
    with pytest.raises(InputError, match="no such folder"):
        read(tmp_path / "absent")
    (tmp_path / "transforms.json").write_text("{}")
    with pytest.raises(InputError, match="not in the layout"):
        read(tmp_path)


# Rooms drawn in both layouts, read and scored as the benchmarks are.

SEED, VIEWS, DRAWN = 2, 9, (160, 120)  # the room of the bundled scene


@pytest.mark.long
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
            write_labelled(out / layout, layout, SEED, VIEWS, DRAWN, silent)
    return out


@pytest.mark.long
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
            np.testing.assert_array_equal(label.truth.draw(DRAWN), masks[label.phrase])
            several += layout == "lerf-ovs" and len(label.boxes) > 1
    assert several > 5 or layout == "3d-ovs"


@pytest.mark.long
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
