"""Vocabularies: the bundled lists, and other people's files with everything that can be wrong in them."""

import re
from importlib.resources import files
from pathlib import Path

import pytest

from langsplat_core.errors import InputError
from langsplat_core.semantics.vocabulary import BUNDLED, LONGEST, bundled_vocabulary, read_vocabulary


def entries(name: str) -> list[str]:
    """The lines of a bundled file that are phrases, as they stand there."""
    text = (Path(str(files("langsplat_assets"))) / "vocabulary" / f"{name}.txt").read_text(encoding="utf-8")
    return [line for line in text.splitlines() if line and not line.startswith("#")]


def test_the_bundled_words_are_many_and_each_is_there_once():
    things, parts = entries("things"), entries("parts")
    assert len(things) + len(parts) >= 2000
    assert len({*things, *parts}) == len(things) + len(parts)
    assert {"mug", "teddy bear", "table"} <= set(things)
    assert {"handle", "chair leg"} <= set(parts)


@pytest.mark.parametrize("name", BUNDLED)
def test_bundled_lists_are_tidy(name):
    lines = entries(name)
    assert len(set(lines)) == len(lines)
    assert [line for line in lines if line != " ".join(line.lower().split())] == []
    assert bundled_vocabulary(name) == tuple(lines)


def test_vocabulary_files_are_read_leniently(tmp_path):
    """A byte order mark, lines ended as on Windows, capitals, spaces, doubles, comments, other scripts."""
    path = tmp_path / "mine.txt"
    path.write_bytes("\ufeffRed  Mug\r\n# kitchen\r\n\r\n  cup \r\nred mug\r\nтарелка\r\n".encode())
    assert read_vocabulary(path) == ("red mug", "cup", "тарелка")


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        (b"cup\n!!!\n", "line 2: '!!!' has no letter or digit"),
        (b"cup\nmug\n\xff\xfe\n", "line 3: is not UTF-8 text"),
        (b"c\x00p\n", "line 1: holds control characters"),
        (b"cup\n" + b"x" * (LONGEST + 1), f"line 2: {LONGEST + 1} characters"),
        (b"", "is empty"),
        (b"# nothing\n\n", "is empty"),
    ],
)
def test_broken_vocabularies_are_named_by_file_and_line(tmp_path, content, problem):
    path = tmp_path / "mine.txt"
    path.write_bytes(content)
    with pytest.raises(InputError, match=re.escape(str(path)) + ".*" + re.escape(problem)):
        read_vocabulary(path)


def test_a_missing_file_and_a_folder_cannot_be_read(tmp_path):
    for path in (tmp_path / "none.txt", tmp_path):
        with pytest.raises(InputError, match="cannot be read"):
            read_vocabulary(path)
