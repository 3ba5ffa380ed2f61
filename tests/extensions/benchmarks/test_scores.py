"""Scores on both benchmarks, of labels by hand and of drawn rooms, and their rules against plain loops; what
is measured of rasterizers and of queries."""

import json
from dataclasses import replace

import numpy as np
import pytest
from numpy.lib.stride_tricks import sliding_window_view
from PIL import Image

from assets.making.dataset import write_labelled
from langsplat_core.cli.app import parse
from langsplat_core.errors import FormatError, InputError
from langsplat_core.extensions.benchmarks import profiles
from langsplat_core.extensions.benchmarks.labels import (
    read_3d_ovs,
    read_gr_lerf,
    read_lerf_ovs,
    without_suffix,
)
from langsplat_core.extensions.benchmarks.raster_speed import reference_window
from langsplat_core.extensions.benchmarks.report import (
    Evaluated,
    inside_any_box,
    run_benchmark,
    save_json,
    scored_size,
    summary,
    table,
    target_table,
)
from langsplat_core.io.scenes import save_scene
from langsplat_core.progress import silent
from langsplat_core.raster.reference import ReferenceRasterizer
from langsplat_core.raster.render import render
from tests.support.fakes import PER_BLOB, WORDS, FakeEncoder, blob_scene, cameras
from tests.support.file_kinds import FileKind, few_and_many, in_json
from tests.support.photographs import SIZE, block, lerf_frame, mask_map, ovs_view, rectangle, silhouette
from tests.support.processes import refusal, run
from tests.support.scenes import random_camera, random_gaussians, random_values


@pytest.fixture
def lerf(tmp_path):
    """One scene, two frames; the first has two mugs and a label without extent."""
    labels = tmp_path / "label" / "kitchen"
    mugs = [("mug", rectangle(1, 2, 5, 6)), ("mug", rectangle(20, 10, 29, 19)), ("mug", [])]
    lerf_frame(labels, "frame_00002", [*mugs, ("old camera", rectangle(8, 8, 9, 9)), ("nothing", [])])
    lerf_frame(labels, "frame.00041", [("mug", rectangle(0, 0, 3, 3))])
    return tmp_path


def label_files(folder):
    mug = ("mug", rectangle(1, 2, 5, 6))
    return [lerf_frame(folder / "label" / "kitchen", "a", [mug, ("nothing", [])]).read_bytes()]


def drawn(path):
    for frame in only_scene(read_lerf_ovs(path.parents[2])).frames:
        for label in frame.labels:
            label.truth(frame.size)
    return 1.0


KINDS = {"labels": FileKind("label/kitchen/a.json", label_files, drawn, in_json)}
test_a_few_mutants_are_read_or_refused, test_many_mutants_are_read_or_refused = few_and_many(KINDS)


def only_scene(benchmark):
    (scene,) = benchmark.scenes.values()
    return scene


def test_polygons_of_one_category_are_joined(lerf):
    scene = only_scene(read_lerf_ovs(lerf))
    assert [frame.name for frame in scene.frames] == ["frame.00041", "frame_00002"]
    assert scene.left_out == ("frame_00002: mug (no outline)", "frame_00002: nothing (no outline)")
    mug, camera = scene.frames[1].labels
    assert (scene.frames[1].size, mug.phrase, camera.phrase) == (SIZE, "mug", "old camera")
    mask = mug.truth(SIZE)
    np.testing.assert_array_equal(mask, block(1, 2, 5, 6) | block(20, 10, 29, 19))
    assert mug.boxes.tolist() == [[1, 2, 5, 6], [20, 10, 29, 19]]
    np.testing.assert_array_equal(mug.truth((80, 60)), np.kron(mask, np.ones((2, 2), bool)))
    assert without_suffix("frame.00041") == without_suffix("frame.00041.JPG") == "frame.00041"


