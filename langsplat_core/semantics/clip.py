"""CLIP: pictures of regions and phrases as unit vectors of one space."""

import json
import re
from collections.abc import Sequence
from difflib import get_close_matches
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from langsplat_core.arrays import Array, unit
from langsplat_core.errors import EncoderError, InputError
from langsplat_core.semantics.weights import load_model, loading_errors, torch_device, weights_folder

DEMO = "demo"
OPEN_MODEL = "laion/CLIP-ViT-B-16-laion2B-s34B-b88K"
CLIP_MEAN = (0.48145466, 0.4578275, 0.40821073)  # of OpenAI's CLIP, kept by OpenCLIP
CLIP_STD = (0.26862954, 0.26130258, 0.27577711)
VOCABULARY = "vocabulary.txt"  # beside the weights: the only words the encoder was taught, one per line
WORD = re.compile(r"[^\W_]+(?:'[^\W_]+)?")
EXAMPLES = 12  # known words to name where a phrase has an unknown one
TEXT_BATCH = 64  # phrases per forward pass


class ClipTextEncoder:
    """The text half of a CLIP model, in float32; it satisfies `query.engine.TextEncoder`."""

    def __init__(self, id: str, folder: Path, device: str) -> None:
        from transformers import CLIPTextModelWithProjection, CLIPTokenizerFast

        self.id = id
        self._device = device
        self._model: Any = _load(CLIPTextModelWithProjection, "text", id, folder, device)
        self._tokenizer: Any = _load_tokenizer(CLIPTokenizerFast, id, folder)
        self._words = _vocabulary(folder)

    @property
    def dim(self) -> int:
        """Length D of the vectors."""
        return int(self._model.config.projection_dim)

    def unknown_words(self, text: str) -> tuple[str, ...]:
        """Words of `text` that the encoder was never taught; empty when it was taught open vocabulary."""
        if self._words is None:
            return ()
        return tuple(word for word in WORD.findall(text.lower()) if word not in self._words)

    def encode_texts(self, texts: Sequence[str]) -> Array:
        """(M, D) float32 unit vectors of M phrases, raw: no prompt template, as in LangSplat.

        Raises InputError for a phrase without a letter or digit, EncoderError for unknown words.
        """
        for text in texts:
            self._check(text)
        parts = [self._encode(list(texts[i : i + TEXT_BATCH])) for i in range(0, len(texts), TEXT_BATCH)]
        return np.concatenate(parts) if parts else np.zeros((0, self.dim), np.float32)

    def _check(self, text: str) -> None:
        if not WORD.search(text):
            raise InputError(f"empty phrase {text!r}: type a word or a few, such as 'red mug'")
        unknown = self.unknown_words(text)
        if unknown:
            words = sorted(self._words or ())
            near = [match for word in unknown for match in get_close_matches(word, words, n=2)]
            known = ", ".join(near or words[:: len(words) // EXAMPLES + 1])
            raise EncoderError(
                f"{', '.join(map(repr, unknown))}: not taught to the encoder '{self.id}', which knows "
                f"{len(words)} words, such as {known}; a scene trained with `--clip.model {OPEN_MODEL}` "
                "can be asked anything"
            )

    def _encode(self, texts: list[str]) -> Array:
        import torch

        limit = int(self._model.config.max_position_embeddings)
        # Padding follows the end token, which attends to earlier tokens only: no attention mask is needed.
        tokens = self._tokenizer(
            texts, padding=True, truncation=True, max_length=limit, return_tensors="pt"
        ).input_ids.to(self._device)
        with torch.inference_mode():
            vectors = self._model(input_ids=tokens).text_embeds
        return unit(vectors.float().cpu().numpy())


class ClipEncoder:
    """Both halves of a CLIP model."""

    def __init__(self, text: ClipTextEncoder, folder: Path, device: str, batch: int) -> None:
        from transformers import CLIPVisionModelWithProjection

        self._batch = batch
        self._text = text
        self._device = device
        self._model: Any = _load(CLIPVisionModelWithProjection, "vision", text.id, folder, device)
        self._mean, self._std = _normalisation(folder)

    @property
    def id(self) -> str:
        """Hub id or folder as it was asked for; "demo" for the bundled encoder."""
        return self._text.id

    @property
    def dim(self) -> int:
        """Length D of the vectors."""
        return self._text.dim

    @property
    def image_size(self) -> int:
        """Side of the pictures it takes, px."""
        return int(self._model.config.image_size)

    def unknown_words(self, text: str) -> tuple[str, ...]:
        """As `ClipTextEncoder.unknown_words`."""
        return self._text.unknown_words(text)

    def encode_texts(self, texts: Sequence[str]) -> Array:
        """As `ClipTextEncoder.encode_texts`."""
        return self._text.encode_texts(texts)

    def encode_images(self, crops: Array | Sequence[Array]) -> Array:
        """(M, D) float32 unit vectors of M pictures (image_size, image_size, 3) uint8, display values."""
        size = self.image_size
        for crop in crops:
            if crop.shape != (size, size, 3):
                raise ValueError(f"crops: expected {size} x {size} x 3 pictures, got shape {crop.shape}")
        starts = range(0, len(crops), self._batch)
        parts = [self._encode(np.stack(list(crops[i : i + self._batch]))) for i in starts]
        return np.concatenate(parts) if parts else np.zeros((0, self.dim), np.float32)

    def _encode(self, crops: Array) -> Array:
        import torch

        pixels = (crops.astype(np.float32) / 255 - self._mean) / self._std
        with torch.inference_mode():
            inputs = torch.from_numpy(np.ascontiguousarray(pixels.transpose(0, 3, 1, 2))).to(self._device)
            vectors = self._model(pixel_values=inputs).image_embeds
        return unit(vectors.float().cpu().numpy())


def load_text_encoder(model: str, device: str = "cpu") -> ClipTextEncoder:
    """Load the text half of `model`: a folder, a hub id, or "demo" for the bundled encoder.

    The device is the CPU unless told otherwise, because a phrase takes it a few milliseconds.
    Raises EncoderError where the weights are absent or are not those of a CLIP model.
    """
    return ClipTextEncoder(model, clip_folder(model, "--encoder"), torch_device(device))


def load_clip(model: str, device: str = "auto", batch: int = 32) -> ClipEncoder:
    """Load both halves of `model`: a folder, a hub id, or "demo" for the bundled encoder.

    batch: pictures per forward pass.
    Raises EncoderError where the weights are absent or are not those of a CLIP model.
    """
    folder, device = clip_folder(model, "--clip.model"), torch_device(device)
    return ClipEncoder(ClipTextEncoder(model, folder, device), folder, device, batch)


def clip_folder(model: str, option: str) -> Path:
    """Where the files of `model` lie; `option` is what messages name, see `weights.weights_folder`."""
    if model != DEMO:
        return weights_folder(model, option)
    folder = Path(str(files("langsplat_assets") / "demo_encoder"))
    if not folder.is_dir():
        raise EncoderError(f"the bundled demo encoder is missing ({folder}); reinstall, or pass {option}")
    return folder


def _load(kind: Any, tower: str, id: str, folder: Path, device: str) -> Any:
    """One tower ("text" or "vision") with its projection."""
    from transformers import CLIPConfig

    with loading_errors(id, "CLIP"):
        config = CLIPConfig.from_pretrained(folder, local_files_only=True)
        tower_config = getattr(config, f"{tower}_config")
        tower_config.projection_dim = config.projection_dim  # some files state it for the pair only
    return load_model(kind, id, folder, tower_config).to(device)


def _load_tokenizer(kind: Any, id: str, folder: Path) -> Any:
    needed = "tokenizer.json, or vocab.json and merges.txt"
    if not (folder / "tokenizer.json").is_file() and not (folder / "merges.txt").is_file():
        raise EncoderError(f"{id}: no CLIP tokenizer in this folder; it needs {needed}")
    with loading_errors(id, "CLIP"):
        return kind.from_pretrained(folder, local_files_only=True)


def _vocabulary(folder: Path) -> frozenset[str] | None:
    path = folder / VOCABULARY
    if not path.is_file():
        return None
    return frozenset(path.read_text(encoding="utf-8").split())


def _normalisation(folder: Path) -> tuple[Array, Array]:
    """(3,) mean and (3,) standard deviation of the pixels the encoder was trained with, in [0, 1]."""
    path = folder / "preprocessor_config.json"
    settings = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
    mean, std = settings.get("image_mean", CLIP_MEAN), settings.get("image_std", CLIP_STD)
    return np.array(mean, np.float32), np.array(std, np.float32)
