"""Vocabularies: plain lists of phrases that a scene can be described with."""

from collections.abc import Callable, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Literal, Protocol, get_args

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.errors import InputError, quoted
from langsplat_core.scene.language import phrase_key

Bundled = Literal["things", "parts", "colours", "materials"]
BUNDLED: tuple[Bundled, ...] = get_args(Bundled)
LONGEST = 80  # characters of a phrase: CLIP reads 77 tokens, and a whole paragraph is no word


def bundled_vocabulary(name: Bundled) -> tuple[str, ...]:
    """Return the phrases of a bundled list: everyday things, parts of things, colours, materials."""
    return read_vocabulary(Path(str(files("langsplat_assets") / "vocabulary" / f"{name}.txt")))


def read_vocabulary(path: Path) -> tuple[str, ...]:
    """Return the phrases of a UTF-8 text file, one a line, in lower case, each once, in the file's order.

    Empty lines and lines that begin with # do not count. Raises InputError for a file that cannot be read,
    that has no phrase, or with a line that is none (no letter or digit, too long, no text), which is named.
    """
    try:
        lines = path.read_bytes().removeprefix(b"\xef\xbb\xbf").splitlines()
    except OSError as error:
        raise InputError(f"{path}: the vocabulary cannot be read ({error.strerror or error})") from None
    phrases: dict[str, None] = {}
    for number, line in enumerate(lines, 1):
        text = " ".join(line.decode(errors="replace").split())
        if not text or text.startswith("#"):
            continue
        phrase = phrase_key(text)
        plain = text.isprintable() and "\ufffd" not in text  # which stands for bytes that are not UTF-8
        if not (plain and any(map(str.isalnum, phrase)) and len(phrase) <= LONGEST):
            raise InputError(
                f"{path}, line {number}: {quoted(text, 30)} is no phrase; write plain text in UTF-8, one "
                f"phrase of at most {LONGEST} letters a line, or begin with # what is none"
            )
        phrases[phrase] = None
    if not phrases:
        raise InputError(f"{path}: the vocabulary is empty; write one phrase per line, such as 'cup'")
    return tuple(phrases)


# Everyday phrases: what a codec's errors are judged on, beside a scene's own vectors, and what answers are
# compared with (`query.answers`).


def _words(text: str) -> tuple[str, ...]:
    return tuple(text.split())


NOUNS = _words(
    "apple bag ball banana basket bed bench bicycle bird blanket board boat book bookshelf bottle bowl "
    "box bread brick broom brush bucket building bush cable cake camera candle car carpet cat ceiling "
    "chair clock cloth clothes coat coin computer cup curtain cushion desk dish dog doll door drawer drum "
    "duck ear egg engine eye face fence finger fire fish flag floor flower fork frame fruit glass glasses "
    "glove grass guitar hair hammer hand handle hat head helmet horse house jacket jar kettle key "
    "keyboard knife knob ladder lamp laptop leaf leather leg lid lock magazine man map mat metal mirror "
    "mountain mouse mug nail neck nose notebook orange oven painting pan paper pen pencil person phone "
    "photo piano picture pillow pipe plant plastic plate pocket pot printer rail road robot rock roof "
    "rope rug ruler scarf scissors screen shelf shoe shirt sign sink skirt sky sofa spoon stairs statue "
    "stone stool stove string switch table tail tap tape tea television tile toaster towel toy train tree "
    "truck umbrella vase wall watch water wheel window wing wire wood"
)
ADJECTIVES = _words(
    "red orange yellow green blue purple pink brown black white grey small large old new round long "
    "striped wooden metal plastic shiny dark soft broken open"
)
MIXED = 96  # phrases of two words
FEWEST = 48  # phrases from which they tell what fits by chance


class TextEncoder(Protocol):
    """The text half of a CLIP model."""

    def encode_texts(self, texts: list[str]) -> Array:
        """(M, D) float32 unit vectors."""

    def unknown_words(self, text: str) -> tuple[str, ...]:
        """Words of `text` that the encoder was never taught; empty if it cannot tell."""

    def near_words(self, word: str) -> tuple[str, ...]:
        """Words it was taught that are written like an unknown one, the nearest first."""


def everyday_phrases(unknown_words: Callable[[str], Sequence[str]]) -> list[str]:
    """Nouns and `MIXED` random pairs of adjective and noun, always the same, without unknown words."""
    nouns = [word for word in NOUNS if not unknown_words(word)]
    adjectives = [word for word in ADJECTIVES if not unknown_words(word)]
    if not nouns or not adjectives:
        return nouns
    generator = np.random.default_rng(0)
    pairs = zip(generator.choice(adjectives, MIXED), generator.choice(nouns, MIXED), strict=True)
    return [*nouns, *sorted({f"{adjective} {noun}" for adjective, noun in pairs})]


def everyday_vectors(encoder: TextEncoder) -> Array | None:
    """(V, D) float32 unit vectors of the everyday phrases, of float16 precision; None if it knows too few."""
    phrases = everyday_phrases(encoder.unknown_words)
    if len(phrases) < FEWEST:
        return None
    return encoder.encode_texts(phrases).astype(np.float16).astype(np.float32)
