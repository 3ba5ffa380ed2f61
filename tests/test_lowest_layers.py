"""What every layer shares: numbers, the one printable line of a message, and progress as a value, in lines
and in words."""

from contextlib import suppress

import numpy as np
import pytest

from langsplat_core import errors
from langsplat_core.arrays import psnr
from langsplat_core.errors import EncoderError, InputError, printable_line, quoted
from langsplat_core.progress import (
    LineProgress,
    Progress,
    Report,
    TerminalProgress,
)


def test_psnr() -> None:
    a = np.zeros((4, 4, 3), np.float32)
    assert psnr(a + np.float32(0.1), a) == pytest.approx(20, abs=1e-5)
    assert psnr(a, a) == 100
    assert psnr(a.astype(np.float16) + 1, a) == pytest.approx(0)


# Messages.


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("one\n  two\r\n\tthree", "one two three"),
        ("a\x1b[2Jb\x00c\x7f", r"a\x1b[2Jb\x00c\x7f"),
        ("\udcff surrogate", r"\udcff surrogate"),
        ("right\u202eleft", r"right\u202eleft"),
        ("Tür \u2028 é 日本", "Tür é 日本"),
        ("", ""),
    ],
)
def test_one_printable_line(text: str, line: str) -> None:
    kinds = InputError, errors.FormatError, errors.BackendError, EncoderError
    assert {printable_line(text), *(str(kind(text)) for kind in kinds)} == {line}


def test_a_long_line_keeps_its_ends() -> None:
    line = printable_line("begin " + "x" * 10_000 + " end", 100)
    assert len(line) == 100
    assert line.startswith("begin xxx")
    assert line.endswith("xxx end")
    assert len(str(InputError("y" * 10_000))) == errors.LINE_LIMIT
    assert printable_line("z" * 100, 100) == "z" * 100
    assert len(quoted("\x00" * 60, 60)) == 60


# Progress.


def test_progress_as_lines_for_other_programs(capsys):
    with LineProgress() as progress:
        progress("a\n", 0.25, "one", loss=0.25)
        progress("a\n", 0.2501, "one", loss=0.250001)
        progress("b", 7.0)
    reports = [Report.from_json(line) for line in capsys.readouterr().err.splitlines()]
    assert reports == [Report("a\n", 0.25, "one", {"loss": 0.25}), Report("b", 1.0)]
    assert reports[0].text == "a\n: one, loss 0.2500"
    assert Report("a", 0.5, "b", {"psnr": 20.06}).text == "a: b, PSNR 20.1 dB"
    for line in ("words", '{"stage": 3}', '"text"', "[1]", '{"stage": "a", "fraction": 0, "metrics": 1}'):
        with pytest.raises(ValueError):
            Report.from_json(line)


@pytest.mark.parametrize("stopped", [False, True])
def test_bars_of_finished_stages_are_full(stopped: bool, capsys: pytest.CaptureFixture[str]) -> None:
    """A stage may end before its last report; one that was stopped did not end."""
    with suppress(KeyboardInterrupt), TerminalProgress() as report:
        for stage in ("matching", "locating", "locating"):
            report(stage, 0.3)
        if stopped:
            raise KeyboardInterrupt
    shares = [line.split()[-3] for line in capsys.readouterr().err.splitlines() if "%" in line]
    assert shares == (["100%", "30%"] if stopped else ["100%"] * 2)


def test_progress_of_a_part_stays_within_its_share():
    reports: list[Report] = []
    whole = Progress(reports.append)
    whole.part(1, 4)("inner", 0.5, "b", loss=1.0)
    whole.part(3, 4, "outer", "c")("inner", 1.0)
    assert reports == [Report("inner", 0.375, "b", {"loss": 1.0}), Report("outer", 1.0, "c")]
