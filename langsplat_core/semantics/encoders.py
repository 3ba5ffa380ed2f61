"""CLIP (Radford et al. 2021), OpenCLIP and the bundled demo encoder: the towers of `CLIPModel`."""

import math
import string
from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.errors import EncoderError, optional_imports
from langsplat_core.semantics.clip_plain import TEMPERATURE, plain_text_tower
from langsplat_core.semantics.encoder import (
    OPEN_MODEL,
    Encoder,
    Family,
    Logits,
    PhraseEncoder,
    TextTower,
    inferred,
    pixel_statistics,
)
from langsplat_core.semantics.layouts import open_weights
from langsplat_core.semantics.tokens import check_whole, load_tokens, text_cleaner
from langsplat_core.semantics.weights import (
    Weights,
    load_config,
    load_model,
    loading_errors,
    model_type,
    read_scalars,
    torch_device,
    weights_path,
)

CLIP_MEAN = (0.48145466, 0.4578275, 0.40821073)  # of OpenAI's CLIP, kept by OpenCLIP
CLIP_STD = (0.26862954, 0.26130258, 0.27577711)


class ClipText:
    """A `TextTower`, by torch."""

    def __init__(self, weights: Weights) -> None:
        from transformers import CLIPTextModelWithProjection, CLIPTokenizerFast

        self.temperature = TEMPERATURE
        self.logits: Logits | None = None
        self._clean = text_cleaner()
        self._device = weights.device
        self._model: Any = _load(CLIPTextModelWithProjection, "text", weights)
        self._tokenizer: Any = _load_tokenizer(CLIPTokenizerFast, weights, int(self._model.config.vocab_size))

    @property
    def dim(self) -> int:
        """See `TextTower`."""
        return int(self._model.config.projection_dim)

    def encode(self, texts: list[str]) -> Array:
        """See `TextTower`."""
        limit = int(self._model.config.max_position_embeddings) - 2  # one begins a phrase, one ends it
        ends = {int(self._tokenizer.eos_token_id)}
        plain = [self._clean(text) for text in texts]
        for text, row in zip(texts, self._tokenizer(plain, verbose=False).input_ids, strict=True):
            check_whole(text, row[1:-1], limit, ends)
        # Padding follows the end token, which attends to earlier tokens only: no attention mask is needed.
        tokens = self._tokenizer(plain, padding=True, return_tensors="pt").input_ids.to(self._device)
        return inferred(lambda: self._model(input_ids=tokens).text_embeds)


class ClipPictures:
    """A `PictureTower`."""

    def __init__(self, weights: Weights) -> None:
        from transformers import CLIPVisionModelWithProjection

        self._model: Any = _load(CLIPVisionModelWithProjection, "vision", weights)
        self.statistics: tuple[Array, Array] = pixel_statistics(weights, CLIP_MEAN, CLIP_STD)

    @property
    def image_size(self) -> int:
        """See `PictureTower`."""
        return int(self._model.config.image_size)

    def encode(self, pixels: Any) -> Any:
        """See `PictureTower`."""
        return self._model(pixel_values=pixels).image_embeds


def clip_text(weights: Weights) -> TextTower:
    """In NumPy where the model is small, else by torch."""
    return plain_text_tower(weights) or ClipText(weights)


CLIP = Family("CLIP", clip_text, ClipPictures)


def _load(kind: Any, tower: str, weights: Weights) -> Any:
    """One tower ("text" or "vision") with its projection."""
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
    if max(tokenizer.get_vocab().values()) >= vocabulary:
        raise EncoderError(
            f"{weights.id}: the tokenizer in {folder} has more tokens than the model's {vocabulary}"
        )
    return tokenizer


# SigLIP (Zhai et al. 2023) and SigLIP 2 (Tschannen et al. 2025): pairs judged one by one by a sigmoid.
#
# SigLIP 2's fixed-resolution checkpoints are SigLIP models with another vocabulary, and say so in their
# `model_type`; its NaFlex checkpoints take patches instead of a picture. A text's vector is that of its last
# token, padding or not, and no token is masked: a phrase is always padded to the length of training.
#
# Their logits are scale * cosine + bias, with a learned scale of 110 to 120 and a bias of -12 to -17. The
# bias makes a pair improbable unless it is right, since of n^2 pairs in a batch only n are; in relevancy,
# which is made of differences of cosines, it cancels. The temperature is a tenth of the scale, see
# `encoder.Logits`.

HALF = (0.5, 0.5, 0.5)  # mean and standard deviation of pixels
NO_PUNCTUATION = str.maketrans("", "", string.punctuation)


