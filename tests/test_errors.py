"""What a message may hold is decided in one place: one printable line."""

import pytest

from langsplat_core.errors import LINE_LIMIT, EncoderError, InputError, printable_line, quoted


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
    assert printable_line(text) == line
    assert str(InputError(text)) == line
    assert str(EncoderError(text)) == line


def test_a_long_line_keeps_its_ends() -> None:
    line = printable_line("begin " + "x" * 10_000 + " end", 100)
    assert len(line) == 100
    assert line.startswith("begin xxx")
    assert line.endswith("xxx end")
    assert len(str(InputError("y" * 10_000))) == LINE_LIMIT
    assert printable_line("z" * 100, 100) == "z" * 100


def test_a_quotation_is_short_with_its_escapes() -> None:
    assert quoted("red mug", 60) == "'red mug'"
    assert len(quoted("\x00" * 60, 60)) == 60
