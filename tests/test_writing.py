"""Names and places that cannot be written to are told of beforehand; a full disk is one line, for every kind
of file, and what was there stays."""

import gc
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from threading import Barrier

import numpy as np
import pytest

from langsplat_core.cli.run import main
from langsplat_core.errors import InputError
from langsplat_core.extensions.benchmarks.commands import write_report
from langsplat_core.extensions.checkpoints.langsplat_files import (
    write_autoencoder,
    write_checkpoint,
    write_features,
)
from langsplat_core.io import files
from langsplat_core.io.cameras import write_cameras
from langsplat_core.io.files import atomic_path, check_output_file, check_output_folder
from langsplat_core.io.ply import write_ply
from langsplat_core.io.scenes import load_scene, save_scene, writable_suffixes
from langsplat_core.io.shapes import write_points
from langsplat_core.io.sidecar import write_language
from langsplat_core.pipeline.stages import kept, kept_array
from langsplat_core.scene import Scene
from langsplat_core.semantics.store import FeatureStore, ImageFeatures
from langsplat_core.training.radiance.state import save_checkpoint
from langsplat_viewer.files.preferences import Preferences, save_preferences
from langsplat_viewer.files.projects import Bookmark, Shelf, write_flight, write_queries
from langsplat_viewer.output import Film, save_png, write_film
from langsplat_viewer.session import Query, Session
from tests.support.file_samples import random_codec, random_field
from tests.support.processes import bound_by_permissions, files_of_at_most, small_disk
from tests.support.scenes import random_camera, random_gaussians
from tests.support.windowless import flight as some_flight

CHECKS = [check_output_file, check_output_folder]
Check = Callable[[Path], None]


def refusal(check: Check, path: Path) -> str:
    """The one line that a path is refused with."""
    with pytest.raises(InputError) as caught:
        check(path)
    message = str(caught.value)
    assert len(message) < 300
    return message


@pytest.mark.parametrize("check", CHECKS)
@pytest.mark.parametrize("name", ["a" * 256, "é" * 128, "there/" + "b" * 256 + "/c", "d" * 300 + "/e.ply"])
def test_names_beyond_the_file_system_are_refused(check: Check, name: str, tmp_path: Path) -> None:
    assert "this file system takes 255" in refusal(check, tmp_path / name)
    assert "choose a shorter one" in refusal(check, tmp_path / "/".join(["x" * 200] * 30))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("check", CHECKS)
def test_names_that_are_not_text_are_refused(check: Check, tmp_path: Path) -> None:
    assert "not UTF-8" in refusal(check, tmp_path / "caf\udce9.ply")
    assert "zero byte" in refusal(check, tmp_path / "a\0b")


@pytest.mark.parametrize("check", CHECKS)
def test_names_beyond_the_locale_are_refused(
    check: Check, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "fsencode", lambda path: str(path).encode("latin5"))
    assert "language settings" in refusal(check, tmp_path / "日本語.ply")
    check(tmp_path / "é.ply")


@pytest.mark.parametrize("check", CHECKS)
@pytest.mark.parametrize(
    "place", ["/proc/x.ply", "/proc/self/fd/x", "/dev/x.ply", "/dev/a/b/x", "/sys/x.ply"]
)
def test_folders_of_the_system_are_refused(check: Check, place: str) -> None:
    assert "folder of the system's own" in refusal(check, Path(place))


