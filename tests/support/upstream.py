"""The field's own packages, open_clip, segment_anything and sam2, with random weights at full size.

`make parity` puts them into a folder beside the environment, without what they depend on: torchvision as PyPI
has it is compiled for CUDA, so that beside the CPU build of torch its compiled part does not load and its
import fails. What these packages need of that part is the suppression of boxes, which is written here.
"""

import importlib
import json
import re
import warnings
from collections.abc import Callable, Mapping
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

NAMES = ("torchvision", "open_clip", "segment_anything", "sam2", "cv2")
ENDS = {"<start_of_text>": "<|startoftext|>", "<end_of_text>": "<|endoftext|>"}  # as the hub names them
SCALES = {"pos": 0.3, "rel_": 0.3, "token": 0.3, "no_mem": 0.3, "latent": 0.3, "class_embedding": 0.3}
SIGLIP = (  # patterns of open_clip's names -> of transformers'
    (r"^visual\.trunk\.blocks\.", "vision_model.encoder.layers."),
    (r"^visual\.trunk\.norm\.", "vision_model.post_layernorm."),
    (r"^visual\.trunk\.patch_embed\.proj\.", "vision_model.embeddings.patch_embedding."),
    (r"^visual\.trunk\.pos_embed$", "vision_model.embeddings.position_embedding.weight"),
    (r"^visual\.trunk\.attn_pool\.latent$", "vision_model.head.probe"),
    (r"^visual\.trunk\.attn_pool\.proj\.", "vision_model.head.attention.out_proj."),
    (r"^visual\.trunk\.attn_pool\.norm\.", "vision_model.head.layernorm."),
    (r"^visual\.trunk\.attn_pool\.", "vision_model.head."),
    (r"^text\.positional_embedding$", "text_model.embeddings.position_embedding.weight"),
    (r"^text\.token_embedding\.", "text_model.embeddings.token_embedding."),
    (r"^text\.transformer\.resblocks\.", "text_model.encoder.layers."),
    (r"^text\.ln_final\.", "text_model.final_layer_norm."),
    (r"^text\.text_projection\.", "text_model.head."),
    (r"(layers\.\d+)\.(?:norm|ln_)(\d)\.", r"\1.layer_norm\2."),
    (r"\.mlp\.c_fc\.", ".mlp.fc1."),
    (r"\.mlp\.c_proj\.", ".mlp.fc2."),
    (r"\.attn\.(?:out_)?proj\.", ".self_attn.out_proj."),
    (r"\.attn\.(?:qkv\.|in_proj_)", ".self_attn.{}_proj."),
)


@cache
def upstream() -> SimpleNamespace:
    """The packages as attributes; without them the test is skipped."""
    if missing := [name for name in NAMES if find_spec(name) is None]:
        pytest.skip(f"no {', '.join(missing)}: run `make parity`")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of what they themselves import
        try:
            boxes = importlib.import_module("torchvision.ops.boxes")
        except RuntimeError:  # operator torchvision::nms does not exist
            for name in ("nms", "qnms"):
                torch.library.define(f"torchvision::{name}", "(Tensor a, Tensor b, float iou) -> Tensor")
            boxes = importlib.import_module("torchvision.ops.boxes")
            boxes.nms = plain_nms  # type: ignore[attr-defined]
        for part in (
            "segment_anything.automatic_mask_generator",
            "sam2.build_sam",
            "sam2.sam2_image_predictor",
        ):
            importlib.import_module(part)
        return SimpleNamespace(**{name: importlib.import_module(name) for name in NAMES})


def plain_nms(boxes: torch.Tensor, scores: torch.Tensor, iou_threshold: float) -> torch.Tensor:
    """As torchvision's nms: (K,) indices of the (M, 4) boxes that stay, by falling score."""
    area = (boxes[:, 2:] - boxes[:, :2]).prod(1)
    order, kept = torch.sort(scores, stable=True, descending=True).indices, []
    while len(order):
        best, order = order[0], order[1:]
        kept.append(best)
        corner = torch.maximum(boxes[best, :2], boxes[order, :2])
        common = (torch.minimum(boxes[best, 2:], boxes[order, 2:]) - corner).clamp(min=0).prod(1)
        order = order[~(common / (area[best] + area[order] - common) > iou_threshold)]
    return torch.stack(kept) if kept else torch.zeros(0, dtype=torch.int64)


def scrambled(build: Callable[..., Any], *arguments: str, **options: str) -> Any:
    """A model with random weights, none of which is left at zero or one as some are when it is made."""
    torch.manual_seed(0)
    model = build(*arguments, **options)
    with torch.no_grad():
        for name, weight in model.named_parameters():
            scale = next((SCALES[word] for word in SCALES if word in name), None)
            if scale is not None:
                weight.normal_(0, scale)
            elif weight.ndim > 1:
                weight.normal_(0, weight[0].numel() ** -0.5)  # signals stay as large as they are
            elif weight.ndim == 1:
                weight.add_(torch.randn_like(weight) * 0.1)
    return model.eval()


def save_clip(name: str, model: Any, folder: Path) -> None:
    """A CLIP of open_clip as its hub folders hold it, with OpenAI's words in the hub's two older files."""
    open_clip = upstream().open_clip
    torch.save(model.state_dict(), folder / "open_clip_pytorch_model.bin")
    stated = {"model_cfg": open_clip.get_model_config(name), "preprocess_cfg": {}}
    (folder / "open_clip_config.json").write_text(json.dumps(stated), encoding="utf-8")
    words = open_clip.get_tokenizer(name)
    numbers = {ENDS.get(token, token): number for token, number in words.encoder.items()}
    (folder / "vocab.json").write_text(json.dumps(numbers), encoding="utf-8")
    merges = "\n".join(" ".join(pair) for pair in words.bpe_ranks)
    (folder / "merges.txt").write_text(f"#version: 0.2\n{merges}\n", encoding="utf-8")


def siglip_tensors(tensors: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """The weights of a SigLIP as open_clip names them, as transformers does."""
    found: dict[str, torch.Tensor] = {}
    for name, tensor in tensors.items():
        for pattern, by in SIGLIP:
            name = re.sub(pattern, by, name)
        thirds = zip("qkv", tensor.chunk(3), strict=True) if "{}" in name else [("", tensor)]
        found |= {name.format(role): part.squeeze(0) if "position" in name else part for role, part in thirds}
    for part in ("weight", "bias"):
        query, rest = (found.pop(f"vision_model.head.{name}.{part}") for name in ("q", "kv"))
        found[f"vision_model.head.attention.in_proj_{part}"] = torch.cat([query, rest])
    return found
