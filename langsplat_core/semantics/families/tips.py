"""TIPS v2 (Google 2026): image and text vectors of one space, trained with a temperature like CLIP."""

from typing import Any

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.errors import EncoderError
from langsplat_core.semantics.encoder import Family, Logits, inferred
from langsplat_core.semantics.tokens import load_tokens
from langsplat_core.semantics.weights import Weights, load_config, load_model, read_scalars


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
