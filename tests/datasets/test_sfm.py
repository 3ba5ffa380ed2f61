"""Structure from motion and triangulation, on a small textured room whose shape is known."""

import logging
import os
import shutil
import sqlite3
from collections.abc import Callable, Collection, Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from PIL import Image

from langsplat_core.arrays import Array
from langsplat_core.config import DatasetConfig
from langsplat_core.datasets import load_capture, sfm
from langsplat_core.datasets.capture import Capture
from langsplat_core.datasets.intrinsics import BrownDistortion, PhotoIntrinsics
from langsplat_core.datasets.known_poses import add_points, neighbouring_views
from langsplat_core.datasets.sfm import pairs_by_name
from langsplat_core.errors import InputError
from langsplat_core.progress import Cancelled, Progress, silent
from langsplat_core.scene import Camera, look_at
from tests.support.photographed import (
    colmap_reconstruction,
    distance_to_room,
    photograph,
    poses,
    write_photos,
)

pytestmark = pytest.mark.long

VIEWS = 6
LENS = PhotoIntrinsics(400, 300, 380.0, 380.0, 200.0, 150.0, BrownDistortion(-0.06))
CONFIG = DatasetConfig(max_side=400)
STAGES = [
    "preparing photographs",
    "finding features",
    "matching photographs",
    "locating cameras",
    "reading photographs",
]
TABLES = ("keypoints", "descriptors", "matches", "two_view_geometries")


@contextmanager
def recorded(folder: Path) -> Iterator[None]:
    """Keeps in `folder` what every way of the mapper is given and gives: ``0.db``, ``0-0/cameras.bin`` ..."""
    folder.mkdir(parents=True)

    def watched(number: int, way: Callable[..., Collection[sfm.Model]]) -> Callable[..., object]:
        def run(workspace: Path, attempts: Path, advance: Callable[[], None]) -> Collection[sfm.Model]:
            models = list(way(workspace, attempts, advance))
            with closing(sqlite3.connect(workspace / "database.db")) as database:
                database.execute("VACUUM INTO ?", (str(folder / f"{number}.db"),))
            for index, model in enumerate(models):
                (folder / f"{number}-{index}").mkdir()
                model.write_binary(folder / f"{number}-{index}")
            return models

        return run

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sfm, "WAYS", tuple(watched(*each) for each in enumerate(sfm.WAYS)))
        yield


def contents(record: Path) -> dict[str, bytes]:
    """Tables of the databases, and files of the models, in what was `recorded`."""
    found = {str(path.relative_to(record)): path.read_bytes() for path in record.rglob("*.bin")}
    for path in record.glob("*.db"):
        with closing(sqlite3.connect(path)) as database:
            for table in TABLES:
                rows = database.execute(f"SELECT * FROM {table} ORDER BY 1").fetchall()
                found[f"{path.name} {table}"] = repr(rows).encode()
    return found


def assert_same(ours: Path, theirs: Path) -> None:
    """Two work folders: what differs is printed, of both, each table and each way's model by itself."""
    a, b = contents(ours / "record"), contents(theirs / "record")
    assert {f"{way}.db {table}" for way in range(3) for table in TABLES} < a.keys()
    lines = []
    for name in sorted(a.keys() | b.keys()):
        mine, other = a.get(name, b""), b.get(name, b"")
        if mine != other:
            pairs = enumerate(zip(mine, other, strict=False))
            at = next((place for place, (x, y) in pairs if x != y), min(len(mine), len(other)))
            lines.append(f"{name} from byte {at}: {mine[at : at + 32]!r} and {other[at : at + 32]!r}")
    assert not lines, "\n".join([*lines, f"kept: {ours}", f"and {theirs}"])