def test_a_polygon_of_fractions_and_one_that_leaves_the_picture(tmp_path):
    shape = [[-5.0, 3.9], [4.6, 3.2], [4.2, 99.0], [-5.0, 99.0]]
    lerf_frame(tmp_path / "label" / "a", "b", [("mug", shape)])
    mask = only_scene(read_lerf_ovs(tmp_path)).frames[0].labels[0].truth(SIZE)
    np.testing.assert_array_equal(mask, block(0, 3, 4, 29))


def test_3d_ovs(tmp_path):
    scene = tmp_path / "bench"
    ovs_view(scene, "00", {"red cup": block(1, 1, 8, 8), "wall": block(0, 20, 39, 29)})
    ovs_view(scene, "1.5", {"wall": block(0, 0, 3, 3)})
    (scene / "segmentations/1.5/wall.png").rename(scene / "segmentations/1.5/wall.JPG")
    found = only_scene(read_3d_ovs(tmp_path))
    frames = [(f.name, f.size, [x.phrase for x in f.labels]) for f in found.frames]
    assert frames == [("00", SIZE, ["red cup", "wall"]), ("1.5", SIZE, ["wall"])]
    np.testing.assert_array_equal(found.frames[0].labels[0].truth(SIZE), block(1, 1, 8, 8))
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
    np.testing.assert_array_equal(cup.truth(SIZE), block(4, 5, 11, 20))
    np.testing.assert_array_equal(jar.truth(SIZE), block(5, 5, 6, 6))
    with pytest.raises(FormatError, match=r"pot\.png"):
        pot.truth(SIZE)


# Rooms drawn in both layouts, scored as the benchmarks are.

SEED, VIEWS, DRAWN = 2, 9, (160, 120)  # the room of the bundled scene


@pytest.fixture(scope="module")
def rooms(tmp_path_factory, coarse_light):
    """The same room in both layouts."""
    out = tmp_path_factory.mktemp("rooms")
    for layout in ("lerf-ovs", "3d-ovs"):
        write_labelled(out / layout, layout, SEED, VIEWS, DRAWN, silent)
    return out


@pytest.mark.long
@pytest.mark.parametrize(("layout", "protocol"), [("lerf-ovs", "langsplat-code"), ("3d-ovs", "ours")])
def test_eval_scores_the_bundled_scene_on_a_written_set(rooms, tmp_path, capsys, layout, protocol):
    """The bundled scene shows the same room; it has never seen these views, whose cameras the dataset has."""
    out = tmp_path / "out.json"
    words = ["eval", layout, "assets/demo/scene.ply", str(rooms / layout), "--protocol", protocol]
    parse([*words, "--json", str(out)]).run()
    content = json.loads(out.read_text())
    micro = content["means"]["micro, mean of queries"]
    assert micro["queries"] == len(content["queries"]) > 20
    assert micro["iou"] > 0.4
    assert "macro, mean of frames" in capsys.readouterr().out


# The protocols' rules against plain loops.

CODE_RULE = profiles.LERF_PROFILES["langsplat-code"].rule
PLAIN_RULE = profiles.MapRule(window=1, raw_share=1, border="mirror", level="peak", min_max=True, vote="none",
                              threshold=0.7, vote_window=1, peak_window=1, ties=False)  # fmt: skip


def plain_mean(values: np.ndarray, window: int, inside: bool) -> np.ndarray:
    """Every window by itself; NumPy's "reflect" is cv2's reflect101: d c b | a b c d | c b a."""
    sides = window // 2, window - window // 2 - 1
    options = {"constant_values": np.nan} if inside else {"mode": "reflect"}
    padded = np.pad(values, sides, **options)
    return np.nanmean(sliding_window_view(padded, (window, window)), axis=(2, 3))


@pytest.mark.parametrize("window", [2, 5, 6])
@pytest.mark.parametrize("border", ["mirror", "inside"])
def test_mean_filter(window, border):
    values = np.random.default_rng(window).uniform(size=(11, 9))
    expected = plain_mean(values, window, border == "inside")
    np.testing.assert_allclose(profiles.mean_filtered(values, window, border), expected, atol=1e-12)


