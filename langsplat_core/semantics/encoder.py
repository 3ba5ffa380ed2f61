"""Image-text encoders as callers see them: checks of phrases and images, batches, unit vectors.

A family of models (`encoders`) brings two towers, each a few lines.
"""

import html
import json
import re
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from langsplat_core.arrays import Array, unit
from langsplat_core.errors import EncoderError, InputError, UnknownWordError
from langsplat_core.scene import Calibration, LanguageField, PlattScaling
from langsplat_core.semantics.weights import OPEN_CLIP_CONFIG, Weights, asking_errors

# Phrases as rows of token numbers of one length, by the tokenizer.json that lies beside the weights. The file
# is read as it is, by the `tokenizers` library: what transformers' own classes add around it (which side is
# padded, whether an end token is there) differs between its versions, and one needs SentencePiece.

FILE = "tokenizer.json"
STATED_IN = ("tokenizer_config.json", "special_tokens_map.json")  # which token pads, which one ends
# The library ends the process over a token of 300 000 bytes; the table of a normaliser may be as long.
_LONG = re.compile(rb'(?<!"precompiled_charsmap":)(?<!"precompiled_charsmap": )"[^"]{10000}')
UNUSUAL = "\u3042"  # where the token for what is not known is lacking, this cannot be read
USUAL = {"eos_token": ("</s>", "<eos>"), "pad_token": ("<pad>", "</s>")}


@dataclass(frozen=True, eq=False)
class Tokens:
    """A tokenizer that always fills its rows."""

    tokenizer: Any  # tokenizers.Tokenizer
    length: int  # tokens per phrase
    pad: int
    end: int  # put behind every phrase

    @property
    def is_unigram(self) -> bool:
        """True for SentencePiece's unigram kind, as SigLIP's is and SigLIP 2's is not."""
        return type(self.tokenizer.model).__name__ == "Unigram"

    def rows(self, texts: list[str]) -> Any:
        """Return the (B, length) int64 tensor of token numbers. Raises as `check_whole`."""
        import torch

        ids = torch.full((len(texts), self.length), self.pad)
        for row, found in enumerate(self.tokenizer.encode_batch(texts, add_special_tokens=False)):
            check_whole(texts[row], found.ids, self.length - 1, {self.end})
            ids[row, : len(found.ids) + 1] = torch.tensor([*found.ids, self.end])
        return ids


def load_tokens(weights: Weights, length: int) -> Tokens:
    """Read the folder's tokenizer; EncoderError where it is absent or lacks tokens that pad and end."""
    path = weights.folder / FILE
    if not path.is_file():
        raise EncoderError(f"{weights.id}: no {FILE} in this folder, which its phrases are read with")
    tokenizer = read_tokenizer(weights)
    pad = _number(weights, tokenizer, "pad_token")
    return Tokens(tokenizer, length, pad, _number(weights, tokenizer, "eos_token"))


def text_cleaner() -> Callable[[str], str]:
    """Return the cleaning that open_clip does before its tokenizer reads a text.

    Broken Unicode is mended, curly quotes and ligatures are made plain, names of HTML replaced, spaces made
    single. The function raises InputError where no letter and no digit is left.
    """
    import ftfy

    def clean(text: str) -> str:
        plain = " ".join(html.unescape(html.unescape(ftfy.fix_text(text))).split())
        if not any(map(str.isalnum, plain)):
            raise InputError(f"empty phrase {text!r}: type a word or a few, such as 'red mug'")
        return plain

    return clean


def check_whole(text: str, ids: Sequence[int], room: int, ends: Collection[int]) -> None:
    """Refuse a phrase of which a model would not see all.

    ids: its tokens without those that begin and end a phrase; room: how many the model reads; ends: tokens
    that end a phrase, which some tokenizers give for every mark that they cannot read. Raises InputError for
    a phrase that is too long, EncoderError for one that would end early.
    """
    if len(ids) > room:
        raise InputError(
            f"'{text[:40]} ...' is too long: {len(ids)} tokens; this encoder reads {room}, so use fewer words"
        )
    if not set(ends).isdisjoint(ids):
        raise EncoderError(f"{text[:80]!r} holds marks that this encoder cannot read; use plain words")


def read_tokenizer(weights: Weights) -> Any:
    """Return the folder's `tokenizers.Tokenizer`, which neither cuts nor pads.

    EncoderError for a damaged file.
    """
    from tokenizers import Tokenizer

    try:
        if _LONG.search((weights.folder / FILE).read_bytes()):
            raise ValueError("a token of more than 10000 bytes")
        tokenizer = Tokenizer.from_file(str(weights.folder / FILE))
        tokenizer.no_truncation()
        tokenizer.no_padding()
        tokenizer.encode(UNUSUAL, add_special_tokens=False)
        return tokenizer
    except Exception as error:  # the library raises no narrower class for a damaged file
        reason = (str(error).splitlines() or ["unreadable"])[0][:200]
        raise EncoderError(f"{weights.id}: {FILE} is no tokenizer ({reason})") from error


