"""The demo encoder as a network: a small `transformers.CLIPModel`, its inputs, its vectors, its files."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.func import functional_call
from torch.nn import functional as F

from langsplat_core.arrays import Array
from langsplat_core.io.files import atomic_path
from langsplat_core.lab.encoder.crops import CROP
from langsplat_core.lab.encoder.phrases import CONTEXT

MEAN, STD = (0.32, 0.28, 0.25), (0.30, 0.28, 0.27)  # of the training crops, black surroundings included
_CALIBRATION_STEPS = 200


def build_model(tokens: int, start: int, end: int) -> Any:
    """A `transformers.CLIPModel` of 2.4 million weights for a vocabulary of `tokens`."""
    from transformers import CLIPConfig, CLIPModel

    text = {
        "vocab_size": tokens, "hidden_size": 128, "intermediate_size": 512, "num_hidden_layers": 3,
        "num_attention_heads": 4, "max_position_embeddings": CONTEXT, "projection_dim": 512,
        "bos_token_id": start, "eos_token_id": end, "pad_token_id": end,
    }  # fmt: skip
    vision = {
        "hidden_size": 160, "intermediate_size": 640, "num_hidden_layers": 5, "num_attention_heads": 5,
        "image_size": CROP, "patch_size": 8, "projection_dim": 512,
    }  # fmt: skip
    model = CLIPModel(CLIPConfig(text_config=text, vision_config=vision, projection_dim=512))
    model.set_attn_implementation("eager")  # on a CPU the fused one is four times slower to differentiate
    return model


def normalised(crops: Array) -> Tensor:
    """(B, 64, 64, 3) uint8 -> (B, 3, 64, 64) float32 as the encoder takes them."""
    pixels = torch.from_numpy(np.ascontiguousarray(crops)).permute(0, 3, 1, 2).float() / 255
    return (pixels - torch.tensor(MEAN).view(3, 1, 1)) / torch.tensor(STD).view(3, 1, 1)


def begin_from(model: Any, vocabulary: dict[str, int], folder: Path) -> None:
    """Give `model` the weights of the encoder in `folder`, and every token of `vocabulary` (token -> row)
    that it knows its old vector."""
    from transformers import CLIPModel, CLIPTokenizerFast

    old = CLIPModel.from_pretrained(folder).state_dict()
    old_rows = CLIPTokenizerFast.from_pretrained(folder).get_vocab()
    tokens = "text_model.embeddings.token_embedding.weight"
    vectors = model.state_dict()[tokens].clone()
    for token, row in vocabulary.items():
        if token in old_rows:
            vectors[row] = old[tokens][old_rows[token]]
    model.load_state_dict({**old, tokens: vectors})


def image_features(model: Any, pixels: Tensor, keep: float = 1.0) -> Tensor:
    """(B, 160) features before the projection; `keep` < 1 shows the model that share of the patches, drawn
    at random but rather those that are not all black surroundings."""
    vision = model.vision_model
    hidden = vision.embeddings(pixels)
    if keep < 1:
        size = vision.config.patch_size
        spread = F.max_pool2d(pixels, size) + F.max_pool2d(-pixels, size)  # brightest less darkest
        score = torch.rand(len(hidden), hidden.shape[1] - 1) + (spread.amax(1).flatten(1) > 0.2) * 0.7
        order = score.argsort(1, descending=True)[:, : round(keep * score.shape[1])] + 1
        order = torch.cat([torch.zeros(len(hidden), 1, dtype=torch.long), order], 1)
        hidden = hidden.gather(1, order[..., None].expand(-1, -1, hidden.shape[2]))
    hidden = vision.encoder(inputs_embeds=vision.pre_layrnorm(hidden)).last_hidden_state[:, 0]
    return vision.post_layernorm(hidden)


def image_vectors(model: Any, features: Tensor) -> Tensor:
    """(B, 512) unit vectors of `image_features`."""
    return F.normalize(model.visual_projection(features).float(), dim=-1)


def text_vectors(model: Any, tokens: Tensor) -> Tensor:
    """(P, 512) unit vectors of (P, L) tokens."""
    pooled = model.text_model(input_ids=tokens).pooler_output
    return F.normalize(model.text_projection(pooled).float(), dim=-1)


def calibrate_canonical(model: Any, tokens: Tensor, images: Tensor, cosine: float) -> None:
    """Move the word vectors of the four canonical phrases, and nothing else, until their cosine with `images`
    is `cosine` on average.

    tokens: (4, L) int64, one word each, behind the start token; images: (M, 512) unit vectors of crops that
    show something nameable. Relevancy 0.5 then lies where a user wants it, between right and wrong phrases.
    """
    rows = tokens[:, 1]
    words = model.text_model.embeddings.token_embedding.weight.detach().float()
    moved = torch.zeros(len(rows), words.shape[1], requires_grad=True)
    optimiser = torch.optim.Adam([moved], lr=0.02)
    for _ in range(_CALIBRATION_STEPS):
        weights = {"embeddings.token_embedding.weight": words.index_add(0, rows, moved)}
        pooled = functional_call(model.text_model, weights, kwargs={"input_ids": tokens}).pooler_output
        texts = F.normalize(model.text_projection(pooled).float(), dim=-1)
        loss = ((images @ texts.T - cosine) ** 2).mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    with torch.no_grad():
        model.text_model.embeddings.token_embedding.weight.index_add_(0, rows, moved.detach())


def export(model: Any, out: Path) -> None:
    """Write `model` in half precision, its configuration and how pictures are normalised."""
    from safetensors.torch import save_file

    weights = {name: tensor.detach().half().contiguous() for name, tensor in model.state_dict().items()}
    with atomic_path(out / "model.safetensors") as path:
        save_file(weights, path, metadata={"format": "pt"})
    model.config.architectures = [type(model).__name__]
    model.config.save_pretrained(out)
    settings = {
        "image_processor_type": "CLIPImageProcessor",
        "image_mean": MEAN, "image_std": STD, "rescale_factor": 1 / 255,
        "do_center_crop": True, "do_convert_rgb": True, "do_normalize": True, "do_rescale": True,
        "do_resize": True, "resample": 2,
        "crop_size": {"height": CROP, "width": CROP}, "size": {"shortest_edge": CROP},
    }  # fmt: skip
    (out / "preprocessor_config.json").write_text(json.dumps(settings, indent=2) + "\n", encoding="utf-8")
