"""Names and places that cannot be written to are told of beforehand; temporary names always fit."""

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from langsplat_core.errors import InputError
from langsplat_core.io.files import atomic_path, check_output_file, check_output_folder, name_max, shown
from tests.support.processes import bound_by_permissions

CHECKS = [check_output_file, check_output_folder]
Check = Callable[[Path], None]


def refusal(check: Check, path: Path) -> str:
    """The one line that a path is refused with."""
    before = sorted(path.anchor)
    with pytest.raises(InputError) as caught:
        check(path)
    message = str(caught.value)
    assert sorted(path.anchor) == before
    assert message.isprintable()
    assert len(message) < 300
    return message


@pytest.mark.parametrize("check", CHECKS)
@pytest.mark.parametrize("name", ["a" * 256, "é" * 128, "there/" + "b" * 256 + "/c", "d" * 300 + "/e.ply"])
def test_names_longer_than_the_file_system_takes(check: Check, name: str, tmp_path: Path) -> None:
    assert "this file system takes 255" in refusal(check, tmp_path / name)
    assert "choose a shorter one" in refusal(check, tmp_path / "/".join(["x" * 200] * 30))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("check", CHECKS)
def test_names_that_no_terminal_could_show(check: Check, tmp_path: Path) -> None:
    assert "not UTF-8" in refusal(check, tmp_path / "caf\udce9.ply")
    assert "zero byte" in refusal(check, tmp_path / "a\0b")


@pytest.mark.parametrize("check", CHECKS)
def test_names_that_the_language_settings_cannot_hold(
    check: Check, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "fsencode", lambda path: str(path).encode("latin5"))
    assert "language settings" in refusal(check, tmp_path / "日本語.ply")
    check(tmp_path / "é.ply")


@pytest.mark.parametrize("check", CHECKS)
@pytest.mark.parametrize(
    "place", ["/proc/x.ply", "/proc/self/fd/x", "/dev/x.ply", "/dev/a/b/x", "/sys/x.ply"]
)
def test_the_systems_own_folders(check: Check, place: str) -> None:
    assert "folder of the system's own" in refusal(check, Path(place))


def test_a_folder_is_no_file_and_a_file_no_folder(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    assert "is a folder; name a file in it" in refusal(check_output_file, tmp_path)
    assert "is a file; name a folder" in refusal(check_output_folder, tmp_path / "file")
    for check in CHECKS:
        assert "is a file, not a folder" in refusal(check, tmp_path / "file" / "under" / "x.ply")
    os.mkfifo(tmp_path / "pipe")
    assert "no ordinary file" in refusal(check_output_file, tmp_path / "pipe")


def test_what_can_be_written_passes_and_leaves_nothing(tmp_path: Path) -> None:
    names = ["a.ply", "a/b/c.ply", "a" * 255]
    for name in names + ["日本語 (1).ply"] * sys.getfilesystemencoding().startswith("utf"):
        for check in CHECKS:
            check(tmp_path / name)
    (tmp_path / "old.ply").write_text("kept")
    check_output_file(tmp_path / "old.ply")
    assert [path.read_text() for path in tmp_path.iterdir()] == ["kept"]


def test_where_one_may_not_write(tmp_path: Path) -> None:
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
    assert len(name.encode()) <= name_max(tmp_path)
    with atomic_path(tmp_path / name) as temporary:
        temporary.write_text("whole")
        assert len(Path(name).suffix) not in range(1, 65) or temporary.suffix == Path(name).suffix
    assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [(name, "whole")]


def test_paths_are_shown_short_and_printable() -> None:
    assert shown("a/b.ply") == "a/b.ply"
    assert shown("\udcff") == "\\udcff"
    assert len(shown("x" * 500)) == 100
