"""Structure from motion and triangulation, in a textured room and in a street, and EXIF focal lengths."""

import logging
import shutil
from contextlib import suppress
from dataclasses import replace
from datetime import datetime
from functools import cache
from itertools import groupby
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from PIL import Image
from scipy.ndimage import gaussian_filter, map_coordinates

from langsplat_core.arrays import Array
from langsplat_core.config import DatasetConfig
from langsplat_core.datasets import load_capture, reconstruction, sfm
from langsplat_core.datasets.capture import Capture
from langsplat_core.datasets.intrinsics import BrownDistortion, PhotoIntrinsics
from langsplat_core.datasets.photos import ExifFacts, find_photos
from langsplat_core.datasets.sfm import add_points, neighbouring_pairs, pairs_to_match
from langsplat_core.datasets.workspace import ROOM, Matches, read_matches
from langsplat_core.errors import InputError
from langsplat_core.progress import Progress, Report, WorkCancelledError, silent
from langsplat_core.scene import Camera, look_at
from tests.support.photographs import (
    distance_to_room,
    mask_file,
    photograph,
    poses,
    write_model,
    write_photos,
)
from tests.support.processes import files_of_at_most, in_this_process, small_disk, stop_at

# A walk straight ahead between two walls: what structure from motion finds hardest to begin with.

LENGTH, HALF_WIDTH, HEIGHT = 40.0, 3.0, 4.0  # world units; one walks along y at x = 0 and looks along it
TEXELS = 24  # per unit
SIZE, FOCAL = (480, 320), 420.0
EYE = 1.6  # above the ground


@cache
def _texture(seed: int, across: float) -> Array:
    """(texels along, texels across) in [0, 255], of the length of the street; nothing repeats."""
    noise = np.random.default_rng(seed).normal(size=(int(LENGTH * TEXELS) + 2, int(across * TEXELS) + 2))
    layers = [gaussian_filter(noise, sigma) for sigma in (1.5, 4, 12)]
    return np.clip(128 + sum(40 * layer / layer.std() for layer in layers), 0, 255)


def walk(folder: Path, count: int, step: float = 0.8) -> list[str]:
    """PNG files in `folder`, taken every `step` units; returns their names."""
    folder.mkdir(parents=True, exist_ok=True)
    names = [f"step_{index:02d}.png" for index in range(count)]
    for index, name in enumerate(names):
        Image.fromarray(_seen_from(3 + step * index)).reduce(2).save(folder / name)
    return names


def _seen_from(y: float) -> Array:
    """Return (2 H, 2 W) uint8."""
    width, height, focal = 2 * SIZE[0], 2 * SIZE[1], 2 * FOCAL
    v, u = np.mgrid[:height, :width] + 0.5
    right, up = (u - width / 2) / focal, (height / 2 - v) / focal - 0.03  # a little downward
    picture = np.full((height, width), 200.0)
    with np.errstate(divide="ignore"):
        depths = np.stack([-EYE / up, -HALF_WIDTH / right, HALF_WIDTH / right])
    depths[~(depths > 0)] = np.inf
    nearest, depth = depths.argmin(0), depths.min(0)
    across = [right * depth + HALF_WIDTH, EYE + up * depth, EYE + up * depth]
    for number, extent in enumerate((2 * HALF_WIDTH, HEIGHT, HEIGHT)):
        seen = (nearest == number) & (depth + y < LENGTH) & (across[number] < extent)
        place = TEXELS * np.stack([depth[seen] + y, across[number][seen]])
        picture[seen] = map_coordinates(_texture(number, extent), place, order=1, mode="nearest")
    return picture.astype(np.uint8)


# Structure from motion and triangulation, on a small textured room whose shape is known.

pytestmark = pytest.mark.long

VIEWS = 6
LENS = PhotoIntrinsics(400, 300, 380.0, 380.0, 200.0, 150.0, BrownDistortion(-0.06))
CONFIG = DatasetConfig(max_side=400)


