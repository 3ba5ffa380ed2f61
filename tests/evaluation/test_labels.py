"""Label folders, with what goes wrong in them."""

import json

import numpy as np
import pytest
from PIL import Image

from langsplat_core.errors import FormatError, InputError
from langsplat_core.evaluation.labels import read_3d_ovs, read_lerf_ovs, without_suffix
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
    frame = only_scene(read_lerf_ovs(lerf)).frames[1]
    mug, camera = frame.labels
    assert (frame.name, frame.size, mug.phrase, camera.phrase) == ("frame_00002", SIZE, "mug", "old camera")
    np.testing.assert_array_equal(mug.truth.draw(SIZE), block(1, 2, 5, 6) | block(20, 10, 29, 19))
    assert mug.boxes.tolist() == [[1, 2, 5, 6], [20, 10, 29, 19]]


def test_a_label_without_extent_is_named(lerf):
    assert only_scene(read_lerf_ovs(lerf)).left_out == ("frame_00002: nothing (no outline)",)


def test_dots_belong_to_names(lerf):
    assert only_scene(read_lerf_ovs(lerf)).frames[0].name == "frame.00041"
    assert without_suffix("frame.00041") == "frame.00041"
    assert without_suffix("frame.00041.JPG") == "frame.00041"


def test_masks_on_another_grid(lerf):
    mug = only_scene(read_lerf_ovs(lerf)).frames[1].labels[0]
    double = mug.truth.draw((80, 60))
    np.testing.assert_array_equal(double, np.kron(mug.truth.draw(SIZE), np.ones((2, 2), bool)))


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
    ],
)
def test_a_broken_label_file_is_named(tmp_path, change, message):
    path = lerf_frame(tmp_path / "label" / "a", "b", [("mug", rectangle(1, 1, 4, 4))])
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))
    with pytest.raises(FormatError, match=message) as error:
        read_lerf_ovs(tmp_path)
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)


def test_labels_of_nothing(tmp_path):
    lerf_frame(tmp_path / "label" / "a", "b", [("mug", [])])
    with pytest.raises(FormatError, match="label nothing"):
        read_lerf_ovs(tmp_path)


def test_3d_ovs(tmp_path):
    scene = tmp_path / "bench"
    ovs_view(scene, "00", {"red cup": block(1, 1, 8, 8), "wall": block(0, 20, 39, 29)})
    ovs_view(scene, "1.5", {"wall": block(0, 0, 3, 3)})
    found = only_scene(read_3d_ovs(tmp_path))
    assert [(f.name, f.size, [x.phrase for x in f.labels]) for f in found.frames] == [
        ("00", SIZE, ["red cup", "wall"]),
        ("1.5", SIZE, ["wall"]),
    ]
    assert found.frames[1].photograph.name == "1.5.jpg"
    np.testing.assert_array_equal(found.frames[0].labels[0].truth.draw(SIZE), block(1, 1, 8, 8))
    assert only_scene(read_3d_ovs(scene)).name == found.name == "bench"


def test_masks_of_another_size_than_the_photograph(tmp_path):
    big = np.kron(block(4, 5, 11, 20), np.ones((3, 3), bool))
    ovs_view(tmp_path / "bench", "00", {"cup": big})
    frame = only_scene(read_3d_ovs(tmp_path)).frames[0]
    assert frame.size == SIZE
    np.testing.assert_array_equal(frame.labels[0].truth.draw(SIZE), block(4, 5, 11, 20))


def test_masks_of_zeros_and_ones(tmp_path):
    ovs_view(tmp_path, "00", {"cup": block(1, 1, 2, 2)})
    Image.fromarray(block(5, 5, 6, 6).astype(np.uint8)).save(tmp_path / "segmentations" / "00" / "cup.png")
    label = only_scene(read_3d_ovs(tmp_path)).frames[0].labels[0]
    np.testing.assert_array_equal(label.truth.draw(SIZE), block(5, 5, 6, 6))


def test_a_mask_that_no_class_lists_is_left_out(tmp_path):
    ovs_view(tmp_path, "00", {"cup": block(1, 1, 2, 2)})
    Image.new("L", SIZE).save(tmp_path / "segmentations" / "00" / "cpu.png")
    assert only_scene(read_3d_ovs(tmp_path)).left_out == ("00: cpu (not in classes.txt)",)


def test_a_broken_mask_is_named(tmp_path):
    ovs_view(tmp_path, "00", {"cup": block(1, 1, 2, 2)})
    (tmp_path / "segmentations" / "00" / "cup.png").write_bytes(b"no picture")
    label = only_scene(read_3d_ovs(tmp_path)).frames[0].labels[0]
    with pytest.raises(FormatError, match=r"cup\.png"):
        label.truth.draw(SIZE)


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