def solve(photos: Path, work: Path, progress: Progress = silent) -> Capture:
    """Goes on from what is in `work`; what the mapper was given and gave, and the model, is in ``record``."""
    with recorded(work / "record"):
        capture = load_capture(photos, CONFIG, work, progress)
    (stage,) = work.glob("sfm-*")
    shutil.copytree(stage / "sparse", work / "record" / "sparse")
    return capture


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
def located(
    photos: Path, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Capture, Path, list[str], list[str]]:
    """The capture, its work folder, the labels seen, the warnings given. The run is cancelled once, after
    features were found, and then repeated."""
    work = tmp_path_factory.mktemp("work")

    def cancel(label: str, _: float) -> None:
        if label == "matching photographs":
            raise Cancelled

    with pytest.raises(Cancelled):
        load_capture(photos, CONFIG, work, cancel)

    labels: list[str] = []
    messages: list[str] = []
    handler = logging.Handler(logging.WARNING)
    handler.emit = lambda record: messages.append(record.getMessage())  # type: ignore[method-assign]
    logging.getLogger("langsplat").addHandler(handler)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pycolmap, "extract_features", _never)
        capture = solve(photos, work, lambda label, _: labels.append(label))
    logging.getLogger("langsplat").removeHandler(handler)
    return capture, work, labels, messages


def _never(**_: object) -> None:
    raise AssertionError("computed again")


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
    capture, _, labels, _ = located
    assert [camera.name for camera in capture.cameras] == [f"view_{i}" for i in range(VIEWS)]
    assert list(dict.fromkeys(labels)) == STAGES
    centres = np.array([camera.position for camera in capture.cameras])
    truth = np.array([-m[:3, :3].T @ m[:3, 3] for m in poses(VIEWS)])
    assert np.abs(aligned(centres, centres, truth) - truth).max() < 0.02  # of a room 4 units wide
    room = aligned(capture.points, centres, truth)
    assert len(room) > 300
    assert np.median(distance_to_room(room)) < 0.01


def test_what_was_left_out_is_reported(located) -> None:  # type: ignore[no-untyped-def]
    _, _, _, messages = located
    assert any("aa_broken.jpg" in message and "cannot be read" in message for message in messages)
    (lost,) = [message for message in messages if "could not be located" in message]
    assert "no matches with any other: zz_noise.JPG" in lost
    assert "cannot be read: aa_broken.jpg" in lost


