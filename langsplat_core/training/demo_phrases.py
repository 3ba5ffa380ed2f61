"""The language of the demo encoder: its phrases, which of them fit a crop, and its tokenizer."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.datasets.synthetic.captions import (
    BULK,
    Label,
    colour_phrases,
    object_words,
    part_phrases,
    whole_phrases,
)
from langsplat_core.datasets.synthetic.colours import COLOURS
from langsplat_core.scene import CANONICAL_PHRASES

FUNCTION_WORDS = ("a", "an", "the", "of", "and", "with", "photo", "my", "on", "in", "some", "one")
PREFIXES = ("", "", "", "", "a", "the", "the", "a photo of a", "a photo of the", "my", "one", "some")
CONTEXT = 16  # tokens of the longest phrase, with start and end
START, END = "<|startoftext|>", "<|endoftext|>"


@dataclass(frozen=True, eq=False)
class PhraseBook:
    """All phrases of a training run and how each fits each distinct label."""

    phrases: tuple[str, ...]  # P; the four canonical phrases come first
    kinds: tuple[str, ...]  # (P) "canonical", "colour", "object", "colour+object", "part"
    labels: tuple[Label, ...]  # U distinct labels
    fits: Array  # (U, P) int8: 1 right, 0 wrong, -1 neither (left out of the loss)


def phrase_book(labels: list[Label]) -> PhraseBook:
    """The phrases for a set of labels, and every object in every colour beside them."""
    distinct = tuple(dict.fromkeys(labels))
    kinds: dict[str, str] = dict.fromkeys(CANONICAL_PHRASES, "canonical")
    for colour in COLOURS:
        kinds.update(dict.fromkeys(colour_phrases(colour), "colour"))
    for thing in sorted({label.thing for label in distinct if label.thing}):
        kinds.update({name: kinds.get(name, "object") for name in whole_phrases(thing, "")})
        for colour in COLOURS:
            for name in whole_phrases(thing, colour):
                kinds.setdefault(name, "colour+object")
    for label in distinct:
        for name in label.names:
            kinds.setdefault(name, "part")
    phrases = tuple(kinds)
    column = {phrase: k for k, phrase in enumerate(phrases)}
    fits = np.stack([_row(label, column) for label in distinct])
    return PhraseBook(phrases, tuple(kinds.values()), distinct, fits)


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
    mark(label.names, 1)
    mark(colour_phrases(label.colour), 1)
    if label.level == -1 and not label.colour:
        mark(CANONICAL_PHRASES, 1)
    return row


def vocabulary(book: PhraseBook) -> list[str]:
    """All words of the phrases, and the function words, in alphabetical order."""
    return sorted({word for phrase in book.phrases for word in phrase.split()} | set(FUNCTION_WORDS))


def write_tokenizer(words: list[str], folder: Path) -> None:
    """A CLIP tokenizer (byte-pair encoding) whose merges make one token of every word, and the word list.

    Letters are tokens too, so any other word is spelled out rather than refused.
    """
    from tokenizers import Tokenizer, models, pre_tokenizers, trainers
    from transformers import CLIPTokenizerFast

    model = Tokenizer(models.BPE(end_of_word_suffix="</w>"))
    model.pre_tokenizer = pre_tokenizers.Whitespace()
    alphabet = [chr(c) for c in range(ord("a"), ord("z") + 1)]
    trainer = trainers.BpeTrainer(
        vocab_size=30 * len(words),
        min_frequency=1,
        special_tokens=[START, END],
        initial_alphabet=alphabet,
        end_of_word_suffix="</w>",
        show_progress=False,
    )
    model.train_from_iterator([*words, " ".join(alphabet)], trainer)
    import json

    learned = json.loads(model.to_str())["model"]
    merges = [tuple(pair) for pair in learned["merges"]]
    tokenizer = CLIPTokenizerFast(vocab=learned["vocab"], merges=merges, model_max_length=CONTEXT)
    tokenizer.save_pretrained(folder)
    (folder / "vocabulary.txt").write_text("\n".join(words) + "\n", encoding="utf-8")