@pytest.fixture(scope="module")
def photos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six photographs of the room, one of pure noise, one broken file and one that is no photograph."""
    folder = tmp_path_factory.mktemp("dataset") / "images"
    write_photos(folder, LENS, poses(VIEWS))
    noise = np.random.default_rng(0).integers(0, 256, (300, 400, 3), dtype=np.uint8)
    Image.fromarray(noise).save(folder / "zz_noise.JPG")
    (folder / "aa_broken.jpg").write_bytes(b"\xff\xd8\xff not a picture")
    (folder / "notes.txt").write_text("not a photograph")
    return folder.parent


@pytest.fixture(scope="module")
def located(photos: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Capture, Path, list[str]]:
    """The capture, work folder and warnings of a run that was cancelled after features, and repeated."""
    work = tmp_path_factory.mktemp("work")

    def stop(at: Report) -> None:
        if at.stage == "matching photographs" and any(work.glob(f"*/{sfm.TRIED}")):
            raise WorkCancelledError

    with pytest.raises(WorkCancelledError):
        load_capture(photos, CONFIG, work, Progress(stop))

    messages: list[str] = []
    handler = logging.Handler(logging.WARNING)
    handler.emit = lambda record: messages.append(record.getMessage())  # type: ignore[method-assign]
    logging.getLogger("langsplat").addHandler(handler)
    with pytest.MonkeyPatch.context() as patch:
        in_this_process(patch)
        patch.setattr(pycolmap, "extract_features", _never)
        capture = load_capture(photos, CONFIG, work)
    logging.getLogger("langsplat").removeHandler(handler)
    return capture, work, messages


def _never(**_: object) -> None:
    raise AssertionError("computed again")


def test_repeated_reconstruction_computes_nothing(photos, located, monkeypatch, caplog):
    in_this_process(monkeypatch)
    for name in ("extract_features", "incremental_mapping"):
        monkeypatch.setattr(pycolmap, name, _never)
    again = load_capture(photos, CONFIG, located[1])
    np.testing.assert_array_equal(again.points, located[0].points)
    assert any("1 of " in said and "cannot be read: aa_broken.jpg" in said for said in caplog.messages)


def test_small_images_do_where_they_locate_every_photograph(photos, tmp_path):
    shutil.copytree(photos, tmp_path / "dataset", ignore=shutil.ignore_patterns("zz_*"))
    stages = list[str]()
    load_capture(tmp_path / "dataset", CONFIG, tmp_path, Progress(lambda at: stages.append(at.stage)))
    assert [key for key, _ in groupby(stages)].count("matching photographs") == 1


def aligned(points: Array, source: Array, target: Array) -> Array:
    """`points` moved by the similarity that best takes `source` (N, 3) to `target` (Umeyama 1991)."""
    a, b = source - source.mean(0), target - target.mean(0)
    left, stretch, right = np.linalg.svd(b.T @ a)
    sign = np.diag([1, 1, np.sign(np.linalg.det(left @ right))])
    rotation = left @ sign @ right
    scale = (stretch * np.diag(sign)).sum() / (a**2).sum()
    return scale * (points - source.mean(0)) @ rotation.T + target.mean(0)


def test_cameras_are_found_where_they_were(located) -> None:  # type: ignore[no-untyped-def]
    """On every processor; that they are the same bytes is promised within one machine only."""
    capture, _, messages = located
    assert [camera.name for camera in capture.cameras] == [f"view_{i}" for i in range(VIEWS)]
    centres = np.array([camera.position for camera in capture.cameras])
    truth = np.array([-m[:3, :3].T @ m[:3, 3] for m in poses(VIEWS)])
    assert np.abs(aligned(centres, centres, truth) - truth).max() < 0.02  # of a room 4 units wide
    room = aligned(capture.points, centres, truth)
    assert len(room) > 300
    assert np.median(distance_to_room(room)) < 0.01
    (broken,) = [message for message in messages if "aa_broken.jpg" in message]
    assert "cannot be read" in broken
    (lost,) = [message for message in messages if "could not be located" in message]
    assert "no matches with any other: zz_noise.JPG" in lost


def known(count: int = VIEWS, size: tuple[int, int] = (320, 240)) -> Capture:
    """The room through pinholes at the true poses, without points."""
    lens = PhotoIntrinsics(*size, 300.0, 300.0, size[0] / 2, size[1] / 2)
    cameras = [Camera(*size, 300, 300, lens.cx, lens.cy, m, f"v{i}") for i, m in enumerate(poses(count))]
    images = [photograph(lens, camera.world_to_camera) for camera in cameras]
    return Capture(tuple(cameras), tuple(images), np.zeros((0, 3)), np.zeros((0, 3), np.uint8))


def test_known_poses_give_points_in_their_own_world(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    capture = known(4)
    found = add_points(capture, range(4), tmp_path, silent)
    assert found.cameras is capture.cameras
    assert len(found.points) > 200
    assert np.median(distance_to_room(found.points)) < 0.01  # no fitting here: the very same world
    camera, image = capture.cameras[0], capture.images[0]
    pixels, depth = camera.project(found.points)
    seen = (depth > 0) & (pixels >= 0).all(1) & (pixels < (320, 240)).all(1)
    x, y = pixels[seen].astype(int).T
    assert np.median(np.abs(image[y, x].astype(float) - found.colours[seen])) < 12

    in_this_process(monkeypatch)
    monkeypatch.setattr(pycolmap, "extract_features", _never)
    np.testing.assert_array_equal(add_points(capture, range(4), tmp_path, silent).points, found.points)


def test_points_come_from_larger_pictures_of_the_training_views(tmp_path: Path) -> None:
    """Pictures of 120 px lack what is found at 400; a photograph that is held out gives no point."""
    names = write_photos(tmp_path / "images", LENS, poses(5))
    write_model(tmp_path / "sparse", LENS, names, poses(5))
    small = DatasetConfig(max_side=120, test_every=4, hold_out="every")  # views 0 and 4 are held out
    capture = load_capture(tmp_path, small, tmp_path / "work")
    assert max(capture.images[0].shape) <= 120
    assert np.median(distance_to_room(capture.points)) < 0.01
    blind = replace(capture, photos=())
    few = add_points(blind, [1, 2, 3], tmp_path / "other", silent)
    assert len(capture.points) > 3 * len(few.points)

    Image.new("RGB", (400, 300)).save(tmp_path / "images" / "view_4.png")
    again = load_capture(tmp_path, small, tmp_path / "third")
    np.testing.assert_array_equal(again.points, capture.points)


def test_featureless_views_start_from_random_points(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    capture = known(3)
    flat = [np.full_like(image, 90) for image in capture.images]
    blank = Capture(capture.cameras, tuple(flat), capture.points, capture.colours)
    found = add_points(blank, range(3), tmp_path, silent)
    assert "random" in caplog.text
    assert len(found.points) == 20_000
    assert (found.colours == 90).all()


def test_pairs_are_all_of_few_and_linked_ones_of_many() -> None:
    unknown = np.full((400, 2), np.nan)
    few = pairs_to_match([str(i) for i in range(5)], unknown[:5])
    assert len(few) == len(set(few)) == 10
    many = pairs_to_match(names := [f"{i:04d}" for i in range(400)], unknown)
    assert len(many) == len(set(many)) < 400 * 20
    along = np.minimum(np.arange(300), 299.5 - np.arange(300))  # 11 m a step, and back the same way
    placed = set(pairs_to_match(names, np.vstack([np.c_[52 + 1e-4 * along, 0 * along], unknown[300:]])))
    assert {("0000", "0299"), ("0007", "0290")} <= placed - set(many) < placed
    assert not placed & {("0000", "0150"), ("0050", "0350")}
    linked = {(int(a), int(b)) for a, b in many}
    assert all((i, i + 1) in linked for i in range(399))
    assert (0, 256) in linked


def test_neighbouring_pairs_look_a_similar_way() -> None:
    around = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    eyes = np.stack([np.cos(around), np.sin(around), 0 * around], axis=1)
    ring = [look_at(eye, 2 * eye, np.array([0, 0, 1.0]), (9, 9)) for eye in eyes]
    pairs = neighbouring_pairs(tuple(ring))
    steps = {min(j - i, 24 - (j - i)) for i, j in pairs}
    assert steps == {1, 2, 3, 4, 5}  # 15 degrees each: 75 at most, never back to back
    assert neighbouring_pairs(tuple(ring[:1])) == []


def test_copies_are_upright_and_keep_the_focal_length(tmp_path: Path) -> None:
    """COLMAP ignores the EXIF orientation, so the copies must be turned and must not say so again."""
    exif = Image.Exif()
    exif[0x0112] = 6  # stored lying on its side
    exif[0x0110] = "Camera 1"
    exif.get_ifd(0x8769)[0xA405] = 35  # mm, as on 36 x 24 mm film
    for index in range(3):
        Image.linear_gradient("L").resize((90, 60)).convert("RGB").save(tmp_path / f"{index}.jpg", exif=exif)

    with pytest.raises(WorkCancelledError):
        load_capture(tmp_path, CONFIG, tmp_path / "work", stop_at("finding features"))
    (stage,) = (tmp_path / "work").glob("sfm-*/small")
    camera = pycolmap.infer_camera_from_image(stage / "images/00000.jpg")
    assert (camera.width, camera.height) == (60, 90)
    assert camera.has_prior_focal_length
    assert camera.focal_length == pytest.approx(35 / np.hypot(36, 24) * np.hypot(60, 90), rel=0.01)
    with Image.open(stage / "images/00002.jpg") as copy:
        assert copy.getexif().get(0x0112, 1) == 1


# Structure from motion that has to try several ways, and what is done where it finds too little.

STEPS = 8
SMALL = DatasetConfig(max_side=64)
PINHOLE_LENS = PhotoIntrinsics(400, 300, 380.0, 380.0, 200.0, 150.0)


@pytest.fixture(scope="module")
def street(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("street")
    walk(folder, STEPS)
    return folder


@pytest.fixture(scope="module")
def matched(street: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The street's workspace before it is mapped."""
    work = tmp_path_factory.mktemp("matched")
    (work / "images").mkdir()
    sfm.match_photos(work, sfm.numbered(find_photos(street)), silent)
    return work