def looped_vote(mask: np.ndarray, clipped: bool) -> np.ndarray:
    """LangSplat's loop slices up to the last row and column, which it never counts; V2 counts all."""
    counted = mask[:-1, :-1] if clipped else mask
    out = np.zeros(mask.shape, bool)
    for y, x in np.ndindex(mask.shape):
        seen = counted[max(0, y - 3) : y + 4, max(0, x - 3) : x + 4]
        out[y, x] = 2 * seen.sum() > seen.size
    return out


def test_ties_and_flat_maps():
    mask = np.zeros((8, 8), bool)
    mask[:, :4] = True
    assert not profiles.voted(mask, "inside", 40).any()  # the window is the whole picture: 32 of 64
    mask[0, 4] = True
    assert profiles.voted(mask, "inside", 40).all()
    flat = np.zeros((1, 2, 3))
    flat[0, 0, 1] = flat[0, 1, 2] = 0.5
    assert profiles.peak_pixels(flat, replace(PLAIN_RULE, ties=True)).tolist() == [[1, 0], [2, 1]]
    assert profiles.peak_pixels(flat, PLAIN_RULE).tolist() == [[1, 0]]
    assert not profiles.read_maps(np.full((3, 40, 40), 0.55), CODE_RULE).mask.any()


def test_the_code_cuts_the_blend_at_seven_tenths_of_its_range():
    maps = np.random.default_rng(1).uniform(0.4, 0.6, size=(3, 40, 50))
    maps[1, 10:30, 10:30] += 0.3
    answer = profiles.read_maps(maps, CODE_RULE)
    blend = 0.5 * (plain_mean(maps[1], 30, False) + maps[1])
    cut = blend.min() + 0.7 * (blend.max() - blend.min())
    assert answer.level == 1
    np.testing.assert_array_equal(answer.mask, looped_vote(blend > cut, True))
    column, row = answer.peaks[0]
    smooth = plain_mean(maps[1], 30, False)
    assert smooth[row, column] == pytest.approx(smooth.max(), abs=1e-12)


def test_3d_ovs_takes_the_level_that_is_highest_inside_its_mask():
    rule = profiles.OVS_PROFILES["langsplat-paper"].rule
    maps = np.full((3, 5, 5), 0.1)
    maps[0, :2], maps[1, 3:, 3:], maps[2] = 0.5, 0.9, 0.4  # 0.4 itself is not above 0.4
    maps[0, 4, 4] = 0.95  # the highest pixel, but 0.54 on average
    answer = profiles.read_maps(maps, rule)
    assert (answer.level, answer.mask.sum()) == (1, 4)
    assert not profiles.read_maps(np.full((3, 5, 5), 0.4), rule).mask.any()


# Whole benchmarks on labels and answers whose scores are known by construction.

DIRECT = profiles.LERF_PROFILES["direct-3d"]
CODE = profiles.LERF_PROFILES["langsplat-code"]
PLAIN = replace(CODE, rule=replace(CODE.rule, window=1, vote="none", peak_window=1))


def no_encoder(name):
    raise AssertionError("maps need no encoder")


def of_maps(data, maps, profile=DIRECT, **more):
    return run_benchmark(read_lerf_ovs(data), profile, Evaluated(maps=maps), no_encoder, **more)


@pytest.fixture
def two_scenes(tmp_path):
    """Scene a: 2 frames, of 1 and 2 queries; scene b: 1 frame of 1 query. Silhouettes of known overlap."""
    data, maps = tmp_path / "data", tmp_path / "maps"
    whole, half = rectangle(0, 0, 9, 9), block(0, 0, 9, 4)
    lerf_frame(data / "label" / "a", "one.1", [("mug", whole)])
    lerf_frame(data / "label" / "a", "two", [("mug", whole), ("red/blue cup", whole)])
    lerf_frame(data / "label" / "b", "one.1", [("mug", whole)])
    silhouette(maps / "a" / "one.1", "mug", block(0, 0, 9, 9))  # 1
    silhouette(maps / "a" / "two", "mug", half)  # 1/2
    silhouette(maps / "a" / "two", "red_blue cup", block(0, 0, 9, 2))  # 3/10
    silhouette(maps / "b" / "one.1", "mug", np.zeros((30, 40), bool))  # an empty answer: 0
    return data, maps


