"""Label folders and ScanNet's vertices, with what goes wrong in them."""

import json
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from plyfile import PlyData, PlyElement

from langsplat_core.errors import FormatError, InputError
from langsplat_core.extensions.benchmarks import scannet
from langsplat_core.extensions.benchmarks.labels import read_3d_ovs, read_lerf_ovs, without_suffix
from langsplat_core.extensions.benchmarks.report import Evaluated
from langsplat_core.extensions.benchmarks.scannet import NYU40, read_points, read_scannet, run_scannet
from langsplat_core.io.scenes import save_scene
from langsplat_core.query.engine import QueryEngine
from langsplat_core.scene import Scene
from tests.support.fakes import CENTRES, axis, blobs, language
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
    ("change", "message"),
    [
        (lambda c: c.pop("objects"), "objects"),
        (lambda c: c.pop("info"), "width"),
        (lambda c: c["info"].update(width="40"), "width"),
        (lambda c: c["info"].update(height=10**9), "width"),
        (lambda c: c["objects"][0].pop("category"), "category"),
        (lambda c: c["objects"][0].update(segmentation=[[1, 2], [3]]), "polygon"),
        (lambda c: c["objects"][0].update(segmentation="here"), "polygon"),
        (lambda c: c["objects"][0].update(segmentation=[[1, 2], [float("nan"), 3], [4, 4]]), "corners"),
        (lambda c: c.update(objects={}), "objects"),
        (lambda c: c.update(objects=[]), "label nothing"),
    ],
)
def test_a_broken_label_file_is_named(tmp_path, change, message):
    path = lerf_frame(tmp_path / "label" / "a", "b", [("mug", rectangle(1, 1, 4, 4))])
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))
    with pytest.raises(FormatError, match=message) as error:
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


# ScanNet's labelled vertices, and answers whose scores are known by construction.

NAME = "scene0000_00"


def write_vertices(folder, table):
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{NAME}_vh_clean_2.labels.ply"
    PlyData([PlyElement.describe(table, "vertex")]).write(str(path))
    return path


def write_labels(folder, positions, labels):
    table = np.zeros(len(labels), [("x", "f4"), ("y", "f4"), ("z", "f4"), ("red", "u1"), ("label", "u2")])
    table["x"], table["y"], table["z"] = np.transpose(positions)
    table["label"] = labels
    return write_vertices(folder, table)


@pytest.fixture
def labelled(tmp_path):
    """Ten vertices: 4 walls, 3 beds, 2 pictures, and one that nobody labelled."""
    labels = [NYU40["wall"]] * 4 + [NYU40["bed"]] * 3 + [NYU40["picture"]] * 2 + [0]
    write_labels(tmp_path / "data" / NAME, np.zeros((10, 3)), labels)
    return tmp_path


def run(tmp_path, ids, **more):
    (tmp_path / "maps").mkdir(exist_ok=True)
    np.save(tmp_path / "maps" / f"{NAME}.npy", np.asarray(ids))
    return run_scannet(read_scannet(tmp_path / "data"), Evaluated(maps=tmp_path / "maps"), None, **more)


def test_means_over_the_classes_that_are_there(labelled):
    wall, bed, picture = (NYU40[name] for name in ("wall", "bed", "picture"))
    # 3 of 4 walls right, all beds, one of which more on a wall; 1 of 2 pictures; the unlabelled one anything
    report = run(labelled, [wall, wall, wall, bed, bed, bed, bed, picture, 0, wall])
    nineteen, fifteen, ten = report.scores
    assert (nineteen.classes, nineteen.present, nineteen.points) == (19, 3, 9)
    iou, accuracy = (3 / 4 + 3 / 4 + 1 / 2) / 3, (3 / 4 + 1 + 1 / 2) / 3
    assert (nineteen.iou, nineteen.accuracy) == pytest.approx((iou, accuracy))
    for score, classes in ((fifteen, 15), (ten, 10)):  # without pictures
        assert (score.classes, score.present, score.points) == (classes, 2, 7)
        assert (score.iou, score.accuracy) == pytest.approx((3 / 4, 7 / 8))
    assert "| macro, mean of scenes | 19 |" in scannet.point_table(report)
    assert "fixed before a label was read" in scannet.point_table(report)


def test_json_and_nested_class_sets(labelled, tmp_path):
    scannet.save_point_json(tmp_path / "out.json", run(labelled, np.full(10, 1)))
    said = json.loads((tmp_path / "out.json").read_text())
    assert said["scores"][0]["accuracy"] == pytest.approx(1 / 3)
    nineteen, fifteen, ten = (set(names) for names in scannet.CLASS_SETS)
    assert [len(nineteen), len(fifteen), len(ten)] == [19, 15, 10]
    assert ten < fifteen < nineteen


def test_vertices_take_the_nearest_meaning(tmp_path):
    """The blobs are called wall, floor and bed; vertices stand near their middles."""
    known = {name: axis(3) for name in NYU40} | {"wall": axis(0), "floor": axis(1), "bed": axis(2)}
    field = replace(language(), phrasebook=known)
    field.confidence[1] = 0  # at part level all blobs are alike
    save_scene(tmp_path / f"{NAME}.ply", Scene(blobs(), field))
    positions = np.repeat(CENTRES, 2, 0) + 0.01
    names = ["wall", "wall", "floor", "floor", "bed", "sofa"]  # the last is called bed
    write_labels(tmp_path / "data", positions, [NYU40[name] for name in names])
    report = run_scannet(read_scannet(tmp_path / "data"), Evaluated(scene=tmp_path), None)
    score = report.scores[0]
    assert (score.iou, score.accuracy) == pytest.approx(((1 + 1 + 1 / 2 + 0) / 4, 3 / 4))


def test_words_that_the_encoder_lacks_are_wrong_everywhere(tmp_path):
    class Half:
        def encode_texts(self, texts):
            return np.stack([axis(3) for _ in texts])

        def unknown_words(self, text):
            return ("bathtub",) if text == "bathtub" else ()

    engine = QueryEngine(Scene(blobs(), language()), lambda _: Half())
    path = write_labels(tmp_path, CENTRES, [NYU40["bathtub"]] * 3)
    found, unknown = scannet.scene_classes(engine, read_points(path, NAME))
    assert unknown == ("bathtub",)
    assert not any((ids == NYU40["bathtub"]).any() for ids in found)


@pytest.mark.parametrize("ids", [np.zeros(9, int), np.zeros(10), np.zeros((2, 10), int)])
def test_maps_of_another_length(labelled, ids):
    with pytest.raises(FormatError, match="one per vertex"):
        run(labelled, ids)


def test_other_layouts(labelled, tmp_path):
    with pytest.raises(InputError, match="not in the layout of ScanNet"):
        read_scannet(tmp_path / "absent")
    path = write_vertices(tmp_path, np.zeros(3, [("x", "f4"), ("y", "f4"), ("z", "f4")]))
    with pytest.raises(FormatError, match="lack x, y, z or label"):
        read_points(path, NAME)
    with pytest.raises(InputError, match="--only other"):
        run(labelled, np.zeros(10, int), only=("other",))
    with pytest.raises(InputError, match="no such file"):
        run_scannet(read_scannet(labelled / "data"), Evaluated(maps=tmp_path / "nothing"), None)
