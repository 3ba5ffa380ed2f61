"""A disk that is full, for every kind of file that is written: one line, and what was there stays."""

import os
import shutil
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from langsplat_core.cli.bench import write_report
from langsplat_core.cli.run import main
from langsplat_core.errors import InputError
from langsplat_core.evaluation.report import write_json
from langsplat_core.io.cameras import write_cameras
from langsplat_core.io.files import atomic_path
from langsplat_core.io.langsplat_files import write_autoencoder, write_checkpoint, write_features
from langsplat_core.io.language import write_language
from langsplat_core.io.ply import write_ply
from langsplat_core.io.scenes import WRITABLE, save_scene
from langsplat_core.io.shapes import write_points
from langsplat_core.pipeline.stages import kept, kept_array
from langsplat_core.scene import Scene
from langsplat_core.semantics.store import FeatureStore, ImageFeatures
from langsplat_core.training.radiance.state import save_checkpoint
from langsplat_viewer.files.browsing import QuerySet, SavedQuery, write_queries
from langsplat_viewer.files.flights import Bookmark, Shelf, write_flight
from langsplat_viewer.files.preferences import Preferences, save_preferences
from langsplat_viewer.output.film import Film, write_film
from langsplat_viewer.output.saving import save_png
from tests.support.file_samples import random_codec, random_field
from tests.support.marks_and_flights import flight as some_flight
from tests.support.processes import files_of_at_most
from tests.support.scenes import random_camera, random_gaussians

GAUSSIANS = random_gaussians(40, 1, sh_degree=1)
FIELD = random_field(40)
SCENE = Scene(GAUSSIANS, FIELD, (replace(random_camera(), name="a"),))
EARLIER = b"what was there before"
Write = Callable[[Path], object]  # gets a folder of its own


def film(name: str) -> Write:
    def write(folder: Path) -> None:
        noise = np.random.default_rng(0)
        settings = Film(folder / name, 3, (32, 24), 4.0, "settings")
        write_film(settings, lambda _: noise.integers(0, 255, (24, 32, 3), dtype=np.uint8))

    return write


def checkpoint(folder: Path) -> None:
    import torch

    from langsplat_core.training.radiance.state import start

    save_checkpoint(folder / "c.safetensors", start(GAUSSIANS, 5, torch.device("cpu")), "abc")


def features(folder: Path) -> None:
    described = ImageFeatures(np.zeros((3, 8, 8), np.int32), np.ones((1, 512), np.float32))
    FeatureStore(folder).save("photo", described, "key")


def flight(folder: Path) -> None:
    write_flight(folder / "f.path.json", some_flight())


def bookmarks(folder: Path) -> None:
    pose = some_flight().keyframes[0].pose
    Shelf(folder).write(Path("s.ply"), (Bookmark("door", pose, 1.0),))


def stage(folder: Path) -> None:
    noise = {"a": np.random.default_rng(0).normal(size=999)}
    kept(folder / "codec.npz", lambda: noise, lambda made: made, dict)


def save_scene_as(suffix: str, folder: Path) -> None:
    save_scene(folder / f"s{suffix}", SCENE)