def test_a_second_run_computes_nothing(
    photos: Path,
    located,  # type: ignore[no-untyped-def]
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    capture, work, _, _ = located
    for name in ("extract_features", "match_image_pairs", "incremental_mapping"):
        monkeypatch.setattr(pycolmap, name, _never)
    again = load_capture(photos, CONFIG, work)
    np.testing.assert_array_equal(again.points, capture.points)
    np.testing.assert_array_equal(again.cameras[3].world_to_camera, capture.cameras[3].world_to_camera)
    (stage,) = work.glob("sfm-*")
    assert sorted(path.name for path in stage.iterdir()) == ["left_out.json", "sparse"]


def test_cameras_are_the_same_byte_for_byte(
    photos: Path,
    located,  # type: ignore[no-untyped-def]
    tmp_path: Path,
) -> None:
    """Solved at once, from copies with other dates in another place, as by the run that was interrupted."""
    shutil.copytree(photos, tmp_path / "moved")
    for photo in (tmp_path / "moved" / "images").iterdir():
        os.utime(photo, (0, 0))
    solve(tmp_path / "moved", tmp_path / "work")
    assert_same(located[1], tmp_path / "work")
    (ours,), (theirs,) = located[1].glob("sfm-*"), (tmp_path / "work").glob("sfm-*")
    assert ours.name == theirs.name


def test_changed_photographs_are_computed_again(
    photos: Path,
    located,  # type: ignore[no-untyped-def]
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    dataset, work = tmp_path / "dataset", tmp_path / "work"
    dataset.mkdir()
    for photo in (photos / "images").glob("*.png"):
        shutil.copy(photo, dataset)
    shutil.copytree(located[1], work)
    monkeypatch.setattr(pycolmap, "extract_features", _never)
    with pytest.raises(AssertionError, match="computed again"):
        load_capture(dataset, CONFIG, work)


def known(count: int = VIEWS, size: tuple[int, int] = (320, 240)) -> Capture:
    """The room through pinholes at the true poses, without points."""
    intrinsics = PhotoIntrinsics(*size, 300.0, 300.0, size[0] / 2, size[1] / 2)
    cameras = [
        Camera(*size, 300, 300, intrinsics.cx, intrinsics.cy, m, f"v{i}") for i, m in enumerate(poses(count))
    ]
    images = [photograph(intrinsics, camera.world_to_camera) for camera in cameras]
    return Capture(tuple(cameras), tuple(images), np.zeros((0, 3)), np.zeros((0, 3), np.uint8))


def test_known_poses_give_points_in_their_own_world(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    capture = known(4)
    labels: list[str] = []
    found = add_points(capture, range(4), tmp_path, lambda label, _: labels.append(label))
    assert list(dict.fromkeys(labels)) == [STAGES[0], *STAGES[1:3], "triangulating points"]
    assert found.cameras is capture.cameras
    assert len(found.points) > 200
    assert np.median(distance_to_room(found.points)) < 0.01  # no fitting here: the very same world
    camera, image = capture.cameras[0], capture.images[0]
    pixels, depth = camera.project(found.points)
    seen = (depth > 0) & (pixels >= 0).all(1) & (pixels < (320, 240)).all(1)
    x, y = pixels[seen].astype(int).T
    assert np.median(np.abs(image[y, x].astype(float) - found.colours[seen])) < 12

    monkeypatch.setattr(pycolmap, "extract_features", _never)
    np.testing.assert_array_equal(add_points(capture, range(4), tmp_path, silent).points, found.points)


def write_located(folder: Path, count: int) -> None:
    """Photographs through `LENS` with a COLMAP model of true cameras that has no points."""
    names = write_photos(folder / "images", LENS, poses(count))
    params = [LENS.fx, LENS.cx, LENS.cy, -0.06]
    model = colmap_reconstruction("SIMPLE_RADIAL", (400, 300), params, names, poses(count))
    (folder / "sparse").mkdir()
    model.write_binary(folder / "sparse")


def test_points_come_from_larger_pictures_of_the_training_views(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Pictures of 120 px lack what is found at 400; a photograph that is held out gives no point."""
    write_located(tmp_path, 5)
    small = DatasetConfig(max_side=120, test_every=4)  # views 0 and 4 are held out
    capture = load_capture(tmp_path, small, tmp_path / "work")
    assert max(capture.images[0].shape) <= 120
    assert np.median(distance_to_room(capture.points)) < 0.01
    blind = replace(capture, photos=())
    few = add_points(blind, [1, 2, 3], tmp_path / "other", silent)
    assert len(capture.points) > 3 * len(few.points)

    black = tuple(np.zeros_like(image) if i in (0, 4) else image for i, image in enumerate(capture.images))
    for name in ("view_0.png", "view_4.png"):
        Image.new("RGB", (400, 300)).save(tmp_path / "images" / name)
    again = load_capture(tmp_path, small, tmp_path / "third")
    np.testing.assert_array_equal(again.images[4], black[4])
    np.testing.assert_array_equal(again.points, capture.points)


def test_featureless_views_start_from_random_points(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    capture = known(3)
    flat = [np.full_like(image, 90) for image in capture.images]
    blank = Capture(capture.cameras, tuple(flat), capture.points, capture.colours)
    with caplog.at_level(logging.WARNING, "langsplat"):
        found = add_points(blank, range(3), tmp_path, silent)
    assert "random" in caplog.text
    assert len(found.points) == 20_000
    assert (found.colours == 90).all()


def test_every_pair_of_few_photographs_and_a_linked_selection_of_many() -> None:
    few = pairs_by_name([str(i) for i in range(5)])
    assert len(few) == len(set(few)) == 10
    many = pairs_by_name([f"{i:04d}" for i in range(400)])
    assert len(many) == len(set(many)) < 400 * 20
    linked = {(int(a), int(b)) for a, b in many}
    assert all((i, i + 1) in linked for i in range(399))
    assert (0, 256) in linked


def test_neighbouring_views_look_a_similar_way() -> None:
    ring = [
        look_at(
            np.array([np.cos(a), np.sin(a), 0]), 2 * np.array([np.cos(a), np.sin(a), 0]), [0, 0, 1], (9, 9)
        )
        for a in np.linspace(0, 2 * np.pi, 24, endpoint=False)
    ]
    pairs = neighbouring_views(tuple(ring))
    steps = {min(j - i, 24 - (j - i)) for i, j in pairs}
    assert steps == {1, 2, 3, 4, 5}  # 15 degrees each: 75 at most, never back to back
    assert neighbouring_views(tuple(ring[:1])) == []


def test_copies_are_upright_and_keep_the_focal_length(tmp_path: Path) -> None:
    """COLMAP ignores the EXIF orientation, so the copies must be turned and must not say so again."""
    exif = Image.Exif()
    exif[0x0112] = 6  # stored lying on its side
    exif[0x0110] = "Camera 1"
    exif.get_ifd(0x8769)[0xA405] = 35  # mm, as on 36 x 24 mm film
    for index in range(3):
        Image.linear_gradient("L").resize((90, 60)).convert("RGB").save(tmp_path / f"{index}.jpg", exif=exif)

    def cancel(label: str, _: float) -> None:
        if label == "finding features":
            raise Cancelled

    with pytest.raises(Cancelled):
        load_capture(tmp_path, CONFIG, tmp_path / "work", cancel)
    (stage,) = (tmp_path / "work").glob("sfm-*")
    camera = pycolmap.infer_camera_from_image(stage / "images/00000.jpg")
    assert (camera.width, camera.height) == (60, 90)
    assert camera.has_prior_focal_length
    assert camera.focal_length == pytest.approx(35 / np.hypot(36, 24) * np.hypot(60, 90), rel=0.01)
    with Image.open(stage / "images/00002.jpg") as copy:
        assert copy.getexif().get(0x0112, 1) == 1


def test_too_few_photographs_say_so(tmp_path: Path) -> None:
    write_photos(tmp_path / "two", LENS.regridded(64, 48), poses(2))
    with pytest.raises(InputError, match="has 2 photographs; at least 3"):
        load_capture(tmp_path / "two", CONFIG, tmp_path / "work")


def test_photographs_that_do_not_overlap_say_so(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    for index in range(3):
        Image.fromarray(rng.integers(0, 256, (120, 160, 3), dtype=np.uint8)).save(tmp_path / f"{index}.png")
    with pytest.raises(InputError, match="of 3 photographs could be located") as caught:
        load_capture(tmp_path, CONFIG, tmp_path / "work")
    assert "(no matches with any other: 0.png, 1.png, 2.png)" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_each_photograph_that_has_no_camera_is_told_why(tmp_path: Path) -> None:
    """Black, tiny, alone, and one view taken three times."""
    (name,) = write_photos(tmp_path, LENS, poses(1))
    for copy in ("b.png", "c.png"):
        shutil.copy(tmp_path / name, tmp_path / copy)
    (tmp_path / name).rename(tmp_path / "a.png")
    Image.new("RGB", (400, 300)).save(tmp_path / "black.png")
    Image.new("RGB", (2, 2), (255, 0, 0)).save(tmp_path / "tiny.png")
    with pytest.raises(InputError, match="0 of 5 photographs could be located") as caught:
        load_capture(tmp_path, CONFIG, tmp_path / "work")
    message = str(caught.value)
    assert "from one and the same place, or without enough overlap: a.png" in message
    assert "the same picture as a.png: b.png, c.png" in message
    assert "no features (nothing but plain areas, or blurred): black.png, tiny.png" in message
