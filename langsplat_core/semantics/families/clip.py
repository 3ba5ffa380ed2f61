"""CLIP (Radford et al. 2021), OpenCLIP and the bundled demo encoder: the towers of `CLIPModel`."""

from typing import Any

from langsplat_core.arrays import Array
from langsplat_core.errors import EncoderError
from langsplat_core.semantics.encoder import Family, Logits, TextTower, inferred, pixel_statistics
from langsplat_core.semantics.families.clip_plain import TEMPERATURE, plain_text_tower
from langsplat_core.semantics.tokens import check_whole, text_cleaner
from langsplat_core.semantics.weights import Weights, load_config, load_model, loading_errors

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