class SiglipText:
    """A `TextTower`."""

    def __init__(self, weights: Weights, kind: Any, config: Any) -> None:
        self._device = weights.device
        self._model: Any = load_model(kind, weights, config.text_config)
        self._clean = text_cleaner()
        self._tokens = load_tokens(weights, int(config.text_config.max_position_embeddings), ends=True)
        learned = _logits(weights)
        self.logits: Logits | None = learned
        self.temperature = learned.temperature

    @property
    def dim(self) -> int:
        """See `TextTower`."""
        return int(self._model.config.projection_size)

    def encode(self, texts: list[str]) -> Array:
        """See `TextTower`."""
        ids, _ = self._tokens.rows([self.canonical(text) for text in texts])
        return inferred(lambda: self._model(input_ids=ids.to(self._device)).pooler_output)

    def canonical(self, text: str) -> str:
        """As the captions of its training: clean, in lower case; SigLIP 1 had no punctuation either."""
        lower = self._clean(text).lower()
        return " ".join(lower.translate(NO_PUNCTUATION).split()) if self._tokens.is_unigram else lower


class SiglipPictures:
    """A `PictureTower`."""

    def __init__(self, weights: Weights, kind: Any, config: Any) -> None:
        self._model: Any = load_model(kind, weights, config.vision_config)
        self.statistics: tuple[Array, Array] = pixel_statistics(weights, HALF, HALF)

    @property
    def image_size(self) -> int:
        """See `PictureTower`."""
        return int(self._model.config.image_size)

    def encode(self, pixels: Any) -> Any:
        """See `PictureTower`."""
        return self._model(pixel_values=pixels).pooler_output


class NaflexPictures(SiglipPictures):
    """A `PictureTower` of SigLIP 2 NaFlex, given squares of as many patches as it has positions."""

    @property
    def image_size(self) -> int:
        """See `PictureTower`."""
        return int(self._model.config.patch_size) * self._side

    @property
    def _side(self) -> int:
        return round(int(self._model.config.num_patches) ** 0.5)

    def encode(self, pixels: Any) -> Any:
        """See `PictureTower`."""
        import torch

        count, side = len(pixels), self._side
        patches = pixels.unflatten(3, (side, -1)).unflatten(2, (side, -1))  # (B, 3, rows, p, columns, p)
        patches = patches.permute(0, 2, 4, 3, 5, 1).flatten(3).flatten(1, 2)  # colours fastest
        everything = torch.ones(patches.shape[:2], dtype=torch.long, device=pixels.device)
        shapes = torch.full((count, 2), side, device=pixels.device)
        return self._model(
            pixel_values=patches, pixel_attention_mask=everything, spatial_shapes=shapes
        ).pooler_output


def _logits(weights: Weights) -> Logits:
    found = read_scalars(weights, ("logit_scale", "logit_bias"))
    if len(found) < 2 or not all(map(math.isfinite, found.values())):
        raise EncoderError(f"{weights.id}: not SigLIP weights: logit_scale and logit_bias are not in them")
    return Logits(math.exp(found["logit_scale"]), found["logit_bias"])


def _siglip_text(weights: Weights) -> SiglipText:
    from transformers import SiglipConfig, SiglipTextModel

    return SiglipText(weights, SiglipTextModel, load_config(SiglipConfig, weights, "SigLIP"))


def _siglip_pictures(weights: Weights) -> SiglipPictures:
    from transformers import SiglipConfig, SiglipVisionModel

    return SiglipPictures(weights, SiglipVisionModel, load_config(SiglipConfig, weights, "SigLIP"))


def _naflex_text(weights: Weights) -> SiglipText:
    from transformers import Siglip2Config, Siglip2TextModel

    return SiglipText(weights, Siglip2TextModel, load_config(Siglip2Config, weights, "SigLIP 2"))


def _naflex_pictures(weights: Weights) -> NaflexPictures:
    from transformers import Siglip2Config, Siglip2VisionModel

    return NaflexPictures(weights, Siglip2VisionModel, load_config(Siglip2Config, weights, "SigLIP 2"))


SIGLIP = Family("SigLIP", _siglip_text, _siglip_pictures)
NAFLEX = Family("SigLIP 2 NaFlex", _naflex_text, _naflex_pictures)


# TIPS v2 (Google 2026): image and text vectors of one space, trained with a temperature like CLIP.


