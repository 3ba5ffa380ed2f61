"""The law of a full disk, for any function that writes: exit code 2, one line, and what was there stays."""

import gc
import os
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest

from langsplat_core.cli.run import main
from tests.support.processes import files_of_at_most, small_disk

Write = Callable[[Path], object]  # gets a folder of its own
Captured = pytest.CaptureFixture[str]
PAGE = 4096  # bytes that a small file system gives out at a time


@dataclass
class _Command:
    """A command that writes."""

    write: Write
    folder: Path

    def run(self) -> None:
        self.write(self.folder)


def contents(folder: Path) -> dict[str, bytes]:
    """Return what lies in a folder, file by file."""
    found = (path for path in sorted(folder.rglob("*")) if path.is_file())
    return {str(path.relative_to(folder)): path.read_bytes() for path in found}


def check_full_disk(write: Write, tmp_path: Path, capsys: Captured, earlier: bytes | None) -> None:
    """Cut off every file at its beginning, and at its last byte; `earlier`: what was in the files before."""
    folder = tmp_path / "out"
    write(tmp_path / "whole")
    whole = contents(tmp_path / "whole")
    before = {} if earlier is None else dict.fromkeys(whole, earlier)
    for size in sorted({0, *(len(content) - 1 for content in whole.values())}):
        shutil.rmtree(folder, ignore_errors=True)
        for path in whole:
            (folder / path).parent.mkdir(parents=True, exist_ok=True)
        for path, content in before.items():
            (folder / path).write_bytes(content)
        with files_of_at_most(size):
            code = main("langsplat", lambda: _Command(write, folder))
        (line,) = capsys.readouterr().err.splitlines()
        assert code == 2
        assert "File too large" in line
        assert any(Path(path).name in line for path in whole), line
        after = contents(folder)
        assert before.keys() <= after.keys() < whole.keys() | before.keys() | {"nothing else"}
        for path, content in after.items():
            assert content == before.get(path) or len(content) == len(whole[path])


def check_small_disk(write: Write, tmp_path: Path, capsys: Captured) -> None:
    """Write to a file system of its own, filled by another file but for less than what is written, and for
    the last page of it. What is left may be more than a probe takes."""
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
            code = main("langsplat", lambda: _Command(write, disk / "out"))
            gc.collect()  # torch's own writer, which failed, keeps its file open
            (line,) = capsys.readouterr().err.splitlines()
            assert code == 2
            assert "No space left" in line
            for path, content in contents(disk / "out").items():
                assert len(content) == len(whole[path])
            filler.unlink()
            shutil.rmtree(disk / "out", ignore_errors=True)
        assert main("langsplat", lambda: _Command(write, disk / "out")) == 0