def _number(weights: Weights, tokenizer: Any, role: str) -> int:
    """Return the number of the token with a role: as the folder states it, else by its usual names."""
    stated = [_stated(weights, name, role) for name in STATED_IN]
    for token in (*stated, *USUAL[role]):
        number = None if token is None else tokenizer.token_to_id(token)
        if number is not None:
            return int(number)
    raise EncoderError(f"{weights.id}: its tokenizer has no {role}, such as {USUAL[role][0]}")


def _stated(weights: Weights, name: str, role: str) -> str | None:
    path = weights.folder / name
    try:
        token = json.loads(path.read_text(encoding="utf-8")).get(role)
    except (OSError, ValueError, AttributeError, RecursionError):
        return None
    content = token.get("content") if isinstance(token, dict) else token
    return content if isinstance(content, str) else None


OPEN_MODEL = "laion/CLIP-ViT-B-16-laion2B-s34B-b88K"
VOCABULARY = "vocabulary.txt"  # beside the weights: the only words the encoder was taught, one per line
READING = "reading.json"  # beside the weights, optional: `found` and `calibration` of `scene.LanguageField`
WORD = re.compile(r"[^\W_]+(?:'[^\W_]+)?")
EXAMPLES = 12  # known words to name where a phrase has an unknown one
SUGGESTIONS = 2  # known words offered for an unknown one
TEXT_BATCH = 64  # phrases per forward pass
Triple = tuple[float, float, float]
# Share of a model's logit scale that is the temperature of relevancy, the factor of a difference of cosines
# before the sigmoid. LERF and LangSplat take 10 for CLIP, whose training caps the scale at 100: a tenth. The
# larger the scale, the smaller the gaps between cosines of right and wrong pairs that training had to make,
# so a tenth of it gives the margins of two families like relevancies. It is a rule of proportion, not a
# calibration: verdicts need thresholds of their own.
SHARE_OF_SCALE = 0.1


class TextTower(Protocol):
    """The half of a model that reads phrases."""

    @property
    def dim(self) -> int:
        """Length D of the vectors."""

    @property
    def temperature(self) -> float:
        """Temperature of relevancy, see `SHARE_OF_SCALE`."""

    def encode(self, texts: list[str]) -> Array:
        """(B, D) float32 vectors, of any length, of B > 0 phrases.

        Raises InputError and EncoderError as `check_whole`: no part of a phrase is left out in silence.
        """


class ImageTower(Protocol):
    """The half of a model that sees images."""

    @property
    def image_size(self) -> int:
        """Side of the images it takes, px."""

    @property
    def statistics(self) -> tuple[Array, Array]:
        """(3,) mean and (3,) standard deviation that it expects to be taken out, of values in [0, 1]."""

    def encode(self, pixels: Any) -> Any:
        """(B, 3, S, S) float32 tensor, normalised -> (B, D) float tensor, of any length."""


@dataclass(frozen=True)
class Family:
    """An architecture: how its two halves are loaded."""

    text: Callable[[Weights], TextTower]
    images: Callable[[Weights], ImageTower]