def test_a_walk_straight_ahead_is_located(street: Path, tmp_path: Path) -> None:
    capture = load_capture(street, SMALL, tmp_path / "work")
    assert len(capture) == STEPS
    along = np.array([camera.position for camera in capture.cameras])
    steps = np.linalg.norm(np.diff(along, axis=0), axis=1)
    assert steps.max() < 1.1 * steps.min()  # one step after the other, and all as long
    axis = (along[-1] - along[0]) / np.linalg.norm(along[-1] - along[0])
    assert np.abs(np.diff(along, axis=0) @ axis - steps).max() < 0.01 * steps.mean()


@pytest.mark.parametrize(("way", "found"), [(0, 0), (1, STEPS), (2, STEPS), (3, STEPS)])
def test_every_mapper_repeats_its_bytes(way: int, found: int, matched: Path, tmp_path: Path) -> None:
    """And the usual way is what does not find this street."""
    written = []
    for name in ("first", "second"):
        folder = tmp_path / name
        folder.mkdir()
        models = reconstruction.MAPPERS[way](matched, folder, lambda: None)
        assert max((len(reconstruction.located_names(model)) for model in models), default=0) == found
        for model in models:
            model.write_binary(folder)
        written.append({path.name: path.read_bytes() for path in sorted(folder.glob("*.bin"))})
        if not found:
            return
    assert written[0] == written[1]
    assert "images.bin" in written[0]


