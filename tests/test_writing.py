"""Unusable names and places are refused before work begins; a full disk is a line, what was there stays."""

import errno
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from threading import Barrier

import numpy as np
import pytest

from langsplat_core.errors import InputError
from langsplat_core.extensions.checkpoints.langsplat_files import write_checkpoint
from langsplat_core.io import files
from langsplat_core.io.cameras import write_cameras
from langsplat_core.io.files import atomic_path, check_output_file, check_output_folder
from langsplat_core.io.hostile import write_npy
from langsplat_core.io.ply import write_ply
from langsplat_core.io.scenes import load_scene, save_scene, writable_suffixes
from langsplat_core.io.sidecar import SUFFIX, write_language
from langsplat_core.pipeline.stages import kept
from langsplat_core.scene import Scene
from langsplat_core.semantics.features import FeatureStore, ImageFeatures
from langsplat_core.training.radiance.state import save_checkpoint
from langsplat_viewer.output import save_png, write_film
from langsplat_viewer.projects import (
    Bookmark,
    Project,
    load_preferences,
    save_preferences,
    write_flight,
    write_project,
)
from langsplat_viewer.session import Preferences, Session
from tests.support.file_samples import random_field
from tests.support.processes import (
    Captured,
    Write,
    check_full_disk,
    contents,
    files_of_at_most,
    killed_everywhere,
    python,
    surroundings,
)
from tests.support.scenes import random_camera, random_gaussians
from tests.support.windowless import flight as some_flight

CHECKS = [check_output_file, check_output_folder]
Check = Callable[[Path], None]


def refusal(check: Check, path: Path) -> str:
    """Return the one line that a path is refused with."""
    with pytest.raises(InputError) as caught:
        check(path)
    message = str(caught.value)
    assert len(message) < 300
    return message


LONG = ["a" * 256, "é" * 256, "there/" + "b" * 256 + "/c", "d" * 300 + "/e.ply", "/".join(["x" * 200] * 30)]
NO_TEXT = ["caf\udce9.ply", "a\0b"]
SYSTEM = ["/proc/x.ply", "/proc/self/fd/x", "/dev/x.ply", "/dev/a/b/x", "/sys/x.ply"]


@pytest.mark.parametrize("check", CHECKS)
@pytest.mark.parametrize("name", [*LONG, *NO_TEXT, *SYSTEM])
def test_unusable_names_are_refused(check: Check, name: str, tmp_path: Path) -> None:
    refusal(check, tmp_path / name)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("check", CHECKS)
def test_names_beyond_the_locale_are_refused(check, tmp_path, monkeypatch):
    monkeypatch.setattr(os, "fsencode", lambda path: str(path).encode("latin5"))
    assert "language settings" in refusal(check, tmp_path / "日本語.ply")
    check(tmp_path / "é.ply")


