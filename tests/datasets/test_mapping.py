"""Structure from motion that has to try several ways, and what is done where it finds too little."""

import json
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pycolmap
import pytest
from PIL import Image

from langsplat_core.config import DatasetConfig
from langsplat_core.datasets import load_capture, sfm
from langsplat_core.datasets.capture import find_photos
from langsplat_core.datasets.intrinsics import PhotoIntrinsics
from langsplat_core.errors import InputError
from langsplat_core.progress import Cancelled
from tests.support.full_disk import files_of_at_most
from tests.support.photographed import poses, write_photos
from tests.support.street import walk

pytestmark = pytest.mark.long

STEPS = 8
CONFIG = DatasetConfig(max_side=64)
LENS = PhotoIntrinsics(400, 300, 380.0, 380.0, 200.0, 150.0)


@pytest.fixture(scope="module")
def street(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("street")
    walk(folder, STEPS)
    return folder


@pytest.fixture(scope="module")
def matched(street: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The street's workspace before it is mapped."""
    work = tmp_path_factory.mktemp("matched")

    def cancel(label: str, _: float) -> None:
        if label == "locating cameras":
            raise Cancelled

    with pytest.raises(Cancelled):
        load_capture(street, CONFIG, work, cancel)
    (workspace,) = work.glob("sfm-*")
    return workspace


def advance() -> None:
    pass


def test_a_walk_straight_ahead_is_located(street: Path, tmp_path: Path) -> None:
    capture = load_capture(street, CONFIG, tmp_path / "work")
    assert len(capture) == STEPS
    along = np.array([camera.position for camera in capture.cameras])
    steps = np.linalg.norm(np.diff(along, axis=0), axis=1)
    assert steps.max() < 1.1 * steps.min()  # one step after the other, and all as long
    axis = (along[-1] - along[0]) / np.linalg.norm(along[-1] - along[0])
    assert np.abs(np.diff(along, axis=0) @ axis - steps).max() < 0.01 * steps.mean()


@pytest.mark.parametrize(("way", "found"), [(0, 0), (1, STEPS), (2, STEPS)])
def test_every_way_gives_the_same_bytes_again(way: int, found: int, matched: Path, tmp_path: Path) -> None:
    """And the usual way is what does not find this street."""
    written = []
    for name in ("first", "second"):
        folder = tmp_path / name
        folder.mkdir()
        models = sfm.WAYS[way](matched, folder, advance)
        assert max((len(sfm.located_names(model)) for model in models), default=0) == found
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


def test_the_model_with_most_well_held_photographs_is_kept() -> None:
    small, large = synthetic(4, 100), synthetic(6, 100)
    assert sfm.best_model(None, [small, large]) is large
    again = pycolmap.Reconstruction(large)
    assert sfm.best_model(large, [small, again]) is large  # equal: the earlier way
    wobbly = synthetic(7, sfm.FEWEST_POINTS - 1)  # all of its cameras are guesses
    assert sfm.best_model(large, [wobbly]) is large
    assert sfm.best_model(None, [wobbly]) is None


def test_of_models_about_as_good_the_first_is_kept() -> None:
    def erring(images: int, error: float) -> "pycolmap.Reconstruction":
        model = synthetic(images, 100)
        for point in model.points3D.values():
            point.error = error
        return model

    first, better, more = erring(6, 1.0), erring(6, 0.94), erring(7, 2.0)
    assert sfm.best_model(first, [erring(6, 0.96)]) is first
    assert sfm.best_model(None, [first, erring(6, 0.96), better]) is better
    assert sfm.best_model(None, [better, more, first]) is more


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_libraries_inside_of_pycolmap_keep_to_one_thread_and_others_do_not() -> None:
    code = """
import ctypes, os
from langsplat_core.datasets.intrinsics import pycolmap
libraries = {line.split()[-1] for line in open("/proc/self/maps") if "pycolmap.libs/libgomp" in line}
print([ctypes.CDLL(path).omp_get_max_threads() for path in libraries], os.environ["OMP_NUM_THREADS"])
"""
    environment = os.environ | {"OMP_NUM_THREADS": "3"}
    told = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True
    )
    assert told.stdout.split() == ["[1]", "3"]


@pytest.fixture(scope="module")
def mostly_noise(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four photographs of a room and five of nothing."""
    folder = tmp_path_factory.mktemp("noise")
    write_photos(folder, LENS, poses(4))
    for index in range(5):
        noise = np.random.default_rng(index).integers(0, 256, (60, 80, 3), dtype=np.uint8)
        Image.fromarray(noise).save(folder / f"noise_{index}.png")
    return folder


def test_below_half_is_refused_each_time_unless_told_otherwise(mostly_noise: Path, tmp_path: Path) -> None:
    for _ in range(2):  # the second time from what the first one kept
        with pytest.raises(InputError, match="only 4 of 9 photographs could be located") as caught:
            load_capture(mostly_noise, CONFIG, tmp_path)
        said = str(caught.value)
        assert ", ".join(f"noise_{index}.png" for index in range(5)) in said
        assert "--dataset.allow-few-cameras" in said
    told = DatasetConfig(max_side=64, allow_few_cameras=True)
    assert len(load_capture(mostly_noise, told, tmp_path)) == 4
    (stage,) = tmp_path.glob("sfm-*")
    assert len(json.loads((stage / sfm.LEFT_OUT).read_text())) == 5


def test_two_views_are_refused_although_they_are_half(
    mostly_noise: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """COLMAP may end with a first pair that nothing else was added to."""
    for path in find_photos(mostly_noise)[-4:]:  # the room's
        (tmp_path / path.name).symlink_to(path)

    def gives_up(folder: Path, count: int, progress: object) -> None:
        model = synthetic(2, 100)
        for number, image in sorted(model.images.items()):
            image.name = f"{number - 1:05d}.jpg"
        sfm.write_left_out(folder, sfm.located_names(model))
        sfm.store_model(model, folder)

    monkeypatch.setattr(sfm, "map_cameras", gives_up)
    for _ in range(2):
        with pytest.raises(InputError, match="only 2 of 4 photographs"):
            load_capture(tmp_path, CONFIG, tmp_path / "work")


@pytest.mark.parametrize("label", ["finding features", "matching photographs", "locating cameras"])
def test_a_full_disk_is_said_before_pycolmap_ends_the_process(
    label: str, mostly_noise: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fill(reported: str, fraction: float) -> None:
        if reported == label:
            monkeypatch.setattr("shutil.disk_usage", lambda _: SimpleNamespace(free=1000))

    told = DatasetConfig(max_side=64, allow_few_cameras=True)
    with pytest.raises(OSError, match="No space left") as caught:
        load_capture(mostly_noise, told, tmp_path, fill)
    assert Path(caught.value.filename).parent == tmp_path
    monkeypatch.undo()
    assert len(load_capture(mostly_noise, told, tmp_path)) == 4


def test_a_model_that_was_cut_off_is_not_kept(tmp_path: Path) -> None:
    """pycolmap writes what fits and says nothing."""
    model = synthetic(4, 100)
    (tmp_path / "whole").mkdir()
    model.write_binary(tmp_path / "whole")
    for name in ("cameras.bin", "images.bin", "points3D.bin"):
        with (
            files_of_at_most((tmp_path / "whole" / name).stat().st_size - 1),
            pytest.raises(OSError, match="No space"),
        ):
            sfm.store_model(model, tmp_path)
        assert not (tmp_path / "sparse").exists()
    sfm.store_model(model, tmp_path)
    assert (tmp_path / "sparse").is_dir()
