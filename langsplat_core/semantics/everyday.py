"""Everyday phrases: what a codec's errors are judged on, beside a scene's own vectors, and what answers are
compared with (`query.chance`)."""

from collections.abc import Callable, Sequence
from typing import Protocol

import numpy as np

from langsplat_core.arrays import Array


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


class _TextEncoder(Protocol):
    def encode_texts(self, texts: list[str]) -> Array: ...

    def unknown_words(self, text: str) -> tuple[str, ...]: ...


def everyday_phrases(unknown_words: Callable[[str], Sequence[str]], seed: int = 0) -> list[str]:
    """Nouns, and as many as `MIXED` random pairs of an adjective and a noun; without words that the encoder
    was never taught."""
    nouns = [word for word in NOUNS if not unknown_words(word)]
    adjectives = [word for word in ADJECTIVES if not unknown_words(word)]
    if not nouns or not adjectives:
        return nouns
    generator = np.random.default_rng(seed)
    pairs = zip(generator.choice(adjectives, MIXED), generator.choice(nouns, MIXED), strict=True)
    return [*nouns, *sorted({f"{adjective} {noun}" for adjective, noun in pairs})]


def everyday_vectors(encoder: _TextEncoder) -> Array | None:
    """(V, D) float32 unit vectors of the everyday phrases, of float16 precision, as a scene keeps them; None
    for an encoder that was taught too few of them."""
    phrases = everyday_phrases(encoder.unknown_words)
    if len(phrases) < FEWEST:
        return None
    return encoder.encode_texts(phrases).astype(np.float16).astype(np.float32)