def test_macro_and_micro_means_and_all_figures_as_json(two_scenes, tmp_path):
    report = of_maps(*two_scenes)
    rows = summary(report)
    a, b, micro = (1 + 0.5 + 0.3) / 3, 0.0, rows["micro, mean of queries"]
    assert rows["a"].iou == pytest.approx(a)
    assert rows["macro, mean of scenes"].iou == pytest.approx((a + b) / 2)
    assert rows["macro, mean of frames"].iou == pytest.approx((1 + 0.4 + 0) / 3)
    assert (micro.iou, micro.queries) == (pytest.approx(1.8 / 4), 4)
    assert (micro.accuracy_25, micro.accuracy_50) == (3 / 4, 1 / 4)  # one half is not above one half
    assert micro.localisation is None  # direct-3d names no place
    assert "fixed before a label was read" in table(report)
    save_json(tmp_path / "out.json", report)
    content = json.loads((tmp_path / "out.json").read_text())
    assert content["protocol"]["rule"] == {"alpha": 0.7, "grey": 10}
    assert [query["iou"] for query in content["queries"]] == pytest.approx([1, 0.5, 0.3, 0])


def test_phrases_for_none_one_and_several_things_are_scored(tmp_path):
    """GR-LERF: polygons and mask files; things that share a sentence are its targets."""
    data, maps = tmp_path / "gr", tmp_path / "maps"
    mask_file = data / "a" / "mask" / "one" / "cup.png"
    silhouette(mask_file.parent, "cup", block(0, 0, 9, 9))
    things = [
        {"category": "cup", "sentence": ["the cup", "all of it"], "segmentation": "one/cup.png"},
        {"category": "box", "sentence": ["all of it"], "segmentation": rectangle(20, 0, 29, 9)},
        {"category": "dog", "sentence": ["a dog", "a cat"]},
    ]
    label = data / "a" / "json" / "test_json" / "one.json"
    label.parent.mkdir(parents=True)
    label.write_text(json.dumps({"info": {"width": 40, "height": 30}, "object": things}))
    answers = {"the cup": (0, 0, 9, 9), "all of it": (0, 0, 9, 9), "a cat": (0, 0, 1, 1)}
    for phrase, sides in answers.items():
        silhouette(maps / "one", phrase, block(*sides))
    silhouette(maps / "one", "a dog", np.zeros((30, 40), bool))
    report = run_benchmark(read_gr_lerf(data), DIRECT, Evaluated(maps=maps), no_encoder)
    scores = {one.phrase: (one.targets, one.iou, one.is_empty) for one in report.queries}
    assert scores["the cup"] == (1, 1.0, False)
    assert scores["all of it"] == (2, 0.5, False)
    assert (scores["a dog"], scores["a cat"]) == ((0, 1.0, True), (0, 0.0, False))
    (said,) = target_table(report.queries)
    lines = [[cell.strip() for cell in line.strip("| ").split("|")] for line in said.splitlines()[2:]]
    assert lines[0] == ["none", "2", "50.0", "50.0"]
    assert lines[-1] == ["all", "4", "62.5", "75.0"]
    assert said in table(report)
    assert not target_table([replace(one, targets=None) for one in report.queries])
    for wrong in ("../one/cup.png", "/etc/passwd", "absent.png"):
        label.write_text(json.dumps({"object": [things[0] | {"segmentation": wrong}], "info": None}))
        with pytest.raises(FormatError):
            read_gr_lerf(data)
    with pytest.raises(InputError, match="GR-LERF"):
        read_gr_lerf(tmp_path / "nowhere")


def test_a_missing_map_counts_as_wrong_and_is_named(two_scenes):
    data, maps = two_scenes
    (maps / "a" / "one.1" / "mug.png").unlink()
    report = of_maps(data, maps)
    rows = summary(report)
    assert rows["micro, mean of queries"].iou == pytest.approx(0.8 / 4)
    assert rows["micro, answered ones alone"].iou == pytest.approx(0.8 / 3)
    assert "not answered (no map), 1 queries: one.1: mug" in table(report)
    assert "IoU 0" in table(report)