def synthetic(images: int, points: int) -> "pycolmap.Reconstruction":
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig = 1, 1
    options.num_frames_per_rig, options.num_points3D = images, points
    return pycolmap.synthesize_dataset(options)


def erring(images: int, error: float = 1.0, points: int = 100) -> "pycolmap.Reconstruction":
    model = synthetic(images, points)
    for point in model.points3D.values():
        point.error = error
    return model


def test_best_model_has_most_well_held_photographs_then_least_error() -> None:
    first, better, more = erring(6), erring(6, 0.94), erring(7, 2.0)
    assert reconstruction.best_model(None, [erring(4), first]) is first
    assert reconstruction.best_model(first, [erring(6, 0.96)]) is first  # as good: the earlier way
    assert reconstruction.best_model(None, [first, erring(6, 0.96), better]) is better
    assert reconstruction.best_model(None, [better, more, first]) is more
    wobbly = erring(8, points=reconstruction.FEWEST_POINTS - 1)  # all of its cameras are guesses
    assert reconstruction.best_model(more, [wobbly]) is more
    assert reconstruction.best_model(None, [wobbly]) is None


@pytest.mark.parametrize(("prior", "focal", "lost"), [
    (True, 700, False), (True, 210, True), (True, 2000, True),
    (False, 210, False), (False, 60, True), (False, 2000, False), (False, 5000, True),
])  # fmt: skip
def test_models_with_implausible_focal_lengths_are_astray(prior, focal, lost, tmp_path):
    model = synthetic(4, 100)
    ((number, camera),) = model.cameras.items()
    kind = pycolmap.CameraModelId.SIMPLE_RADIAL
    before = pycolmap.Camera.create_from_model_id(number, kind, 600.0, 800, 600)
    before.has_prior_focal_length = prior
    with pycolmap.Database.open(tmp_path / "database.db") as database:
        database.write_camera(before, use_camera_id=True)
    camera.focal_length = focal
    assert reconstruction.is_astray(model, tmp_path) == lost


