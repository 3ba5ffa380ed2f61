"""Reports of benchmarks on a full disk: one line, and what was there stays."""

from pathlib import Path

from langsplat_core.extensions.benchmarks.commands import write_report
from tests.support.writing import Captured, check_full_disk, check_small_disk


def write(folder: Path) -> None:
    write_report(folder, "r", "text", list(range(999)))


def test_a_full_disk_is_one_line(tmp_path: Path, capsys: Captured) -> None:
    check_full_disk(write, tmp_path, capsys, b"what was there before")


def test_a_small_disk_that_fills_up_is_a_line(tmp_path: Path, capsys: Captured) -> None:
    check_small_disk(write, tmp_path, capsys)