def test_an_empty_label_is_left_out_not_scored(tmp_path):
    ovs_view(tmp_path / "s", "00", {"cup": block(0, 0, 9, 9), "wall": np.zeros((30, 40), bool)})
    silhouette(tmp_path / "maps" / "00", "cup", block(0, 0, 9, 9))
    silhouette(tmp_path / "maps" / "00", "wall", np.zeros((30, 40), bool))
    maps = Evaluated(maps=tmp_path / "maps")
    report = run_benchmark(read_3d_ovs(tmp_path / "s"), profiles.OVS_PROFILES["direct-3d"], maps, no_encoder)
    assert [query.phrase for query in report.queries] == ["cup"]
    assert "1 labels left out: 00: wall (empty mask)" in table(report)


def test_maps_are_scored_on_their_own_grid(tmp_path):
    """Of twice the labels' size: the same figures; and of another shape: refused."""
    lerf_frame(tmp_path / "label" / "a", "one", [("mug", rectangle(0, 0, 9, 9))])
    mask_map(tmp_path / "maps" / "one", "mug", np.kron(block(0, 0, 9, 4), np.ones((2, 2))))
    (query,) = of_maps(tmp_path, tmp_path / "maps", PLAIN).queries
    assert (query.grid, query.iou, query.hit) == ((80, 60), pytest.approx(0.5), True)
    mask_map(tmp_path / "maps" / "one", "mug", block(0, 0, 9, 4, (40, 40)))
    with pytest.raises(InputError, match="40x40, the labels are 40x30"):
        of_maps(tmp_path, tmp_path / "maps", PLAIN)


@pytest.mark.parametrize("kind", ["8 bit", "16 bit", "levels"])
def test_kinds_of_maps(tmp_path, kind):
    lerf_frame(tmp_path / "label" / "a", "one", [("mug", rectangle(0, 0, 9, 9))])
    part, whole = 0.4 * block(20, 20, 30, 29), 0.8 * block(0, 0, 9, 9)
    if kind == "levels":
        mask_map(tmp_path / "maps" / "one", "mug", np.stack([0 * part, part, whole]))
    else:
        top, dtype = (65535, np.uint16) if kind == "16 bit" else (255, np.uint8)
        (tmp_path / "maps" / "one").mkdir(parents=True)
        Image.fromarray(np.rint(top * whole).astype(dtype)).save(tmp_path / "maps" / "one" / "mug.png")
    (query,) = of_maps(tmp_path, tmp_path / "maps", PLAIN).queries
    assert (query.level, query.iou, query.hit) == ("whole" if kind == "levels" else "subpart", 1.0, True)


def test_maps_that_do_not_fit(two_scenes, tmp_path):
    data, maps = two_scenes
    broken = {"not finite": np.full((30, 40), np.nan), "at most 3 levels": np.zeros((4, 30, 40))}
    for message, array in broken.items():
        np.save(maps / "b" / "one.1" / "mug.npy", array)
        with pytest.raises(InputError, match=message):
            of_maps(data / "label" / "b", maps, CODE)


def test_boxes_have_their_borders_inside():
    boxes = np.array([[10.0, 10, 20, 20], [30, 5, 25, 0]])  # the second with its corners exchanged
    peaks = np.array([[20, 20], [21, 20], [25, 5], [24, 5]])
    hits = [inside_any_box(peak[None], boxes, SIZE, (40, 30)) for peak in peaks]
    assert hits == [True, False, True, False]
    assert inside_any_box(peaks, boxes, SIZE, (40, 30))
    assert inside_any_box(np.array([[40, 40]]), boxes, SIZE, (80, 60))
    assert not inside_any_box(np.empty((0, 2), int), boxes, SIZE, (40, 30))
    assert scored_size((4032, 3024), 1080) == (1440, 1080)  # a grid with too many rows is shrunk
    assert scored_size((988, 731), 1080) == (988, 731)


# A scene of ours: three blobs, and labels that are drawn from its own views.


