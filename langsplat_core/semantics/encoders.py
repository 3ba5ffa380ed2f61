"""Families of image-text encoders and their loading: CLIP and SigLIP.

CLIP is that of Radford et al. 2021, with OpenCLIP and the bundled demo encoder.
"""

import math
import string
from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path
from types import MappingProxyType
from typing import Any

from langsplat_core import registry
from langsplat_core.arrays import Array
from langsplat_core.errors import EncoderError, optional_imports
from langsplat_core.semantics.clip_plain import TEMPERATURE, plain_text_tower
from langsplat_core.semantics.encoder import (
    OPEN_MODEL,
    SHARE_OF_SCALE,
    UNUSUAL,
    Encoder,
    Family,
    ImageTower,
    PhraseEncoder,
    TextTower,
    check_whole,
    inferred,
    load_tokens,
    pixel_statistics,
    text_cleaner,
)
from langsplat_core.semantics.weights import (
    Weights,
    load_config,
    load_model,
    loading_errors,
    model_type,
    open_weights,
    read_scalar,
    torch_device,
    weights_path,
)

CLIP_MEAN = (0.48145466, 0.4578275, 0.40821073)  # of OpenAI's CLIP, kept by OpenCLIP
CLIP_STD = (0.26862954, 0.26130258, 0.27577711)


class ClipText:
    """A `TextTower` computed by torch."""

    def __init__(self, weights: Weights) -> None:
        from transformers import CLIPTextModelWithProjection, CLIPTokenizerFast

        self.temperature = TEMPERATURE
        self._clean = text_cleaner()
        self._device = weights.device
        self._model: Any = _load(CLIPTextModelWithProjection, "text", weights)
        self._tokenizer: Any = _load_tokenizer(CLIPTokenizerFast, weights, int(self._model.config.vocab_size))

    @property
    def dim(self) -> int:
        return int(self._model.config.projection_dim)

    def encode(self, texts: list[str]) -> Array:
        limit = int(self._model.config.max_position_embeddings) - 2  # one begins a phrase, one ends it
        ends = {int(self._tokenizer.eos_token_id)}
        plain = [self._clean(text) for text in texts]
        for text, row in zip(texts, self._tokenizer(plain, verbose=False).input_ids, strict=True):
            check_whole(text, row[1:-1], limit, ends)
        # Padding follows the end token, which attends to earlier tokens only: no attention mask is needed.
        tokens = self._tokenizer(plain, padding=True, return_tensors="pt").input_ids.to(self._device)
        return inferred(lambda: self._model(input_ids=tokens).text_embeds)


class Images:
    """An `ImageTower` computed by torch."""

    def __init__(self, model: Any, output: str, statistics: tuple[Array, Array]) -> None:
        """model: of transformers; output: name of the vectors in what it returns."""
        self._model, self._output, self.statistics = model, output, statistics

    @property
    def image_size(self) -> int:
        return int(self._model.config.image_size)

    def encode(self, pixels: Any) -> Any:
        return getattr(self._model(pixel_values=pixels), self._output)


def clip_images(weights: Weights) -> ImageTower:
    """Return the image tower of a CLIP, by torch."""
    from transformers import CLIPVisionModelWithProjection

    model = _load(CLIPVisionModelWithProjection, "vision", weights)
    return Images(model, "image_embeds", pixel_statistics(weights, CLIP_MEAN, CLIP_STD))


def clip_text(weights: Weights) -> TextTower:
    """Return the text tower in NumPy where the model is small, else by torch."""
    return plain_text_tower(weights) or ClipText(weights)


def _load(kind: Any, tower: str, weights: Weights) -> Any:
    """Load one tower, "text" or "vision", with its projection."""
    from transformers import CLIPConfig

    config = load_config(CLIPConfig, weights, "CLIP")
    tower_config = getattr(config, f"{tower}_config")
    tower_config.projection_dim = config.projection_dim  # some files state it for the pair only
    return load_model(kind, weights, tower_config)


def _load_tokenizer(kind: Any, weights: Weights, vocabulary: int) -> Any:
    folder = weights.folder
    if not (folder / "tokenizer.json").is_file() and not (folder / "merges.txt").is_file():
        raise EncoderError(
            f"{weights.id}: no CLIP tokenizer in {folder}; put tokenizer.json there, or vocab.json and "
            "merges.txt; all CLIPs share those of openai/clip-vit-base-patch32 on the Hugging Face hub"
        )
    with loading_errors(weights.id, "CLIP"):
        tokenizer = kind.from_pretrained(folder, local_files_only=True)
        tokenizer(UNUSUAL)
        highest = max(tokenizer.get_vocab().values())
    if highest >= vocabulary:
        raise EncoderError(
            f"{weights.id}: the tokenizer in {folder} has more tokens than the model's {vocabulary}"
        )
    return tokenizer


