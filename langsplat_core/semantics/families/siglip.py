"""SigLIP (Zhai et al. 2023) and SigLIP 2 (Tschannen et al. 2025): pairs judged one by one by a sigmoid.

SigLIP 2's fixed-resolution checkpoints are SigLIP models with another vocabulary, and say so in their
`model_type`; its NaFlex checkpoints take patches instead of a picture. A text's vector is that of its last
token, padding or not, and no token is masked: a phrase is always padded to the length of training.

Their logits are scale * cosine + bias, with a learned scale of 110 to 120 and a bias of -12 to -17. The bias
makes a pair improbable unless it is right, since of n^2 pairs in a batch only n are; in relevancy, which is
made of differences of cosines, it cancels. The temperature is a tenth of the scale, see `encoder.Logits`.
"""

import math
import string
from typing import Any

from langsplat_core.arrays import Array
from langsplat_core.errors import EncoderError
from langsplat_core.semantics.encoder import Family, Logits, inferred, pixel_statistics
from langsplat_core.semantics.tokens import load_tokens, text_cleaner
from langsplat_core.semantics.weights import (
    Weights,
    load_config,
    load_model,
    read_scalars,
)

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