def seen(index: int, camera) -> np.ndarray:
    """Return (H, W) where a blob is what one mostly sees."""
    scene = blob_scene()
    member = np.zeros((3 * PER_BLOB, 1), np.float32)
    member[index * PER_BLOB : (index + 1) * PER_BLOB] = 1
    drawn = render(scene, camera, member)
    return (drawn.alpha > 0.3) & (drawn.values[..., 0] > 0.5 * drawn.alpha)


@pytest.fixture
def blobs_on_disk(tmp_path):
    """The scene with two of the three views; 3D-OVS labels of the last of them alone."""
    views = [replace(camera, name=f"photo.{index}.x") for index, camera in enumerate(cameras())]
    save_scene(tmp_path / "blobs.ply", replace(blob_scene(), cameras=tuple(views[:2])))
    masks = {word: seen(index, views[1]) for index, word in enumerate(WORDS)}
    ovs_view(tmp_path / "data", "photo.1.x", masks, (160, 120))
    return tmp_path, views


def of_scene(tmp_path, profile):
    subject = Evaluated(scene=tmp_path / "blobs.ply")
    return run_benchmark(read_3d_ovs(tmp_path / "data"), profile, subject, lambda _: FakeEncoder())


def of_phrase(report, phrase):
    return next(query for query in report.queries if query.phrase == phrase)


def test_our_own_answer_in_views_that_are_matched_by_name(blobs_on_disk):
    """The only label is of the second view; the first has other masks."""
    tmp_path, views = blobs_on_disk
    report = of_scene(tmp_path, profiles.OVS_PROFILES["ours"])
    assert {query.phrase for query in report.queries} == set(WORDS)
    assert min(of_phrase(report, word).iou for word in ("mug", "book")) > 0.95
    first, second = seen(0, views[0]), seen(0, views[1])
    assert (first & second).sum() / (first | second).sum() < 0.8
    assert "1 of 1 labelled frames were trained on: photo.1.x" in table(report)


def test_the_papers_absolute_cut(blobs_on_disk):
    """What is as far from the phrase as from the canonical ones has relevancy 0.5, which is above 0.4."""
    tmp_path, views = blobs_on_disk
    mug = of_phrase(of_scene(tmp_path, profiles.OVS_PROFILES["langsplat-paper"]), "mug")
    covered = render(blob_scene(), views[1]).alpha > 0.3
    assert mug.iou == pytest.approx((seen(0, views[1]) & covered).sum() / covered.sum())


def test_direct_3d_draws_the_members_alone(blobs_on_disk):
    tmp_path, views = blobs_on_disk
    book = of_phrase(of_scene(tmp_path, profiles.OVS_PROFILES["direct-3d"]), "book")
    alone = render(blob_scene().take(np.arange(PER_BLOB, 2 * PER_BLOB)), views[1]).alpha > 0.7
    truth = seen(1, views[1])
    assert book.iou == pytest.approx((alone & truth).sum() / (alone | truth).sum())
    assert book.hit is None


def test_a_view_that_is_missing_and_words_that_are_unknown(blobs_on_disk, caplog):
    tmp_path, _ = blobs_on_disk
    ovs_view(tmp_path / "data", "photo.2.x", {"mug": block(0, 0, 9, 9, (160, 120))}, (160, 120))
    ovs_view(tmp_path / "data", "photo.1.x", {"zebra": block(0, 0, 9, 9, (160, 120))}, (160, 120))
    report = of_scene(tmp_path, profiles.OVS_PROFILES["ours"])
    assert "1 labelled frames have no camera: photo.2.x" in caplog.text
    text = table(report)
    assert "not answered (no camera of that name), 1 queries: photo.2.x: mug" in text
    assert "not answered (the encoder does not know 'zebra'), 1 queries: photo.1.x: zebra" in text
    rows = summary(report)
    assert [rows[f"micro, {of}"].queries for of in ("mean of queries", "answered ones alone")] == [5, 3]


