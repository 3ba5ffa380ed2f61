"""Image-text encoders: their interface, the family CLIP, and their loading.

CLIP is that of Radford et al. 2021, with OpenCLIP and the bundled demo encoder. A family has two towers, each
a few lines; checks of phrases and images, batches and unit vectors are shared.
"""

import hashlib
import html
import json
import logging
import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from difflib import get_close_matches
from functools import partial
from importlib.resources import files
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, Literal, Protocol

import numpy as np
import platformdirs
from msgspec import Meta, Struct

from langsplat_core.arrays import Array, unit
from langsplat_core.errors import EncoderError, FormatError, InputError, UnknownWordError, optional_imports
from langsplat_core.io.files import write_json
from langsplat_core.io.hostile import decode_json, read_text
from langsplat_core.scene import CANONICAL_PHRASES, Calibration, LanguageField
from langsplat_core.semantics import weights as models
from langsplat_core.semantics.clip_plain import (
    TEMPERATURE,
    TOKENIZER,
    check_whole,
    plain_image_tower,
    plain_text_tower,
)
from langsplat_core.semantics.weights import Weights

OPEN_MODEL = "laion/CLIP-ViT-B-16-laion2B-s34B-b88K"
WORD = re.compile(r"[^\W_]+(?:'[^\W_]+)?")

log = logging.getLogger("langsplat")


class TextTower(Protocol):
    """The text half of a model."""

    dim: int  # length D of the vectors
    temperature: float  # factor of a difference of cosines before the sigmoid, 10 for CLIP

    def encode(self, texts: list[str]) -> Array:
        """Return (B, D) float32 vectors, not normalised, of B > 0 phrases.

        Raises InputError and EncoderError as `check_whole`: no phrase is truncated silently.
        """


class ImageTower(Protocol):
    """The image half of a model."""

    image_size: int  # side of the images it takes, px
    statistics: tuple[Array, Array]  # (3,) mean and deviation by which pixels in [0, 1] are normalised

    def encode(self, pixels: Array) -> Array:
        """Return (B, D) float32 vectors, not normalised, of (B, 3, S, S) float32 normalised pixels."""


@dataclass(frozen=True)
class Family:
    """An architecture: functions that load its two halves."""

    text: Callable[[Weights], TextTower]
    images: Callable[[Weights], ImageTower]
    encoder: "type[Encoder] | None" = None  # another class, such as one that is a `features.RegionEncoder`


class _Reading(Struct, forbid_unknown_fields=True):
    """The optional reading.json beside the weights: threshold and calibration."""

    found: Annotated[float, Meta(ge=0, le=1)] = LanguageField.found
    calibration: Calibration | None = None


# Calibrations that a user made for an encoder (`langsplat doctor --encoder ID --calibrate`).

SAME_ENCODER = 0.99  # least cosine of canonical vectors of one encoder with different rounding


class _Kept(Struct):
    """A file of the user's configuration: a calibration of an encoder from the bundled room."""

    encoder: str
    canonical: list[list[float]]  # these identify the encoder, not its name
    calibration: Calibration


def _kept_folder() -> Path:
    return Path(platformdirs.user_config_path("langsplat-viewer", appauthor=False)) / "calibrations"


def keep_calibration(encoder: "PhraseEncoder", calibration: Calibration) -> Path:
    """Keep a calibration for scenes of this encoder that have none, and return its file."""
    canonical = encoder.encode_texts(list(CANONICAL_PHRASES))
    digest = hashlib.sha256(canonical.tobytes()).hexdigest()[:12]
    path, _ = _kept(canonical) or (_kept_folder() / f"{digest}.json", None)  # devices round differently
    content = {"encoder": encoder.id, "canonical": canonical.astype(float).round(6).tolist()}
    write_json(path, content | {"calibration": asdict(calibration)})
    return path


def kept_calibration(encoder: str, canonical: Array) -> Calibration | None:
    """Return the user's calibration for the encoder of (C, D) canonical vectors; warns of damaged files.

    There is none for the demo encoder, whose answers outside of drawn rooms are guesses.
    """
    found = None if encoder == DEMO else _kept(canonical)
    return None if found is None else found[1].calibration