@pytest.fixture(scope="module")
def mostly_noise(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four photographs of a room and five of nothing."""
    folder = tmp_path_factory.mktemp("noise")
    write_photos(folder, PINHOLE_LENS, poses(4))
    for index in range(5):
        noise = np.random.default_rng(index).integers(0, 256, (60, 80, 3), dtype=np.uint8)
        Image.fromarray(noise).save(folder / f"noise_{index}.png")
    return folder


def test_fewer_than_half_located_is_refused_unless_allowed(mostly_noise: Path, tmp_path: Path) -> None:
    for _ in range(2):  # the second time from what the first one kept
        with pytest.raises(InputError, match="only 4 of 9 photographs could be located") as caught:
            load_capture(mostly_noise, SMALL, tmp_path)
        said = str(caught.value)
        assert ", ".join(f"noise_{index}.png" for index in range(5)) in said
        assert "--dataset.allow-few-cameras" in said
    told = DatasetConfig(max_side=64, allow_few_cameras=True)
    assert len(load_capture(mostly_noise, told, tmp_path)) == 4
    (stage,) = tmp_path.glob("sfm-*")
    matches = read_matches(stage, sfm.numbered(find_photos(mostly_noise)), ())
    assert [len(group) for group in matches.groups] == [4, 1, 1, 1, 1, 1]


@pytest.mark.parametrize("label", ["finding features", "locating cameras"])
def test_a_disk_that_fills_up_is_an_error_of_the_disk(label: str, mostly_noise: Path, tmp_path: Path) -> None:
    """pycolmap then aborts, or raises, wherever it is."""
    told = DatasetConfig(max_side=64, allow_few_cameras=True)
    with small_disk(tmp_path / "disk", ROOM + (16 << 20)) as disk:

        def fill(at: Report) -> None:
            if at.stage == label and not (disk / "full").exists():
                with suppress(OSError), (disk / "full").open("wb", buffering=0) as file:
                    while file.write(bytes(1 << 16)):
                        pass

        with pytest.raises(OSError, match="No space left") as caught:
            load_capture(mostly_noise, told, disk / "work", Progress(fill))
        assert disk / "work" in Path(caught.value.filename).parents
        (disk / "full").unlink()
        assert len(load_capture(mostly_noise, told, disk / "work")) == 4


def test_truncated_models_are_not_kept(tmp_path: Path) -> None:
    """pycolmap writes what fits and says nothing."""
    model = synthetic(4, 100)
    (tmp_path / "whole").mkdir()
    model.write_binary(tmp_path / "whole")
    for name in ("cameras.bin", "images.bin", "points3D.bin"):
        with (
            files_of_at_most((tmp_path / "whole" / name).stat().st_size - 1),
            pytest.raises(OSError, match="No space"),
        ):
            reconstruction.store_model(model, tmp_path)
        assert not (tmp_path / "sparse").exists()
    reconstruction.store_model(model, tmp_path)
    assert (tmp_path / "sparse").is_dir()


# The graph of matches: its groups, where photographs are missing, and how that is said.


def graph(count: int, pairs: list[tuple[int, int, int]], located=(), features: int = 900) -> Matches:
    names = tuple(f"IMG_{number:02d}.jpg" for number in range(count))
    return Matches(names, (features,) * count, tuple(pairs), frozenset(located))


def chain(rows: range, shared: int = 100) -> list[tuple[int, int, int]]:
    return [(a, a + 1, shared) for a in rows[:-1]]


def test_groups_and_the_gaps_between_them():
    matches = graph(12, chain(range(5)) + chain(range(5, 9)) + chain(range(9, 12)) + [(8, 9, 7)], range(5, 9))
    assert matches.groups == [[5, 6, 7, 8], [0, 1, 2, 3, 4], [9, 10, 11]]
    assert matches.gap == (4, 5)
    assert matches.advice() == (
        "if IMG_05.jpg to IMG_08.jpg (4) and IMG_00.jpg to IMG_04.jpg (5) and IMG_09.jpg to IMG_11.jpg (3) "
        "are captures of their own, train each from its own folder; else take more photographs between "
        "IMG_04.jpg and IMG_05.jpg (no matches)"
    )
    assert matches.why(4) == "matches only others that have no camera"


def test_a_gap_joins_photographs_where_they_match_most():
    matches = graph(5, chain(range(4)) + [(1, 4, 20), (2, 4, 31), (3, 4, 3)], range(4))
    assert matches.gap == (2, 4)
    assert "without enough overlap" in matches.why(4)


MAY = ExifFacts(datetime(2026, 5, 3), camera="K")


@pytest.mark.parametrize(("second", "folder", "told"), [
    (replace(MAY, taken=datetime(2026, 5, 9)), "a", "on other days"),
    (replace(MAY, camera="L"), "a", "by other cameras"),
    (MAY, "b", "in other folders"),
    (ExifFacts(), "a", ""),
])  # fmt: skip
@pytest.mark.parametrize("matched", [True, False])
def test_two_captures_in_one_folder_are_told_apart(second, folder, told, matched) -> None:
    matches = graph(7, chain(range(4)) + chain(range(4, 7)) * matched, range(4))
    names = tuple(f"{'a' if row < 4 else folder}/{row}.jpg" for row in range(7))
    matches = replace(matches, names=names, exif=(MAY,) * 4 + (second,) * 3)
    assert matches.captures == [[0, 1, 2, 3], [4, 5, 6]][: 2 if told or matched else 1]
    assert (f"captures of their own ({told})" in matches.advice()) == bool(told)
    assert ("if a/0.jpg to a/3.jpg (4) and a/4.jpg" in matches.advice()) == (matched and not told)


def test_no_feature_is_sought_where_a_mask_is_black(tmp_path: Path) -> None:
    photos, work = tmp_path / "photos", tmp_path / "work"
    write_photos(photos, LENS.resized(240, 180), poses(3))
    left = np.zeros((90, 120), bool)
    left[:, :60] = True
    mask_file(photos / "masks/view_1.png.png", left)
    (work / "images").mkdir(parents=True)
    assert sfm.match_photos(work, sfm.numbered(find_photos(photos)), silent) == 3
    with pycolmap.Database.open(work / "database.db") as database:
        ends = [database.read_keypoints(number)[:, 0].max() for number in (1, 2, 3)]
    assert ends[1] < 121 < min(ends[0], ends[2])
