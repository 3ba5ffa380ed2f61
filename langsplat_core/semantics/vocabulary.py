"""Vocabularies: plain lists of phrases that a scene can be described with."""

from importlib.resources import files
from pathlib import Path
from typing import Literal, get_args

from langsplat_core.errors import InputError
from langsplat_core.scene.phrases import phrase_key

Bundled = Literal["things", "parts", "colours", "materials"]
BUNDLED: tuple[Bundled, ...] = get_args(Bundled)
COMMENT = "#"
LONGEST = 80  # characters of a phrase: CLIP reads 77 tokens, and a whole paragraph is no word


def bundled_vocabulary(name: Bundled) -> tuple[str, ...]:
    """The phrases of a bundled list: everyday things, parts of things, colours, materials.

    Raises InputError where it is missing from the installation.
    """
    return read_vocabulary(Path(str(files("langsplat_assets") / "vocabulary" / f"{name}.txt")))


def read_vocabulary(path: Path) -> tuple[str, ...]:
    """The phrases of a UTF-8 text file, one a line, in lower case, each once, in the file's order.

    Empty lines and lines that begin with # do not count. Raises InputError for a file that cannot be read,
    that has no phrase, or with a line that is none (no letter or digit, too long, no text), which is named.
    """
    try:
        lines = path.read_bytes().removeprefix(b"\xef\xbb\xbf").splitlines()
    except OSError as error:
        raise InputError(f"{path}: the vocabulary cannot be read ({error.strerror or error})") from None
    phrases: dict[str, None] = {}
    for number, line in enumerate(lines, 1):
        phrase = _phrase(line, f"{path}, line {number}")
        if phrase:
            phrases[phrase] = None
    if not phrases:
        raise InputError(f"{path}: the vocabulary is empty; write one phrase per line, such as 'cup'")
    return tuple(phrases)


def _phrase(line: bytes, where: str) -> str:
    """The phrase of a line, "" where it has none; InputError that begins with `where` for a bad line."""
    try:
        text = line.decode("utf-8").strip()
    except UnicodeDecodeError:
        raise InputError(f"{where}: is not UTF-8 text; save the list as plain text in UTF-8") from None
    if not text or text.startswith(COMMENT):
        return ""
    if not " ".join(text.split()).isprintable():
        raise InputError(f"{where}: holds control characters; a vocabulary is plain text, a phrase per line")
    phrase = phrase_key(text)
    if not any(character.isalnum() for character in phrase):
        raise InputError(f"{where}: {text[:20]!r} has no letter or digit; write a phrase, or begin with #")
    if len(phrase) > LONGEST:
        raise InputError(
            f"{where}: {len(phrase)} characters, a phrase has at most {LONGEST}; write one phrase per line"
        )
    return phrase