class TipsText:
    """A `TextTower`. Its vector is the mean over a phrase's tokens, so padding is masked."""

    def __init__(self, weights: Weights) -> None:
        config = _config(weights)
        from transformers import Tipsv2TextModel

        self._device = weights.device
        self._model: Any = load_model(Tipsv2TextModel, weights, config.text_config)
        self._tokens = load_tokens(weights, int(config.text_config.max_position_embeddings), ends=False)
        # Published checkpoints leave the learned temperature out; their configuration has it then.
        stated = float(config.temperature_init_value)
        self.logits: Logits | None = Logits(
            1 / read_scalars(weights, ("temperature",)).get("temperature", stated)
        )
        self.temperature = self.logits.temperature

    @property
    def dim(self) -> int:
        """See `TextTower`."""
        return int(self._model.config.hidden_size)

    def encode(self, texts: list[str]) -> Array:
        """See `TextTower`."""
        ids, used = self._tokens.rows([text.lower() for text in texts])
        given = {"input_ids": ids.to(self._device), "attention_mask": used.to(self._device)}
        return inferred(lambda: self._model(**given).pooler_output)


class TipsPictures:
    """A `PictureTower`; pixels are in [0, 1] and not normalised. Its vector is that of the first class
    token, which was trained with the captions of the web."""

    def __init__(self, weights: Weights) -> None:
        config = _config(weights)
        from transformers import Tipsv2VisionModel

        self._model: Any = load_model(Tipsv2VisionModel, weights, config.vision_config)
        self.statistics: tuple[Array, Array] = np.zeros(3, np.float32), np.ones(3, np.float32)

    @property
    def image_size(self) -> int:
        """See `PictureTower`."""
        return int(self._model.config.image_size)

    def encode(self, pixels: Any) -> Any:
        """See `PictureTower`."""
        return self._model(pixel_values=pixels).pooler_output


def _config(weights: Weights) -> Any:
    try:
        from transformers import Tipsv2Config
    except ImportError as error:
        raise EncoderError(
            f"{weights.id}: TIPS v2 needs a newer transformers: `pip install -U transformers`"
        ) from error
    return load_config(Tipsv2Config, weights, "TIPS v2")


TIPS = Family("TIPS v2", TipsText, TipsPictures)


# Image-text encoders by hub id, folder or file: a new family is one file and one row here.

DEMO = "demo"
DEMO_ELSEWHERE = (
    "the demo encoder was made for drawn rooms, and this scene is not marked as one: on photographs its "
    "answers are guesses, without percentages. Real weights: "
    f"langsplat train DATASET --out scene.ply --clip.model {OPEN_MODEL}"
)
FAMILIES: Mapping[str, Family] = MappingProxyType(  # by `model_type` of config.json
    {"clip": CLIP, "siglip": SIGLIP, "siglip2": NAFLEX, "tipsv2": TIPS}
)


@optional_imports(EncoderError)
def load_text_encoder(model: str, device: str = "cpu") -> PhraseEncoder:
    """Load the text half of `model`: a folder, a file, a hub id, or "demo" for the bundled encoder.

    The device is the CPU unless told otherwise, because a phrase takes it a few milliseconds.
    Raises EncoderError where the weights are absent or are those of no family here.
    """
    weights = open_weights(model, model_path(model, "--encoder"), torch_device(device))
    return PhraseEncoder(weights, _family(weights).text(weights))


@optional_imports(EncoderError)
def load_encoder(model: str, device: str = "auto", batch: int = 32) -> Encoder:
    """Load both halves of `model`: a folder, a file, a hub id, or "demo" for the bundled encoder.

    batch: pictures per forward pass.
    Raises EncoderError where the weights are absent or are those of no family here.
    """
    weights = open_weights(model, model_path(model, "--clip.model"), torch_device(device))
    family = _family(weights)
    text = PhraseEncoder(weights, family.text(weights))
    return Encoder(text, family.pictures(weights), weights.device, batch)


def model_path(model: str, option: str) -> Path:
    """Where the files of `model` lie; `option` is what messages name, see `weights.weights_path`."""
    if model != DEMO:
        return weights_path(model, option)
    folder = Path(str(files("langsplat_assets") / "demo_encoder"))
    if not folder.is_dir():
        raise EncoderError(f"the bundled demo encoder is missing ({folder}); reinstall, or pass {option}")
    return folder


def _family(weights: Weights) -> Family:
    named = model_type(weights)
    if named not in FAMILIES:
        known = ", ".join(FAMILIES)
        raise EncoderError(
            f"{weights.id}: its {named!r} model is no image-text encoder known here; known are {known}"
        )
    return FAMILIES[named]