def test_folders_and_files_are_told_apart(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    os.mkfifo(tmp_path / "pipe")
    assert "is a folder" in refusal(check_output_file, tmp_path)
    assert "is a file" in refusal(check_output_folder, tmp_path / "file")
    for check in CHECKS:
        assert "is a file" in refusal(check, tmp_path / "file" / "under" / "x.ply")
    refusal(check_output_file, tmp_path / "pipe")
    assert "is a folder" in refusal(check_output_file, Path("/"))  # which nothing lies above


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
    (tmp_path / "link").symlink_to(closed / "x.ply")
    code = (
        "import sys\nfrom pathlib import Path\nfrom langsplat_core.io.files import *\n"
        "from langsplat_core.errors import InputError\n"
        "for check in (check_output_file, check_output_folder):\n"
        "    for path in sys.argv[1:]:\n"
        "        try: check(Path(path))\n"
        "        except InputError as error: print(error)\n"
    )
    done = python("-c", code, closed / "new" / "x.ply", tmp_path / "link", bound=True)
    assert done.stdout.count("nothing can be written into") == 4
    assert done.stdout.count("Permission denied") == 4


@pytest.mark.parametrize("name", ["a" * 251 + ".ply", "é" * 125 + ".ply", "a." + "b" * 253, "." + "c" * 254])
def test_the_longest_names_are_written(name: str, tmp_path: Path) -> None:
    with atomic_path(tmp_path / name) as temporary:
        temporary.write_text("whole")
        assert len(Path(name).suffix) not in range(1, 65) or temporary.suffix == Path(name).suffix
    assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [(name, "whole")]


# A disk that is full, for every kind of file that is written: one line, and what was there stays.

GAUSSIANS = random_gaussians(40, 1, sh_degree=1)
FIELD = random_field(40)
SCENE = Scene(GAUSSIANS, FIELD, (replace(random_camera(), name="a"),))
EARLIER = b"what was there before"


def film(name: str) -> Write:
    def write(folder: Path) -> None:
        noise = np.random.default_rng(0)
        write_film(folder / name, 3, 4.0, lambda _: noise.integers(0, 255, (24, 32, 3), dtype=np.uint8))

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


def project(folder: Path) -> None:
    view = Bookmark("view", some_flight().keyframes[0].pose, 1.0)
    content = Project(str(folder / "s.ply"), len(GAUSSIANS), view, Session())
    write_project(folder / "p.langsplat", content, lambda: folder / "p-other.langsplat")


def stage(folder: Path) -> None:
    noise = {"a": np.random.default_rng(0).normal(size=999)}
    kept(folder / "codec.npz", lambda: noise)


WRITERS: dict[str, Write] = {
    **{
        f"scene {end}": lambda folder, end=end: save_scene(folder / f"s{end}", SCENE)
        for end in writable_suffixes()
    },
    "Gaussians": lambda folder: write_ply(folder / "s.ply", GAUSSIANS),
    "sidecar": lambda folder: write_language(folder / "s.safetensors", FIELD, GAUSSIANS.means),
    "cameras": lambda folder: write_cameras(folder / "cameras.json", SCENE.cameras),
    "feature store": features,
    "checkpoint": checkpoint,
    "checkpoint of another method": lambda folder: write_checkpoint(
        folder / "c.pth", GAUSSIANS, np.ones((40, 3), np.float32)
    ),
    "stage": stage,
    "stage's array": lambda folder: write_npy(folder / "a.npy", np.ones(999)),
    "report of scores": lambda folder: files.write_json(folder / "r.json", list(range(999))),
    "picture": lambda folder: save_png(
        folder / "p.png", np.random.default_rng(0).integers(0, 255, (40, 40, 3), np.uint8)
    ),
    "film .mp4": film("film.mp4"),
    "pictures of a film": film("film"),
    "camera path": flight,
    "project": project,
    "preferences": lambda folder: save_preferences(folder, Preferences()),
}


# What is there counts as done, or must make sense.
ONLY_NEW = {"stage", "stage's array", "project", "pictures of a film"}


@pytest.mark.parametrize("name", WRITERS)
def test_a_full_disk_is_one_line(name: str, tmp_path: Path, capsys: Captured) -> None:
    check_full_disk(WRITERS[name], tmp_path, capsys, EARLIER if name not in ONLY_NEW else None)


@pytest.mark.long
@pytest.mark.skipif(os.name == "nt", reason="no signal 9")
@pytest.mark.parametrize("name", [name for name in WRITERS if ".usd" not in name])  # which read it back, long
def test_a_writer_killed_at_any_step_leaves_whole_files(name: str, tmp_path: Path) -> None:
    """Under their names is what was there or what was written, and nothing else that is not hidden."""
    write, folder, companions = WRITERS[name], tmp_path / "out", (".json", SUFFIX)
    write(tmp_path / "whole")
    whole = contents(tmp_path / "whole")
    before = {} if name in ONLY_NEW else dict.fromkeys(whole, EARLIER)

    def begin() -> None:
        shutil.rmtree(folder, ignore_errors=True)
        for path, content in before.items():
            (folder / path).parent.mkdir(parents=True, exist_ok=True)
            (folder / path).write_bytes(content)

    def work() -> int:
        write(folder)
        return 0

    killed = 0
    begin()
    for code in killed_everywhere(work, folder):
        after = contents(folder)
        seen = {path for path in after if not Path(path).name.startswith(".writing-")}
        gone = {path for path in before if name.startswith("scene") and path.endswith(companions)}
        assert before.keys() - gone <= seen <= whole.keys()
        for path in seen:
            assert after[path] == before.get(path) or len(after[path]) == len(whole[path]), path
        killed += code == -signal.SIGKILL
        if code < 0:
            begin()
    assert code == 0
    assert seen == whole.keys()
    assert killed > 2


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
            assert [f"extra_{phrase}" for phrase in last.language.phrasebook] == list(last.extras)
    assert len(list(tmp_path.iterdir())) == 3


def test_two_windows_keep_what_each_changed(tmp_path: Path) -> None:
    save_preferences(tmp_path, Preferences("light", 1.5), Preferences(ui_scale=1.5))
    save_preferences(tmp_path, Preferences("dark", 2.0), Preferences("dark", 1.5))
    assert load_preferences(tmp_path) == Preferences("light", 2.0)
    for new in "ab":
        save_preferences(tmp_path, Preferences(recent=(new, "old")), Preferences(recent=("old",)))
    assert load_preferences(tmp_path).recent == ("b", "a", "old")


@pytest.mark.parametrize("size", [3, 300_000])
def test_writing_keeps_links_mode_and_group(size: int, tmp_path: Path) -> None:
    (tmp_path / "shared").mkdir()
    file, link, other = tmp_path / "shared/a.json", tmp_path / "a.json", tmp_path / "b.json"
    file.write_bytes(b"before" * 100)
    file.chmod(0o660)
    group = next(iter({*os.getgroups(), os.getgid()} - {file.stat().st_gid}), file.stat().st_gid)
    os.chown(file, -1, group)
    link.symlink_to(Path("shared") / "a.json")
    for names in (1, 2):
        with atomic_path(link) as temporary:
            temporary.write_bytes(bytes(size + names))
        assert link.is_symlink()
        assert file.read_bytes() == bytes(size + names)
        about = file.stat()
        assert (about.st_mode & 0o777, about.st_gid, about.st_nlink) == (0o660, group, names)
        if names == 1:
            other.hardlink_to(file)
    assert other.read_bytes() == file.read_bytes()
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["a.json", "a.json", "b.json", "shared"]


def test_a_full_disk_leaves_a_file_of_several_names(tmp_path: Path) -> None:
    file = tmp_path / "a"
    file.write_bytes(b"before")
    (tmp_path / "b").hardlink_to(file)
    full = pytest.raises(OSError, match="large")
    with full as caught, ExitStack() as later, atomic_path(file) as temporary:
        temporary.write_bytes(bytes(9000))
        later.enter_context(files_of_at_most(5000))
    assert caught.value.filename == str(file)
    assert file.read_bytes() == b"before"


def test_temporary_names_are_in_no_message(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="Permission") as caught, atomic_path(tmp_path / "a") as temporary:
        raise PermissionError(errno.EACCES, "Permission denied", str(temporary))
    assert caught.value.filename == str(tmp_path / "a")
    (tmp_path / "file").write_text("")
    with pytest.raises(OSError, match=r"exists|directory") as caught, atomic_path(tmp_path / "file/a"):
        pass
    assert ".writing-" not in str(caught.value)


def test_other_errors_of_a_writer_are_raised(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="of the writer"), atomic_path(tmp_path / "a"):
        raise ValueError("of the writer")
    with pytest.raises(InputError, match="ours"), files_of_at_most(0), atomic_path(tmp_path / "a"):
        raise InputError("ours")
    with pytest.raises(OSError, match="no room") as caught, atomic_path(tmp_path / "a"):
        raise OSError(errno.ENOSPC, "no room", "b")  # of two that are written together
    assert caught.value.filename == "b"
    assert not list(tmp_path.iterdir())


@pytest.mark.long
def test_program_works_without_what_windows_lacks(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "tests.support.processes", "--as-on-windows", tmp_path]
    environment = surroundings("") | {"PYTHONUTF8": "0", "PYTHONIOENCODING": "cp1252"}
    done = subprocess.run(command, env=environment, capture_output=True, check=False)
    said = (done.stdout + done.stderr).decode("cp1252")
    assert done.returncode == 0, said[-4000:]
    assert "aux.ply: cannot be written (no name on Windows); choose another\n" in said
