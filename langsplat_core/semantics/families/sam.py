"""Segment Anything (Kirillov et al. 2023), and SAM-HQ (Ke et al. 2023), which refines its masks."""

from typing import Any

from langsplat_core.arrays import Array
from langsplat_core.semantics.segmenter import Look, padded
from langsplat_core.semantics.weights import Weights, load_config, load_model

EPSILON = 1e-5  # of the norms between attentions in segment_anything, PyTorch's; transformers has 1e-6 there


class Sam:
    """A `Segmenter`. Its three masks of a point are subpart, part and whole (LangSplat section 3.1)."""

    name = "SAM"

    def __init__(self, weights: Weights) -> None:
        from transformers import SamConfig, SamModel

        self._model = _load(SamModel, SamConfig, weights, self.name)

    def look(self, image: Array) -> Look:
        """See `Segmenter`."""
        pixels, side, size = _seen(self._model, image)
        seen = {"image_embeddings": self._model.get_image_embeddings(pixels)}
        return Look(self._model, seen, side, size, image.shape[:2], ordered=True)


class SamHq:
    """A `Segmenter`. transformers gives its masks by falling score, so their size must tell the level; and
    one refinement is added to all three, which brings them closer together than SAM's are."""

    name = "SAM-HQ"

    def __init__(self, weights: Weights) -> None:
        from transformers import SamHQConfig, SamHQModel

        self._model = _load(SamHQModel, SamHQConfig, weights, self.name)

    def look(self, image: Array) -> Look:
        """See `Segmenter`."""
        pixels, side, size = _seen(self._model, image)
        embedding, inner = self._model.get_image_embeddings(pixels)
        seen = {"image_embeddings": embedding, "intermediate_embeddings": inner}
        return Look(self._model, seen, side, size, image.shape[:2], ordered=False)


def _load(kind: Any, config: Any, weights: Weights, name: str) -> Any:
    settings = load_config(config, weights, name)
    settings.mask_decoder_config.layer_norm_eps = EPSILON
    return load_model(kind, weights, settings)


def _seen(model: Any, image: Array) -> tuple[Any, int, tuple[int, int]]:
    import torch

    side = int(model.config.vision_config.image_size)
    pixels, size = padded(image, side)
    return torch.from_numpy(pixels).to(model.device), side, size