def test_scenes_and_labels_that_do_not_fit(blobs_on_disk):
    tmp_path, _ = blobs_on_disk

    def refused(match: str, data) -> None:
        one = Evaluated(scene=tmp_path / "blobs.ply")
        with pytest.raises(InputError, match=match):
            run_benchmark(read_3d_ovs(data), profiles.OVS_PROFILES["ours"], one, lambda _: FakeEncoder())

    ovs_view(tmp_path / "other", "00", {"mug": block(0, 0, 9, 9)})
    refused("none of the scene's views", tmp_path / "other")
    refused("could be any labelled scene of data, other", tmp_path)
    ovs_view(tmp_path / "data", "photo.0.x", {"mug": block(0, 0, 9, 9, (160, 160))}, (160, 160))
    refused("the view is 160x120, the labels are 160x160", tmp_path / "data")


# `langsplat eval lerf-ovs`, and what its arguments lack.


@pytest.fixture
def data(tmp_path):
    lerf_frame(tmp_path / "data" / "label" / "a", "one", [("mug", rectangle(5, 5, 34, 24))])
    mask_map(tmp_path / "maps" / "one", "mug", block(5, 5, 34, 24))
    return tmp_path


@pytest.mark.parametrize("protocol", ["langsplat-code", "langsplat-paper", "langsplat-v2"])
def test_maps_of_another_system(data, capsys, protocol):
    out = data / "out.json"
    words = ("lerf-ovs", data / "data", "--maps", data / "maps", "--protocol", protocol, "--json", out)
    assert run("eval", *words) == 0
    (query,) = json.loads(out.read_text())["queries"]
    assert (query["hit"], query["level"], query["grid"]) == (True, "subpart", [40, 30])
    assert f"protocol {protocol}:" in capsys.readouterr().out
    assert "give a scene and the benchmark's folder" in refusal(capsys, "eval", "lerf-ovs", data / "data")


# The rasterizer benchmark, its reference window and files; the query benchmark. No test looks at a time.


def test_window_is_the_whole_reference_and_tells_errors_from_flips():
    """Pixels off the window are not looked at; those in it are equal up to the order of sums."""
    gaussians, camera = random_gaussians(400, 7), random_camera(8, 150, 110)
    exact, x = reference_window(gaussians, camera), random_values(400, 3)
    whole = ReferenceRasterizer().view(gaussians, camera)
    image = whole.splat(x)[0]
    band = whole.cut_off_band(1e-3)  # as wide as the benchmark's
    assert exact.band.any()
    assert np.array_equal(exact.band, band[exact.at])
    assert exact.splat_error(image, x).largest < 1e-12
    y = np.random.default_rng(0).normal(size=image.shape).astype(np.float32)
    assert exact.gather_error(whole.gather, y).off_cuts < 1e-11  # sums of thousands
    image[exact.at][exact.band] += 0.25
    error = exact.splat_error(image, x)
    assert error.largest == pytest.approx(0.25)
    assert error.off_cuts < 1e-12
    assert error.flips == exact.band.sum()
    image[exact.at][~exact.band] += 0.125
    assert exact.splat_error(image, x).off_cuts == pytest.approx(0.125)


@pytest.mark.long
def test_a_tiny_run_writes_two_sane_files(tmp_path):
    sizes = ["--counts", "60", "120", "--size", "40", "30", "--channels", "3"]
    parse(["bench", "raster", *sizes, "--out", str(tmp_path)]).run()
    rows = json.loads((tmp_path / "raster.json").read_text())["measurements"]
    assert {(r["gaussians"], r["width"]) for r in rows} == {(60, 40), (120, 40)}
    cpu = {r["operation"] for r in rows if r["backend"] == "cpu"}
    assert {"project", "frame", "splat", "gather", "backward"} <= cpu
    assert all(r["milliseconds"] > 0 for r in rows)
    exact = [r for r in rows if r["backend"] == "cpu"]
    # float32 blending of values in [0, 1].
    assert all(r["error"]["off_cuts"] < 2e-5 for r in exact if r["error"] is not None)
    assert all(r["error"] is not None for r in exact if r["operation"] == "backward")
    assert "# Rasterizers" in (tmp_path / "raster.md").read_text()