def _kept(canonical: Array) -> tuple[Path, _Kept] | None:
    for path in sorted(_kept_folder().glob("*.json")):
        try:
            kept = decode_json(path.read_bytes(), _Kept, path)
            if same_vectors(np.array(kept.canonical), canonical):
                return path, kept
        except (FormatError, OSError, ValueError) as error:
            log.warning("%s; not used: delete it, or run `langsplat doctor` with --calibrate", error)
    return None


def same_vectors(canonical: Array, own: Array) -> bool:
    """Return True if two sets of canonical vectors are of the same encoder."""
    if canonical.shape != own.shape:
        return False
    return bool(((canonical.astype(np.float64) * own).sum(1) >= SAME_ENCODER).all())


class PhraseEncoder:
    """The text half of a model, in float32; it satisfies `relevancy.TextEncoder`."""

    def __init__(self, weights: Weights, tower: TextTower) -> None:
        self.id = weights.id  # hub id or folder as the user gave it; "demo" for the bundled encoder
        self.tower = tower
        self.dim = tower.dim  # length D of the vectors
        # Factor of the margin of cosines, phrase minus nearest canonical phrase, before the sigmoid.
        self.temperature = tower.temperature
        taught, reading = weights.folder / "vocabulary.txt", weights.folder / "reading.json"
        # All words that the encoder was taught; None: open vocabulary.
        self.words = frozenset(read_text(taught).split()) if taught.is_file() else None
        try:
            beside = decode_json(reading.read_bytes(), _Reading, reading) if reading.is_file() else _Reading()
        except FormatError as error:
            raise EncoderError(f"{weights.id}: reading.json is none of an encoder's ({error})") from None
        self.found, self.calibration = beside.found, beside.calibration

    def unknown_words(self, text: str) -> tuple[str, ...]:
        """Return the words of `text` that the encoder was never taught; empty for an open vocabulary."""
        if self.words is None:
            return ()
        return tuple(word for word in WORD.findall(text.lower()) if self._taught(word) is None)

    def near_words(self, word: str) -> tuple[str, ...]:
        """Return words of the vocabulary that are spelt like an unknown one, the nearest first."""
        return tuple(get_close_matches(word.lower(), sorted(self.words or ()), n=2))

    def _taught(self, word: str) -> str | None:
        """Return the vocabulary's form of `word`: itself, or a possessive without "'s"; None without one."""
        return next((form for form in (word, word.partition("'")[0]) if form in (self.words or ())), None)

    def encode_texts(self, texts: Sequence[str]) -> Array:
        """Return (M, D) float32 unit vectors of M phrases, raw: no prompt template, as in LangSplat.

        An encoder of a closed vocabulary gets only words, as any character that its tokenizer lacks might end
        the phrase. Raises InputError for a phrase without a letter or digit or with more tokens than the
        model reads, UnknownWordError for words it was not taught, EncoderError for unreadable characters.
        """
        if isinstance(texts, str) or not all(isinstance(text, str) for text in texts):
            raise InputError("phrases are several texts, such as encode_texts(['blue gift'])")
        for text in texts:
            self._check(text)
        said = list(texts)
        if self.words is not None:
            said = [" ".join(self._taught(w) or "" for w in WORD.findall(text.lower())) for text in texts]
        size = getattr(self.tower, "batch", 64)  # phrases per forward pass
        parts = [unit(self.tower.encode(said[i : i + size])) for i in range(0, len(texts), size)]
        return np.concatenate(parts) if parts else np.zeros((0, self.dim), np.float32)

    def _check(self, text: str) -> None:
        if not WORD.search(text):
            raise InputError(f"empty phrase {text!r}: type a word or a few, such as 'blue gift'")
        if unknown := self.unknown_words(text):
            words = sorted(self.words or ())
            examples = ", ".join(words[:: len(words) // 12 + 1])
            raise UnknownWordError(
                {word: self.near_words(word) for word in unknown},
                f"'{self.id}' was taught {len(words)} words, such as {examples}; a scene trained with "
                f"`--clip.model {OPEN_MODEL}` can be asked anything",
            )


class Encoder(PhraseEncoder):
    """Both halves of a model."""

    def __init__(self, weights: Weights, text: TextTower, images: ImageTower, batch: int) -> None:
        super().__init__(weights, text)
        self._images, self._batch = images, min(batch, getattr(images, "batch", batch))
        self.image_size = images.image_size  # side of the images it takes, px

    def encode_images(self, crops: Array | Sequence[Array]) -> Array:
        """Return (M, D) float32 unit vectors of M uint8 images of side `image_size`, display values."""
        size = self.image_size
        for crop in crops:
            if crop.shape != (size, size, 3):
                raise ValueError(f"crops: expected {size} x {size} x 3 images, got shape {crop.shape}")
        starts = range(0, len(crops), self._batch)
        parts = [self._encode(np.stack(list(crops[i : i + self._batch]))) for i in starts]
        return np.concatenate(parts) if parts else np.zeros((0, self.dim), np.float32)

    def _encode(self, images: Array, forward: Callable[[Array], Array] | None = None) -> Array:
        """Return unit vectors of (B, H, W, 3) uint8 images, by `forward`, by default the tower's `encode`."""
        mean, std = self._images.statistics
        pixels = (images.astype(np.float32) / 255 - mean) / std
        forward = forward or self._images.encode
        return unit(forward(np.ascontiguousarray(pixels.transpose(0, 3, 1, 2))))


@models.asking_errors("the encoder")
def inferred(forward: Callable[[], Any]) -> Array:
    """Return the float32 array of a torch tensor that `forward` computes, without gradients."""
    import torch

    with torch.inference_mode():
        return np.asarray(forward().float().cpu().numpy())


# Shared by all families.


def clean_text(text: str) -> str:
    """Return a text cleaned as open_clip does before its tokenizer reads it.

    Broken Unicode is repaired, curly quotes and ligatures become plain, HTML entities are replaced, spaces
    become single. Raises InputError if no letter or digit is left.
    """
    import ftfy

    plain = " ".join(html.unescape(html.unescape(ftfy.fix_text(text))).split())
    if not any(map(str.isalnum, plain)):
        raise InputError(f"empty phrase {text!r}: type a word or a few, such as 'blue gift'")
    return plain


class Images:
    """An `ImageTower` computed by torch."""

    def __init__(self, kind: Any, weights: Weights, config: Any, output: str, usual: Array) -> None:
        """kind: class of transformers; output: name of the vectors in its output.

        usual: (2, 3) mean and standard deviation of pixels, unless preprocessor_config.json has others.
        """
        self._model, self._output = models.load_model(kind, weights, config), output
        self._device = weights.device
        self.image_size = int(self._model.config.image_size)
        self.statistics = _pixel_statistics(weights, usual)

    def encode(self, pixels: Array) -> Array:
        return self.infer(pixels, self._output)

    def infer(self, pixels: Array, output: str) -> Array:
        """Return the field `output` of the model's output for pixels (B, 3, H, W)."""
        import torch

        inputs = torch.from_numpy(pixels).to(self._device)
        return inferred(lambda: getattr(self._model(pixel_values=inputs), output))


def _pixel_statistics(weights: Weights, usual: Array) -> tuple[Array, Array]:
    """Return mean and deviation of the pixels a model was trained with; EncoderError for a damaged file."""
    path = weights.folder / "preprocessor_config.json"
    name = models.OPEN_CLIP_CONFIG if weights.converted else path.name
    try:
        settings = weights.converted.preprocessor if weights.converted else {}
        if not weights.converted and path.is_file():
            settings = json.loads(path.read_text(encoding="utf-8"))
        stated = settings.get("image_mean") or usual[0], settings.get("image_std") or usual[1]
        found = np.array(stated, np.float64)
    except (OSError, ValueError, TypeError, AttributeError, RecursionError, OverflowError) as error:
        raise EncoderError(f"{weights.id}: {name} cannot be read ({str(error)[:200]})") from error
    if found.shape != (2, 3) or not ((found[1] > 1e-6) & (np.abs(found) < 1e6)).all():
        raise EncoderError(f"{weights.id}: {name} states no mean and deviation of three colours")
    return found[0].astype(np.float32), found[1].astype(np.float32)


UNUSUAL = "\u3042"  # a tokenizer without a token for unknown characters cannot read it
# The library aborts the process at a token of 300 000 bytes; the table of a normaliser may be as long.
_LONG = re.compile(rb'(?<!"precompiled_charsmap":)(?<!"precompiled_charsmap": )"[^"]{10000}')


class TorchText:
    """A `TextTower` computed by torch.

    tokenizer.json is read by `tokenizers`, as versions of transformers differ in padding and end tokens.
    """

    ends = True  # a token marks the end of every phrase
    padded = False  # phrases are padded to the length of training, not to the longest of a batch

    def __init__(
        self, kind: Any, weights: Weights, config: Any, output: str, dim: int, begin: str = ""
    ) -> None:
        """kind: class of transformers; output: name of the vectors in its output; dim: their length.

        begin: token that every phrase begins with, if any.
        """
        self.dim = dim
        self.temperature = TEMPERATURE
        self._device, self._output = weights.device, output
        text = getattr(config, "text_config", config)
        self._length = int(text.max_position_embeddings)
        self._model: Any = models.load_model(kind, weights, config)
        self.tokenizer = _tokenizer(weights, int(text.vocab_size))
        special = partial(_special_token, weights, self.tokenizer)
        self._begin = [special("bos_token", (begin,))] if begin else []
        self._end = [special("eos_token", ("<|endoftext|>", "</s>", "<eos>"))] if self.ends else []
        own = self.padded or not self.ends
        self._pad = special("pad_token", ("<pad>", "</s>", "<|endoftext|>")) if own else self._end[0]

    def encode(self, texts: list[str]) -> Array:
        ids, mask = self.tokens(texts)
        # The causal mask of a CLIP hides padding from the end token; without one, padding is masked.
        masked = {} if self.ends else {"attention_mask": mask}
        return inferred(lambda: getattr(self._model(input_ids=ids, **masked), self._output))

    def tokens(self, texts: list[str]) -> tuple[Any, Any]:
        """Return the (B, L) int64 tokens of B phrases, and their attention mask: 1, or 0 for padding."""
        import torch

        plain = [clean_text(text) for text in texts]
        found = self.tokenizer.encode_batch(plain, add_special_tokens=False)
        rows = [[*self._begin, *row.ids, *self._end] for row in found]
        room = self._length - len(self._begin) - len(self._end)
        for text, row in zip(plain, found, strict=True):
            check_whole(text, row.ids, room, {*self._end, self._pad})
        length = self._length if self.padded else max(map(len, rows))
        ids = [row + [self._pad] * (length - len(row)) for row in rows]
        mask = [[int(place < len(row)) for place in range(length)] for row in rows]
        return torch.tensor(ids).to(self._device), torch.tensor(mask).to(self._device)


def _tokenizer(weights: Weights, vocabulary: int) -> Any:
    """Return the folder's `tokenizers.Tokenizer`, without truncation and padding."""
    from tokenizers import Tokenizer

    path = weights.folder / TOKENIZER
    if not path.is_file():
        raise EncoderError(
            f"{weights.id}: no {TOKENIZER} in {weights.folder}, which reads its phrases; put it there: all "
            "CLIPs share that of openai/clip-vit-base-patch32 on the Hugging Face hub, others have their own"
        )
    try:
        if _LONG.search(path.read_bytes()):
            raise ValueError("a token of more than 10000 bytes")
        tokenizer = Tokenizer.from_file(str(path))
        tokenizer.no_truncation()
        tokenizer.no_padding()
        tokenizer.encode(UNUSUAL, add_special_tokens=False)
        # Without the sentinel tokens of T5, which no phrase has.
        most = 1 + max(n for token, n in tokenizer.get_vocab().items() if "<extra_id_" not in token)
        if most > vocabulary:
            raise ValueError(f"{most} tokens, its model knows {vocabulary}")
        return tokenizer
    except Exception as error:  # the library raises no narrower class for a damaged file
        reason = (str(error).splitlines() or ["unreadable"])[0][:200]
        raise EncoderError(f"{weights.id}: {TOKENIZER} is no tokenizer of this model ({reason})") from error


def _special_token(weights: Weights, tokenizer: Any, role: str, usual: tuple[str, ...]) -> int:
    """Return the number of the token with a role: from tokenizer_config.json, else by its usual names."""
    stated = None
    with suppress(OSError, ValueError, AttributeError, RecursionError):
        stated = json.loads((weights.folder / "tokenizer_config.json").read_bytes()).get(role)
    for token in (stated.get("content") if isinstance(stated, dict) else stated, *usual):
        number = tokenizer.token_to_id(token) if isinstance(token, str) else None
        if number is not None:
            return int(number)
    raise EncoderError(f"{weights.id}: its tokenizer has no {role}, such as {usual[0]}")


# CLIP.

CLIP_PIXELS = np.array([  # mean and standard deviation of OpenAI's CLIP, kept by OpenCLIP
    (0.48145466, 0.4578275, 0.40821073), (0.26862954, 0.26130258, 0.27577711),
])  # fmt: skip


def clip_text(weights: Weights) -> TextTower:
    """Return the text tower: in NumPy for a closed vocabulary on the CPU, else in torch."""
    return plain_text_tower(weights) or ClipText(weights)


class ClipText(TorchText):
    """The text tower of a CLIP in torch; name: prefix of its classes in transformers."""

    def __init__(self, weights: Weights, name: str = "CLIP", begin: str = "<|startoftext|>") -> None:
        kind, config = clip_tower(weights, name, "Text")
        super().__init__(kind, weights, config, "text_embeds", config.projection_dim, begin)


def clip_images(weights: Weights) -> ImageTower:
    """Return the image tower: in NumPy as for `clip_text`, else in torch."""
    return plain_image_tower(weights, _pixel_statistics(weights, CLIP_PIXELS)) or torch_clip_images(weights)


def torch_clip_images(weights: Weights, name: str = "CLIP") -> Images:
    """Return the image tower of a CLIP in torch; name as of `ClipText`."""
    kind, config = clip_tower(weights, name, "Vision")
    return Images(kind, weights, config, "image_embeds", CLIP_PIXELS)


def clip_tower(weights: Weights, name: str, tower: Literal["Text", "Vision"]) -> tuple[Any, Any]:
    """Return the class of one tower with its projection, and its configuration."""
    import transformers

    config = models.load_config(getattr(transformers, f"{name}Config"), weights, name)
    tower_config = getattr(config, f"{tower.lower()}_config")
    tower_config.projection_dim = config.projection_dim  # some files have it for the pair only
    return getattr(transformers, f"{name}{tower}ModelWithProjection"), tower_config


# Loading by hub id, folder or file. A new family is two towers, and a row here or in an extension.

DEMO = "demo"
DEMO_ELSEWHERE = (
    "the demo encoder was made for drawn rooms, and this scene is not marked as one: on photographs its "
    "answers are guesses, without probabilities. Real weights: "
    f"langsplat train DATASET --out scene.ply --clip.model {OPEN_MODEL}"
)
FAMILIES: Mapping[str, Family] = MappingProxyType(  # by `model_type` of config.json
    {"clip": Family(clip_text, clip_images)}
)


@optional_imports(EncoderError)
def load_text_encoder(model: str, device: str = "cpu") -> PhraseEncoder:
    """Load the text half of `model`: a folder, a file, a hub id, or "demo" for the bundled encoder.

    By default on the CPU: milliseconds a phrase. EncoderError for weights missing or of no known family.
    """
    weights = models.open_weights(model, model_path(model, "--encoder"), device)
    return PhraseEncoder(weights, models.family_of(weights, FAMILIES, "encoders").text(weights))


@optional_imports(EncoderError)
def load_encoder(model: str, device: str = "auto", batch: int = 32, option: str = "--clip.model") -> Encoder:
    """Load both halves of `model`, as in `load_text_encoder`; batch: images per forward pass."""
    weights = models.open_weights(model, model_path(model, option), device)
    family = models.family_of(weights, FAMILIES, "encoders")
    kind = family.encoder or Encoder
    return kind(weights, family.text(weights), family.images(weights), batch)


def model_path(model: str, option: str) -> Path:
    """Return the folder or file of `model`; option: the setting that messages name, see `weights_path`."""
    if model != DEMO:
        return models.weights_path(model, option)
    folder = Path(str(files("langsplat_assets") / "demo_encoder"))
    if not folder.is_dir():
        raise EncoderError(f"the bundled demo encoder is missing ({folder}); reinstall, or pass {option}")
    return folder
