"""The program `langsplat` in this process: its exit code, and the one line of a refusal."""

import pytest

from langsplat_core.cli.app import parse
from langsplat_core.cli.run import main


def run(*words: object) -> int:
    """The exit code of `langsplat` with these words."""
    return main("langsplat", lambda: parse([str(word) for word in words]))


def refusal(capsys: pytest.CaptureFixture[str], *words: object) -> str:
    """The one line with which `langsplat` refuses these words; nothing is printed beside it."""
    capsys.readouterr()
    assert run(*words) == 2
    said = capsys.readouterr()
    assert said.out == ""
    (line,) = (line for line in said.err.splitlines() if line.startswith("langsplat"))
    return line