WRITERS: dict[str, Write] = {
    **{f"scene {suffix}": partial(save_scene_as, suffix) for suffix in WRITABLE},
    "Gaussians": lambda folder: write_ply(folder / "s.ply", GAUSSIANS),
    "sidecar": lambda folder: write_language(folder / "s.safetensors", FIELD, GAUSSIANS.means),
    "cameras": lambda folder: write_cameras(folder / "cameras.json", SCENE.cameras),
    "points": lambda folder: write_points(folder / "points.ply", GAUSSIANS),
    "their checkpoint": lambda folder: write_checkpoint(
        folder / "c.pth", GAUSSIANS, np.ones((40, 3), np.float32)
    ),
    "their autoencoder": lambda folder: write_autoencoder(
        folder / "a.pth", *random_codec("autoencoder").networks
    ),  # type: ignore[misc]
    "their features": lambda folder: write_features(
        folder, "a", np.ones((2, 64), np.float32), np.zeros((4, 8, 8), np.int32)
    ),
    "feature store": features,
    "checkpoint": checkpoint,
    "stage": stage,
    "stage's array": lambda folder: kept_array(folder / "a.npy", lambda: np.ones(999)),
    "report of a benchmark": lambda folder: write_report(folder, "r", "text", list(range(999))),
    "report of scores": lambda folder: write_json(folder / "r.json", list(range(999))),
    "picture": lambda folder: save_png(
        folder / "p.png", np.random.default_rng(0).integers(0, 255, (40, 40, 3), np.uint8)
    ),
    "film .gif": film("film.gif"),
    "film .webp": film("film.webp"),
    "film .mp4": film("film.mp4"),
    "pictures of a film": film("film"),
    "camera path": flight,
    "bookmarks": bookmarks,
    "preferences": lambda folder: save_preferences(folder, Preferences()),
    "queries": lambda folder: write_queries(folder / "q.json", QuerySet((SavedQuery("cup"),))),
}


@dataclass
class Writing:
    """A command that writes."""

    write: Write
    folder: Path

    def run(self) -> None:
        self.write(self.folder)


def with_fake_ffmpeg(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One that writes what it is given, and complains as it fails."""
    folder.mkdir()
    (folder / "ffmpeg").write_text(
        f"#!{sys.executable}\nimport sys\n"
        "with open(sys.argv[-1], 'wb') as file: file.write(sys.stdin.buffer.read())\n"
    )
    (folder / "ffmpeg").chmod(0o755)
    monkeypatch.setenv("PATH", f"{folder}{os.pathsep}{os.environ['PATH']}")


def contents(folder: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


# What is there counts as done, or must make sense.
ONLY_NEW = {"stage", "stage's array", "bookmarks", "pictures of a film"}


@pytest.mark.parametrize("name", WRITERS)
def test_a_full_disk_is_one_line(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every file is cut off at its beginning, and at its last byte."""
    with_fake_ffmpeg(tmp_path / "bin", monkeypatch)
    write, folder = WRITERS[name], tmp_path / "out"
    write(tmp_path / "whole")
    whole = contents(tmp_path / "whole")
    before = {} if name in ONLY_NEW else dict.fromkeys(whole, EARLIER)
    for size in sorted({0, *(len(content) - 1 for content in whole.values())}):
        shutil.rmtree(folder, ignore_errors=True)
        for path in whole:
            (folder / path).parent.mkdir(parents=True, exist_ok=True)
        for path, content in before.items():
            (folder / path).write_bytes(content)
        with files_of_at_most(size):
            code = main("langsplat", lambda: Writing(write, folder))
        (line,) = capsys.readouterr().err.splitlines()
        assert code == 2
        assert "File too large" in line or "ffmpeg failed" in line
        assert any(Path(path).name in line for path in whole), line
        after = contents(folder)
        assert before.keys() <= after.keys() < whole.keys() | before.keys() | {"nothing else"}
        for path, content in after.items():
            assert content == before.get(path) or len(content) == len(whole[path])


def test_a_scene_is_kept_whole_when_its_sidecar_finds_no_room(tmp_path: Path) -> None:
    save_scene(tmp_path / "s.ply", SCENE)
    before = contents(tmp_path)
    other = Scene(random_gaussians(40, 2, sh_degree=1), random_field(40, seed=3), SCENE.cameras)
    for size in range(0, max(map(len, before.values())), 500):
        with files_of_at_most(size), pytest.raises(OSError, match=r"No such|too large") as caught:
            save_scene(tmp_path / "s.ply", other)
        assert Path(caught.value.filename).name in before
        assert contents(tmp_path) == before


def test_other_faults_of_a_writer_stay_what_they_are(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="of the writer"), atomic_path(tmp_path / "a"):
        raise ValueError("of the writer")
    with pytest.raises(InputError, match="ours"), files_of_at_most(0), atomic_path(tmp_path / "a"):
        raise InputError("ours")
    assert not list(tmp_path.iterdir())
