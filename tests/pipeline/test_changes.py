"""What changes around a training between its interruption and its end, and around a program that reads."""

import json
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from langsplat_core.config import TrainConfig
from langsplat_core.io.scenes import save_scene
from langsplat_core.pipeline.train import train_scene
from langsplat_core.progress import Cancelled
from tests.support.another_user import bound_by_permissions
from tests.support.fakes import blob_scene
from tests.support.tiny_room import tiny_room, tiny_settings

pytestmark = pytest.mark.long
YEARS = {"1971": 31_600_000, "2099": 4_070_000_000}


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tiny_room(tmp_path_factory.mktemp("room"))


@pytest.fixture(scope="module")
def whole(room: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """The scene of a run that nothing happened to."""
    out = tmp_path_factory.mktemp("whole") / "scene.ply"
    train_scene(room, out, tiny_settings(room))
    return scene_in(out.parent)


def scene_in(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}


def interrupted(room: Path, folder: Path, config: TrainConfig) -> None:
    """A training that ends when most of its steps are done, with a checkpoint."""

    def stop(label: str, fraction: float) -> None:
        if label.startswith("Training") and fraction > 0.7:
            raise Cancelled

    with pytest.raises(Cancelled):
        train_scene(room, folder / "scene.ply", config, progress=stop)
    assert list((folder / "scene.work").glob("*.checkpoint.safetensors"))


def test_other_options_after_an_interruption(room: Path, tmp_path: Path) -> None:
    first = other = tiny_settings(room)
    other = replace(
        other, radiance=replace(other.radiance, seed=7), dataset=replace(other.dataset, max_side=48)
    )
    interrupted(room, tmp_path, first)
    train_scene(room, tmp_path / "scene.ply", other)
    (tmp_path / "fresh").mkdir()
    train_scene(room, tmp_path / "fresh" / "scene.ply", other)
    assert scene_in(tmp_path) == scene_in(tmp_path / "fresh")


def test_other_photographs_after_an_interruption(room: Path, tmp_path: Path) -> None:
    data = tmp_path / "data"
    shutil.copytree(room, data)
    interrupted(data, tmp_path, tiny_settings(room))
    photo = data / "images" / "photo_1.png"
    pixels = np.array(Image.open(photo))
    pixels[:9] = 255 - pixels[:9]
    Image.fromarray(pixels).save(photo)
    (data / "images" / "photo_3.png").unlink()
    train_scene(data, tmp_path / "scene.ply", tiny_settings(room))
    (tmp_path / "fresh").mkdir()
    train_scene(data, tmp_path / "fresh" / "scene.ply", tiny_settings(room))
    assert scene_in(tmp_path) == scene_in(tmp_path / "fresh")


def test_everything_moved_after_an_interruption(room: Path, whole: dict[str, bytes], tmp_path: Path) -> None:
    shutil.copytree(room, tmp_path / "here" / "data")
    interrupted(tmp_path / "here" / "data", tmp_path / "here", tiny_settings(room))
    (tmp_path / "here").rename(tmp_path / "there")
    there = tmp_path / "there"
    reported: list[float] = []

    def watch(label: str, fraction: float) -> None:
        if label.startswith("Training"):
            reported.append(fraction)

    train_scene(there / "data", there / "scene.ply", tiny_settings(room), progress=watch)
    assert min(reported) > 0.5  # it went on from the checkpoint
    assert scene_in(there) == whole


@pytest.mark.parametrize("year", YEARS)
def test_a_clock_that_was_wrong(year: str, room: Path, whole: dict[str, bytes], tmp_path: Path) -> None:
    """Nothing is decided by dates: files of long ago and of the future count as any."""
    data = tmp_path / "data"
    shutil.copytree(room, data)
    interrupted(data, tmp_path, tiny_settings(room))
    for path in [path for path in tmp_path.rglob("*") if path.is_file()]:
        os.utime(path, (YEARS[year], YEARS[year]))
    train_scene(data, tmp_path / "scene.ply", tiny_settings(room))
    assert scene_in(tmp_path) == whole
    kept = list((tmp_path / "scene.work").rglob("*.np*"))
    for path in kept:
        os.utime(path, (YEARS[year], YEARS[year]))
    train_scene(data, tmp_path / "scene.ply", tiny_settings(room))
    assert {int(path.stat().st_mtime) for path in kept} == {YEARS[year]}  # nothing was made again


@pytest.mark.parametrize(
    "surroundings", [{"HOME": "/nonexistent", "LANG": "C", "LC_ALL": "C"}, {"LANG": "xx_YY.nothing"}]
)
def test_questions_without_a_home_a_language_or_a_place_to_write(
    surroundings: dict[str, str], tmp_path: Path
) -> None:
    """The scene's folder and the file are read-only, and its name is not ASCII."""
    folder = tmp_path / "büro"
    folder.mkdir()
    save_scene(folder / "tür.ply", blob_scene(phrasebook=True))
    for path in [*folder.iterdir(), folder]:
        path.chmod(0o555)
    kept = {
        name: os.environ[name] for name in ("PATH", "PYTHONPATH", "NUMBA_CACHE_DIR") if name in os.environ
    }
    done = subprocess.run(
        [sys.executable, "-m", "langsplat_core", "query", str(folder / "tür.ply"), "book", "--json"],
        env=kept | surroundings,
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
        preexec_fn=bound_by_permissions(),
    )
    folder.chmod(0o755)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)[0]["phrase"] == "book"
    assert sorted(path.suffix for path in folder.iterdir()) == [".json", ".ply", ".safetensors"]