class PhraseEncoder:
    """The text half of a model, in float32; it satisfies `vocabulary.TextEncoder`."""

    def __init__(self, weights: Weights, tower: TextTower) -> None:
        self.id = weights.id  # hub id or folder as it was asked for; "demo" for the bundled encoder
        self.tower = tower
        self.words = _vocabulary(weights.folder)
        self.found, self.calibration = _calibration(weights)  # as a scene stores them

    @property
    def dim(self) -> int:
        """Length D of the vectors."""
        return self.tower.dim

    @property
    def temperature(self) -> float:
        """Factor with which a margin of cosines, phrase minus nearest canonical phrase, becomes relevancy."""
        return self.tower.temperature

    def unknown_words(self, text: str) -> tuple[str, ...]:
        """Words of `text` that the encoder was never taught; empty when it was taught open vocabulary."""
        if self.words is None:
            return ()
        return tuple(word for word in WORD.findall(text.lower()) if self._taught(word) is None)

    def near_words(self, word: str) -> tuple[str, ...]:
        """Words it was taught that are written like an unknown one, the nearest first."""
        return tuple(get_close_matches(word.lower(), sorted(self.words or ()), n=SUGGESTIONS))

    def _taught(self, word: str) -> str | None:
        """Return the word in which the encoder was taught `word`: itself, or of a possessive its owner."""
        assert self.words is not None
        owner = word.partition("'")[0]
        return next((form for form in (word, owner) if form in self.words), None)

    def encode_texts(self, texts: Sequence[str]) -> Array:
        """(M, D) float32 unit vectors of M phrases, raw: no prompt template, as in LangSplat.

        An encoder of a closed vocabulary is given its words and nothing else: any mark that its tokenizer
        lacks might end the phrase. Raises InputError for a phrase without a letter or digit or with more
        tokens than the model reads, UnknownWordError for words it was not taught, EncoderError for other
        marks that it cannot read.
        """
        for text in texts:
            self._check(text)
        said = [self._said(text) for text in texts]
        starts = range(0, len(texts), TEXT_BATCH)
        parts = [unit(self.tower.encode(said[i : i + TEXT_BATCH])) for i in starts]
        return np.concatenate(parts) if parts else np.zeros((0, self.dim), np.float32)

    def _check(self, text: str) -> None:
        if not WORD.search(text):
            raise InputError(f"empty phrase {text!r}: type a word or a few, such as 'red mug'")
        unknown = self.unknown_words(text)
        if unknown:
            words = sorted(self.words or ())
            examples = ", ".join(words[:: len(words) // EXAMPLES + 1])
            raise UnknownWordError(
                {word: self.near_words(word) for word in unknown},
                f"'{self.id}' was taught {len(words)} words, such as {examples}; a scene trained with "
                f"`--clip.model {OPEN_MODEL}` can be asked anything",
            )

    def _said(self, text: str) -> str:
        if self.words is None:
            return text
        return " ".join(self._taught(word) or "" for word in WORD.findall(text.lower()))


class Encoder(PhraseEncoder):
    """Both halves of a model; it satisfies `store.ImageEncoder` too."""

    def __init__(self, weights: Weights, text: TextTower, images: ImageTower, batch: int) -> None:
        super().__init__(weights, text)
        self._images, self._device, self._batch = images, weights.device, batch

    @property
    def image_size(self) -> int:
        """Side of the images it takes, px."""
        return self._images.image_size

    def encode_images(self, crops: Array | Sequence[Array]) -> Array:
        """(M, D) float32 unit vectors of M images (image_size, image_size, 3) uint8, display values."""
        size = self.image_size
        for crop in crops:
            if crop.shape != (size, size, 3):
                raise ValueError(f"crops: expected {size} x {size} x 3 images, got shape {crop.shape}")
        starts = range(0, len(crops), self._batch)
        parts = [self._encode(np.stack(list(crops[i : i + self._batch]))) for i in starts]
        return np.concatenate(parts) if parts else np.zeros((0, self.dim), np.float32)

    def _encode(self, crops: Array) -> Array:
        import torch

        mean, std = self._images.statistics
        pixels = (crops.astype(np.float32) / 255 - mean) / std
        inputs = torch.from_numpy(np.ascontiguousarray(pixels.transpose(0, 3, 1, 2))).to(self._device)
        return unit(inferred(lambda: self._images.encode(inputs)))


@asking_errors("the encoder")
def inferred(forward: Callable[[], Any]) -> Array:
    """Return the float32 array of a torch tensor that `forward` computes, without gradients."""
    import torch

    with torch.inference_mode():
        values: Array = forward().float().cpu().numpy()
    return values


def _calibration(weights: Weights) -> tuple[float, Calibration | None]:
    path = weights.folder / READING
    if not path.is_file():
        return LanguageField.found, None
    try:
        stated = json.loads(path.read_text(encoding="utf-8"))
        if unknown := set(stated) - {"found", "calibration"}:
            raise ValueError(f"unknown: {', '.join(sorted(unknown))}")
        found = float(stated.get("found", LanguageField.found))
        if not 0 <= found <= 1:
            raise ValueError(f"found: {found}")
        if "calibration" not in stated:
            return found, None
        return found, Calibration(**{name: PlattScaling(**n) for name, n in stated["calibration"].items()})
    except (OSError, ValueError, TypeError, AttributeError, OverflowError, RecursionError) as error:
        raise EncoderError(
            f'{weights.id}: {READING} is not {{"found": 0 to 1, "calibration": {{"thing": ODDS, '
            '"part": ODDS, "inside": ODDS}} with ODDS as {"constant": number, "whole": number, '
            f'"finer": number, "found": 0.5 to 1}} ({error!r})'
        ) from None


def pixel_statistics(weights: Weights, mean: Triple, std: Triple) -> tuple[Array, Array]:
    """Return (3,) mean and (3,) standard deviation of the pixels a model was trained with, in [0, 1].

    They are those that the folder's preprocessor_config.json states, else `mean` and `std`. Raises
    EncoderError where that file cannot be read, or states no three numbers.
    """
    path = weights.folder / "preprocessor_config.json"
    name = OPEN_CLIP_CONFIG if weights.converted else path.name
    try:
        if weights.converted:
            settings = weights.converted.preprocessor
        else:
            settings = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
        stated = settings.get("image_mean") or mean, settings.get("image_std") or std
        found = np.array(stated, np.float32)
    except (OSError, ValueError, TypeError, AttributeError, RecursionError) as error:
        raise EncoderError(f"{weights.id}: {name} cannot be read ({error})") from error
    if found.shape != (2, 3) or not (found[1] > 0).all():
        raise EncoderError(f"{weights.id}: {name} states no mean and deviation of three colours")
    return found[0], found[1]


def _vocabulary(folder: Path) -> frozenset[str] | None:
    path = folder / VOCABULARY
    if not path.is_file():
        return None
    return frozenset(path.read_text(encoding="utf-8").split())
