"""SAM 2 and 2.1 (Ravi et al. 2024) on single pictures, by the image half of their video model."""

from typing import Any

from langsplat_core.arrays import Array
from langsplat_core.semantics.segmenter import Look, squashed
from langsplat_core.semantics.weights import Weights, load_config, load_model


class Sam2:
    """A `Segmenter`. The order of its three masks of a point means nothing, so their size tells the level."""

    name = "SAM 2"

    def __init__(self, weights: Weights) -> None:
        from transformers import Sam2Config, Sam2Model

        # The hub's files state the video model's configuration.
        self._model: Any = load_model(Sam2Model, weights, load_config(Sam2Config, weights, self.name))

    def look(self, image: Array) -> Look:
        """See `Segmenter`."""
        import torch

        side = int(self._model.config.prompt_encoder_config.image_size)
        pixels = torch.from_numpy(squashed(image, side)).to(self._model.device)
        seen = {"image_embeddings": self._model.get_image_embeddings(pixels)}
        return Look(self._model, seen, side, None, image.shape[:2], ordered=False)