def test_folders_and_files_are_told_apart(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    assert "is a folder; name a file in it" in refusal(check_output_file, tmp_path)
    assert "is a file; name a folder" in refusal(check_output_folder, tmp_path / "file")
    for check in CHECKS:
        assert "is a file, not a folder" in refusal(check, tmp_path / "file" / "under" / "x.ply")
    os.mkfifo(tmp_path / "pipe")
    assert "no ordinary file" in refusal(check_output_file, tmp_path / "pipe")


def test_checking_a_place_leaves_nothing_there(tmp_path: Path) -> None:
    names = ["a.ply", "a/b/c.ply", "a" * 255]
    for name in names + ["日本語 (1).ply"] * sys.getfilesystemencoding().startswith("utf"):
        for check in CHECKS:
            check(tmp_path / name)
    (tmp_path / "old.ply").write_text("kept")
    check_output_file(tmp_path / "old.ply")
    assert [path.read_text() for path in tmp_path.iterdir()] == ["kept"]


def test_folders_without_permission_are_refused(tmp_path: Path) -> None:
    closed = tmp_path / "closed"
    closed.mkdir(mode=0o555)
    code = (
        "import sys\nfrom pathlib import Path\nfrom langsplat_core.io.files import *\n"
        "from langsplat_core.errors import InputError\n"
        "for check in (check_output_file, check_output_folder):\n"
        "    try: check(Path(sys.argv[1]))\n"
        "    except InputError as error: print(error)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(closed / "new" / "x.ply")],
        capture_output=True,
        text=True,
        check=True,
        preexec_fn=bound_by_permissions(),
    )
    assert done.stdout.count("nothing can be written into") == 2
    assert done.stdout.count("Permission denied") == 2


@pytest.mark.parametrize("name", ["a" * 251 + ".ply", "é" * 125 + ".ply", "a." + "b" * 253, "." + "c" * 254])
def test_the_longest_names_are_written(name: str, tmp_path: Path) -> None:
    assert len(name.encode()) <= files.name_max(tmp_path)
    with atomic_path(tmp_path / name) as temporary:
        temporary.write_text("whole")
        assert len(Path(name).suffix) not in range(1, 65) or temporary.suffix == Path(name).suffix
    assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [(name, "whole")]


def test_paths_are_shown_short_and_printable() -> None:
    assert files.shown("a/b.ply") == "a/b.ply"
    assert files.shown("\udcff") == "\\udcff"
    assert len(files.shown("x" * 500)) == 100


# A disk that is full, for every kind of file that is written: one line, and what was there stays.

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


WRITERS: dict[str, Write] = {
    **{
        f"scene {end}": lambda folder, end=end: save_scene(folder / f"s{end}", SCENE)
        for end in writable_suffixes()
    },
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
    "report of scores": lambda folder: files.write_json(folder / "r.json", list(range(999))),
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
    "queries": lambda folder: write_queries(folder / "q.json", Session(queries=(Query("cup"),))),
}


@dataclass
class Writing:
    """A command that writes."""

    write: Write
    folder: Path

    def run(self) -> None:
        self.write(self.folder)


def contents(folder: Path) -> dict[str, bytes]:
    files = (path for path in sorted(folder.rglob("*")) if path.is_file())
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


# What is there counts as done, or must make sense.
ONLY_NEW = {"stage", "stage's array", "bookmarks", "pictures of a film"}


@pytest.mark.parametrize("name", WRITERS)
def test_a_full_disk_is_one_line(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Every file is cut off at its beginning, and at its last byte."""
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
        assert "File too large" in line
        assert any(Path(path).name in line for path in whole), line
        after = contents(folder)
        assert before.keys() <= after.keys() < whole.keys() | before.keys() | {"nothing else"}
        for path, content in after.items():
            assert content == before.get(path) or len(content) == len(whole[path])


def test_a_full_disk_keeps_the_old_scene_whole(tmp_path: Path) -> None:
    save_scene(tmp_path / "s.ply", SCENE)
    before = contents(tmp_path)
    other = Scene(random_gaussians(40, 2, sh_degree=1), random_field(40, seed=3), SCENE.cameras)
    for size in range(0, max(map(len, before.values())), 500):
        with files_of_at_most(size), pytest.raises(OSError, match=r"No such|too large") as caught:
            save_scene(tmp_path / "s.ply", other)
        assert Path(caught.value.filename).name in before
        assert contents(tmp_path) == before


def test_two_writers_of_one_scene_take_turns(tmp_path: Path) -> None:
    """Scenes of the same positions, so that no checksum would notice a sidecar of the other one."""
    fields = {name: random_field(40, phrases=(name,)) for name in ("red", "old")}
    none = np.zeros(40, np.float32)
    scenes = [replace(SCENE, language=fields[name], extras={f"extra_{name}": none}) for name in fields]
    together = Barrier(2)

    def write(scene: Scene) -> None:
        together.wait()
        save_scene(tmp_path / "s.ply", scene)

    with ThreadPoolExecutor(2) as pool:
        for _ in range(30):
            list(pool.map(write, scenes))
            last = load_scene(tmp_path / "s.ply")
            assert last.language is not None
            assert [f"extra_{phrase}" for phrase in last.language.phrasebook] == list(last.extras)
    assert len(list(tmp_path.iterdir())) == 3


def test_other_errors_of_a_writer_are_raised(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="of the writer"), atomic_path(tmp_path / "a"):
        raise ValueError("of the writer")
    with pytest.raises(InputError, match="ours"), files_of_at_most(0), atomic_path(tmp_path / "a"):
        raise InputError("ours")
    assert not list(tmp_path.iterdir())


PAGE = 4096  # bytes that such a file system gives out at a time
LARGER = Scene(random_gaussians(6_000, 3, sh_degree=3), random_field(6_000, seed=4), SCENE.cameras)
LARGE: dict[str, Write] = {
    "scene": lambda folder: save_scene(folder / "s.ply", LARGER),
    "sidecar": lambda folder: write_language(
        folder / "s.safetensors", random_field(40_000, seed=5), random_gaussians(40_000).means
    ),
    "their checkpoint": lambda folder: write_checkpoint(
        folder / "c.pth", LARGER.gaussians, np.ones((6_000, 3), np.float32)
    ),
    "their features": lambda folder: write_features(
        folder, "a", np.ones((300, 512), np.float32), np.zeros((4, 300, 400), np.int32)
    ),
}
FILLED: dict[str, Write] = {**WRITERS, **{f"large {name}": write for name, write in LARGE.items()}}


@pytest.mark.parametrize("name", FILLED)
def test_a_small_disk_that_fills_up_is_a_line(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A file system of its own, filled by another file but for less than what is written, and for the last
    page of it. What is left may be more than a probe takes."""
    write = FILLED[name]
    write(tmp_path / "whole")
    whole = contents(tmp_path / "whole")
    needed = sum(-(-len(content) // PAGE) for content in whole.values())
    with small_disk(tmp_path / "disk", (needed + 64) * PAGE) as disk:
        for share in (0.1, 0.5, 0.9, 1.0):
            free = int(share * needed) - (share == 1.0)
            filler = disk / "filler"
            with filler.open("wb") as file:
                room = os.statvfs(disk).f_bavail - free
                file.write(bytes(room * PAGE))
            code = main("langsplat", lambda: Writing(write, disk / "out"))
            gc.collect()  # torch's own writer, which failed, keeps its file open
            (line,) = capsys.readouterr().err.splitlines()
            assert code == 2
            assert "No space left" in line
            for path, content in contents(disk / "out").items():
                assert len(content) == len(whole[path])
            filler.unlink()
            shutil.rmtree(disk / "out", ignore_errors=True)
        assert main("langsplat", lambda: Writing(write, disk / "out")) == 0
