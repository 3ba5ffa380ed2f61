"""The language of the demo encoder: its phrases, which of them fit a crop, and its tokenizer."""

from collections import Counter
from dataclasses import dataclass
from itertools import chain, pairwise
from pathlib import Path

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.lab.world.appearance.colours import COLOURS
from langsplat_core.lab.world.captions import (
    BULK,
    MATERIALS,
    Label,
    colour_phrases,
    material_part_phrases,
    material_phrases,
    material_whole_phrases,
    object_words,
    part_phrases,
    whole_phrases,
)
from langsplat_core.scene import CANONICAL_PHRASES

FUNCTION_WORDS = ("a", "an", "the", "of", "and", "with", "photo", "my", "on", "in", "some", "one")
PREFIXES = ("", "", "", "", "a", "the", "the", "a photo of a", "a photo of the", "my", "one", "some")
CONTEXT = 16  # tokens of the longest phrase, with start and end
START, END, WORD_END = "<|startoftext|>", "<|endoftext|>", "</w>"


KINDS = ("colour", "material", "object", "colour+object", "material+object", "part")


@dataclass(frozen=True, eq=False)
class PhraseBook:
    """All phrases of a training run and how each fits each distinct label."""

    phrases: tuple[str, ...]  # P; the four canonical phrases come first
    kinds: tuple[str, ...]  # (P) "canonical", one of KINDS
    labels: tuple[Label, ...]  # U distinct labels
    fits: Array  # (U, P) int8: 1 right, 0 wrong, -1 neither (left out of the loss)


def phrase_book(labels: list[Label]) -> PhraseBook:
    """The phrases for a set of labels, and every object in every colour beside them."""
    distinct = tuple(dict.fromkeys(labels))
    kinds = _kinds(distinct)
    phrases = tuple(kinds)
    column = {phrase: k for k, phrase in enumerate(phrases)}
    fits = np.stack([_row(label, column) for label in distinct])
    return PhraseBook(phrases, tuple(kinds.values()), distinct, fits)


def _kinds(labels: tuple[Label, ...]) -> dict[str, str]:
    """Every phrase and its kind, the canonical ones first; a phrase of several kinds has the first."""
    kinds: dict[str, str] = dict.fromkeys(CANONICAL_PHRASES, "canonical")
    for colour in COLOURS:
        kinds.update(dict.fromkeys(colour_phrases(colour), "colour"))
    for material in sorted({label.material for label in labels if label.material}):
        kinds.update(dict.fromkeys(material_phrases(material), "material"))
    for thing in sorted({label.thing for label in labels if label.thing}):
        kinds.update({name: kinds.get(name, "object") for name in whole_phrases(thing, "")})
        for colour in COLOURS:
            for name in whole_phrases(thing, colour):
                kinds.setdefault(name, "colour+object")
    wholes = [label for label in labels if label.level == 2]
    for name in chain.from_iterable(material_whole_phrases(label.thing, label.material) for label in wholes):
        kinds.setdefault(name, "material+object")
    for name in chain.from_iterable(label.names for label in labels):
        kinds.setdefault(name, "part")
    return kinds


def _row(label: Label, column: dict[str, int]) -> Array:
    """(P,) int8 of one label: 1 right, 0 wrong, -1 neither."""
    row = np.zeros(len(column), np.int8)

    def mark(phrases: list[str] | tuple[str, ...], value: int) -> None:
        row[[column[phrase] for phrase in phrases if phrase in column]] = value

    if label.thing and label.level < 2 and label.word in BULK:
        for colour in ("", label.colour, label.thing_colour):  # the body of a mug may pass for a mug
            mark(whole_phrases(label.thing, colour), -1)
    if label.level == 2:
        for bulk in BULK:
            mark(part_phrases(bulk, label.thing, label.colour, label.colour), -1)
    unknown = COLOURS if not label.colour else label.hues
    for hue in unknown:
        mark(colour_phrases(hue), -1)
        if not label.colour:
            mark([f"{hue} {name}" for name in (*object_words(label.thing), label.word)], -1)
    known = label.materials and "" not in label.materials
    for material in label.materials if known else MATERIALS:
        mark(material_phrases(material), -1)
        mark(material_whole_phrases(label.thing, material), -1)
        mark(material_part_phrases(label.word, label.thing, material), -1)
    mark(label.names, 1)
    mark(colour_phrases(label.colour), 1)
    mark(material_phrases(label.material), 1)
    if label.level == -1 and not label.colour:
        mark(CANONICAL_PHRASES, 1)
    return row


def vocabulary(book: PhraseBook) -> list[str]:
    """All words of the phrases, and the function words, in alphabetical order."""
    return sorted({word for phrase in book.phrases for word in phrase.split()} | set(FUNCTION_WORDS))


def write_tokenizer(words: list[str], folder: Path) -> None:
    """A CLIP tokenizer (byte-pair encoding) whose merges make one token of every word, and the word list.

    Letters are tokens too, so any other word is spelled out rather than refused. The same words always
    give the same token numbers, so a resumed training finds its embeddings where they were.
    """
    from transformers import CLIPTokenizerFast

    letters = [chr(c) for c in range(ord("a"), ord("z") + 1)]
    merges = word_merges(words)
    tokens = [START, END, *letters, *(letter + WORD_END for letter in letters)]
    tokens += [left + right for left, right in merges]
    vocab = {token: number for number, token in enumerate(dict.fromkeys(tokens))}
    tokenizer = CLIPTokenizerFast(vocab=vocab, merges=merges, model_max_length=CONTEXT)
    folder.mkdir(parents=True, exist_ok=True)
    tokenizer.save_pretrained(folder)
    (folder / "vocabulary.txt").write_text("\n".join(words) + "\n", encoding="utf-8")


def word_merges(words: list[str]) -> list[tuple[str, str]]:
    """Byte-pair merges, in order, after which every word is one symbol (Sennrich et al. 2016).

    The commonest pair is merged first, the alphabet decides between equals. Words are of letters a-z.
    """
    spelled = [[*word[:-1], word[-1] + WORD_END] for word in words]
    merges: list[tuple[str, str]] = []
    while any(len(symbols) > 1 for symbols in spelled):
        pairs = Counter(pair for symbols in spelled for pair in pairwise(symbols))
        best = min(pairs, key=lambda pair: (-pairs[pair], pair))
        merges.append(best)
        spelled = [_merged(symbols, best) for symbols in spelled]
    return merges


def _merged(symbols: list[str], pair: tuple[str, str]) -> list[str]:
    """`symbols` with every occurrence of `pair`, from the left, made one symbol."""
    result: list[str] = []
    for symbol in symbols:
        if result and (result[-1], symbol) == pair:
            result[-1] += symbol
        else:
            result.append(symbol)
    return result