# SigLIP (Zhai et al. 2023) and SigLIP 2 (Tschannen et al. 2025): pairs judged one by one by a sigmoid.
#
# SigLIP 2's fixed-resolution checkpoints are SigLIP models with another vocabulary, and say so in their
# `model_type`. A text's vector is that of its last token, padding or not, and no token is masked: a phrase
# is always padded to the length of training.
#
# Their logits are scale * cosine + bias, with a learned scale of 110 to 120 and a bias of -12 to -17. The
# bias makes a pair improbable unless it is right, since of n^2 pairs in a batch only n are; in relevancy,
# which is made of differences of cosines, it cancels. The temperature is a tenth of the scale, see
# `encoder.SHARE_OF_SCALE`.

HALF = (0.5, 0.5, 0.5)  # mean and standard deviation of pixels
NO_PUNCTUATION = str.maketrans("", "", string.punctuation)


class SiglipText:
    """A `TextTower` computed by torch."""

    def __init__(self, weights: Weights) -> None:
        from transformers import SiglipTextModel

        config = _siglip_config(weights).text_config
        self._device = weights.device
        self._model: Any = load_model(SiglipTextModel, weights, config)
        self._clean = text_cleaner()
        self._tokens = load_tokens(weights, int(config.max_position_embeddings))
        scale = read_scalar(weights, "logit_scale")
        if not math.isfinite(scale):
            raise EncoderError(f"{weights.id}: not SigLIP weights: logit_scale is not in them")
        self.temperature = SHARE_OF_SCALE * math.exp(scale)

    @property
    def dim(self) -> int:
        return int(self._model.config.projection_size)

    def encode(self, texts: list[str]) -> Array:
        ids = self._tokens.rows([self.canonical(text) for text in texts])
        return inferred(lambda: self._model(input_ids=ids.to(self._device)).pooler_output)

    def canonical(self, text: str) -> str:
        """Return `text` like the captions of its training: clean, in lower case.

        SigLIP 1 had no punctuation either.
        """
        lower = self._clean(text).lower()
        return " ".join(lower.translate(NO_PUNCTUATION).split()) if self._tokens.is_unigram else lower


def siglip_images(weights: Weights) -> ImageTower:
    """Return the image tower of a SigLIP, by torch."""
    from transformers import SiglipVisionModel

    model = load_model(SiglipVisionModel, weights, _siglip_config(weights).vision_config)
    return Images(model, "pooler_output", pixel_statistics(weights, HALF, HALF))


def _siglip_config(weights: Weights) -> Any:
    from transformers import SiglipConfig

    return load_config(SiglipConfig, weights, "SigLIP")


# Image-text encoders by hub id, folder or file: a new family is two towers above and one row here.

DEMO = "demo"
DEMO_ELSEWHERE = (
    "the demo encoder was made for drawn rooms, and this scene is not marked as one: on photographs its "
    "answers are guesses, without percentages. Real weights: "
    f"langsplat train DATASET --out scene.ply --clip.model {OPEN_MODEL}"
)
FAMILIES: Mapping[str, Family] = MappingProxyType(  # by `model_type` of config.json
    {"clip": Family(clip_text, clip_images), "siglip": Family(SiglipText, siglip_images)}
)


@optional_imports(EncoderError)
def load_text_encoder(model: str, device: str = "cpu") -> PhraseEncoder:
    """Load the text half of `model`: a folder, a file, a hub id, or "demo" for the bundled encoder.

    The device is the CPU unless told otherwise, because a phrase takes it a few milliseconds. Raises
    EncoderError where the weights are absent or are those of no family here.
    """
    weights = open_weights(model, model_path(model, "--encoder"), torch_device(device))
    return PhraseEncoder(weights, _family(weights).text(weights))


@optional_imports(EncoderError)
def load_encoder(model: str, device: str = "auto", batch: int = 32) -> Encoder:
    """Load both halves of `model`: a folder, a file, a hub id, or "demo" for the bundled encoder.

    batch: images per forward pass. Raises EncoderError where the weights are absent or are those of no family
    here.
    """
    weights = open_weights(model, model_path(model, "--clip.model"), torch_device(device))
    family = _family(weights)
    return Encoder(weights, family.text(weights), family.images(weights), batch)


def model_path(model: str, option: str) -> Path:
    """Folder or file of `model`; `option` is what messages name, see `weights.weights_path`."""
    if model != DEMO:
        return weights_path(model, option)
    folder = Path(str(files("langsplat_assets") / "demo_encoder"))
    if not folder.is_dir():
        raise EncoderError(f"the bundled demo encoder is missing ({folder}); reinstall, or pass {option}")
    return folder


def _family(weights: Weights) -> Family:
    named = model_type(weights)
    if named in FAMILIES:
        return FAMILIES[named]
    more = registry.references("encoders")
    if named not in more:
        known = ", ".join((*FAMILIES, *more))
        raise EncoderError(
            f"{weights.id}: its {named!r} model is no image-text encoder known here; known are {known}"
        )
    return registry.part("encoders", named)
