"""Tiny models in the layouts of open_clip, segment_anything and sam2, and what open_clip computes.

Written from the papers and the names in published checkpoints, apart from the product's own tables.
"""

import json
import re
from pathlib import Path
from string import ascii_lowercase
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional
from transformers import CLIPTokenizer

SIDE, PATCH, CONTEXT, SIZE = 32, 8, 20, 24
MARKS = "'&"
LETTERS = ascii_lowercase + MARKS
TOKENS = [*LETTERS, *(f"{letter}</w>" for letter in LETTERS), "<|startoftext|>", "<|endoftext|>"]
BEGIN, END = len(TOKENS) - 2, len(TOKENS) - 1
Tensors = dict[str, Tensor]


def open_clip_tensors(vision: int = 128, text: int = 128, layers: int = 2, inner: int = 48) -> Tensors:
    """Random weights of a CLIP as open_clip names them; `vision` and `text`: widths of its halves."""
    made = torch.Generator().manual_seed(5)

    def random(*shape: int, scale: float = 0.1) -> Tensor:
        return torch.randn(*shape, generator=made) * scale

    def norm(name: str, wide: int) -> Tensors:
        return {f"{name}.weight": 1 + random(wide), f"{name}.bias": random(wide)}

    def blocks(prefix: str, wide: int) -> Tensors:
        found: Tensors = {}
        for number in range(layers):
            block = f"{prefix}transformer.resblocks.{number}."
            found |= norm(f"{block}ln_1", wide) | norm(f"{block}ln_2", wide)
            found[f"{block}attn.in_proj_weight"] = random(3 * wide, wide)
            found[f"{block}attn.in_proj_bias"] = random(3 * wide)
            for name, rows, columns in (
                ("attn.out_proj", wide, wide),
                ("mlp.c_fc", inner, wide),
                ("mlp.c_proj", wide, inner),
            ):
                found |= {f"{block}{name}.weight": random(rows, columns), f"{block}{name}.bias": random(rows)}
        return found

    return {
        "logit_scale": torch.tensor(4.6),
        "token_embedding.weight": random(len(TOKENS), text, scale=1),
        "positional_embedding": random(CONTEXT, text),
        "text_projection": random(text, SIZE),
        "visual.class_embedding": random(vision, scale=1),
        "visual.positional_embedding": random((SIDE // PATCH) ** 2 + 1, vision),
        "visual.conv1.weight": random(vision, 3, PATCH, PATCH),
        "visual.proj": random(vision, SIZE),
        **norm("ln_final", text),
        **norm("visual.ln_pre", vision),
        **norm("visual.ln_post", vision),
        **blocks("", text),
        **blocks("visual.", vision),
    }


def plain_texts(tensors: Tensors, phrases: list[str], heads: int, quick: bool) -> Tensor:
    """(M, SIZE) unit vectors of words that are spelled, one phrase at a time and without padding."""
    rows = []
    for phrase in phrases:
        letters = [letter for word in phrase.split() for letter in [*word[:-1], f"{word[-1]}</w>"]]
        ids = [BEGIN, *map(TOKENS.index, letters), END]
        x = tensors["token_embedding.weight"][ids] + tensors["positional_embedding"][: len(ids)]
        later = torch.full((len(ids), len(ids)), -torch.inf).triu(1)
        x = _norm(tensors, "ln_final", _blocks(tensors, "", x[:, None], heads, quick, later))
        rows.append(x[-1, 0] @ tensors["text_projection"])
    return functional.normalize(torch.stack(rows))


def plain_pictures(tensors: Tensors, pixels: Tensor, heads: int, quick: bool) -> Tensor:
    """(M, SIZE) unit vectors of (M, 3, SIDE, SIDE) normalised pictures."""
    patches = functional.conv2d(pixels, tensors["visual.conv1.weight"], stride=PATCH).flatten(2)
    first = tensors["visual.class_embedding"].expand(len(pixels), 1, -1)
    x = torch.cat([first, patches.transpose(1, 2)], 1) + tensors["visual.positional_embedding"]
    x = _norm(tensors, "visual.ln_pre", x).transpose(0, 1)
    x = _blocks(tensors, "visual.", x, heads, quick, None)[0]
    return functional.normalize(_norm(tensors, "visual.ln_post", x) @ tensors["visual.proj"])


def _blocks(tensors: Tensors, prefix: str, x: Tensor, heads: int, quick: bool, mask: Tensor | None) -> Tensor:
    number = 0
    while (block := f"{prefix}transformer.resblocks.{number}.") + "ln_1.weight" in tensors:
        y = _norm(tensors, f"{block}ln_1", x)
        x = (
            x
            + functional.multi_head_attention_forward(
                *(y, y, y, y.shape[-1], heads),
                *(tensors[f"{block}attn.in_proj_weight"], tensors[f"{block}attn.in_proj_bias"]),
                *(None, None, False, 0.0),
                *(tensors[f"{block}attn.out_proj.weight"], tensors[f"{block}attn.out_proj.bias"]),
                training=False,
                need_weights=False,
                attn_mask=mask,
            )[0]
        )
        y = _linear(tensors, f"{block}mlp.c_fc", _norm(tensors, f"{block}ln_2", x))
        y = y * torch.sigmoid(1.702 * y) if quick else functional.gelu(y)
        x = x + _linear(tensors, f"{block}mlp.c_proj", y)
        number += 1
    return x


def _norm(tensors: Tensors, name: str, x: Tensor) -> Tensor:
    return functional.layer_norm(x, x.shape[-1:], tensors[f"{name}.weight"], tensors[f"{name}.bias"])


def _linear(tensors: Tensors, name: str, x: Tensor) -> Tensor:
    return functional.linear(x, tensors[f"{name}.weight"], tensors[f"{name}.bias"])


def letter_tokenizer(folder: Path, old: bool = False) -> None:
    """A CLIP tokenizer that spells; `old`: as vocab.json and merges.txt."""
    numbers = {token: number for number, token in enumerate(TOKENS)}
    if old:
        (folder / "vocab.json").write_text(json.dumps(numbers), encoding="utf-8")
        (folder / "merges.txt").write_text("#version: 0.2\n", encoding="utf-8")
    else:
        CLIPTokenizer(vocab=numbers, merges=[]).save_pretrained(folder)


def open_clip_config(heads: int, head_width: int, quick: bool, layers: int = 2, wide: int = 128) -> Any:
    """The open_clip_config.json of `open_clip_tensors`."""
    vision = {
        "image_size": SIDE,
        "layers": layers,
        "width": wide,
        "patch_size": PATCH,
        "head_width": head_width,
    }
    text = {
        "context_length": CONTEXT,
        "vocab_size": len(TOKENS),
        "width": wide,
        "heads": heads,
        "layers": layers,
    }
    model = {"embed_dim": SIZE, "quick_gelu": quick, "vision_cfg": vision, "text_cfg": text}
    return {"model_cfg": model, "preprocess_cfg": {"mean": [0.5, 0.4, 0.3], "std": [0.2, 0.3, 0.25]}}


def segment_anything_tensors(model: Any) -> Tensors:
    """The weights of transformers' SamModel as segment_anything names them."""
    state = model.state_dict()
    grid = state.pop("shared_image_embedding.positional_embedding")
    assert torch.equal(grid, state["prompt_encoder.shared_embedding.positional_embedding"])
    found = {}
    for name, tensor in state.items():
        stem = max((stem for stem in SAM_STEMS if name.startswith(stem)), key=len, default="")
        found[SAM_STEMS.get(stem, "") + name.removeprefix(stem)] = tensor
    assert not any("layer_norm" in name or "vision" in name or "proj_" in name for name in found)
    return found


def sam2_tensors(model: Any) -> Tensors:
    """The weights of transformers' Sam2Model as sam2 names them, with some of its memory of films."""
    state = model.state_dict()
    grid = state.pop("shared_image_embedding.positional_embedding")
    assert torch.equal(grid, state["prompt_encoder.shared_embedding.positional_embedding"])
    points = state.pop("prompt_encoder.point_embed.weight")
    found = {f"sam_prompt_encoder.point_embeddings.{n}.weight": points[n : n + 1] for n in range(4)}
    for name, tensor in state.items():
        for pattern, by in SAM2_WORDS:
            name = re.sub(pattern, by, name)
        found[name] = tensor
    assert not any("layer_norm" in name or "vision" in name or "proj_" in name for name in found)
    films = ("maskmem_tpos_enc", "memory_attention.layers.0.norm1.weight", "mask_downsample.bias")
    return found | {name: torch.ones(3) for name in films}


SAM2_WORDS = (
    *(
        (rf"(_head|_mlps\.\d)\.{a}\.", rf"\1.layers.{n}.")
        for a, n in (("layers.0", 1), ("proj_in", 0), ("proj_out", 2))
    ),
    *((rf"\.mlp\.{a}\.", f".mlp.layers.{n}.") for a, n in (("proj_in", 0), ("proj_out", 1))),
    *(
        (rf"\.mask_embed\.{a}\.", f".mask_downscaling.{n}.")
        for a, n in (("conv1", 0), ("conv2", 3), ("conv3", 6))
    ),
    *((rf"\.mask_embed\.layer_norm{a}\.", f".mask_downscaling.{n}.") for a, n in ((1, 1), (2, 4))),
    *(
        (rf"\.upscale_{a}\.", f".output_upscaling.{n}.")
        for a, n in (("conv1", 0), ("layer_norm", 1), ("conv2", 3))
    ),
    (r"\.layer_norm(\d|_final_attn)\.", r".norm\1."),
    (r"\.o_proj\.", ".out_proj."),
    (r"\.shared_embedding\.positional_embedding", ".pe_layer.positional_encoding_gaussian_matrix"),
    (r"^vision_encoder\.neck\.convs\.(\d)\.", r"image_encoder.neck.convs.\1.conv."),
    (r"^vision_encoder\.backbone\.", "image_encoder.trunk."),
    (r"\.patch_embed\.projection\.", ".patch_embed.proj."),
    (r"^(prompt_en|mask_de)coder\.", r"sam_\1coder."),
    ("^no_memory_embedding$", "no_mem_embed"),
)


def _sam_stems() -> dict[str, str]:
    """How names begin in transformers -> in segment_anything; others begin alike."""
    stems = {
        "vision_encoder.": "image_encoder.",
        "vision_encoder.patch_embed.projection.": "image_encoder.patch_embed.proj.",
        "prompt_encoder.shared_embedding.positional_embedding": (
            "prompt_encoder.pe_layer.positional_encoding_gaussian_matrix"
        ),
        "prompt_encoder.point_embed.": "prompt_encoder.point_embeddings.",
        "mask_decoder.transformer.layer_norm_final_attn.": "mask_decoder.transformer.norm_final_attn.",
    }
    for number, name in enumerate(("conv1", "layer_norm1", "conv2", "layer_norm2")):
        stems[f"vision_encoder.neck.{name}."] = f"image_encoder.neck.{number}."
    for number, name in ((0, "conv1"), (1, "layer_norm1"), (3, "conv2"), (4, "layer_norm2"), (6, "conv3")):
        stems[f"prompt_encoder.mask_embed.{name}."] = f"prompt_encoder.mask_downscaling.{number}."
    for number, name in ((0, "conv1"), (1, "layer_norm"), (3, "conv2")):
        stems[f"mask_decoder.upscale_{name}."] = f"mask_decoder.output_upscaling.{number}."
    for head in ("iou_prediction_head", *(f"output_hypernetworks_mlps.{k}" for k in range(4))):
        for number, name in enumerate(("proj_in", "layers.0", "proj_out")):
            stems[f"mask_decoder.{head}.{name}."] = f"mask_decoder.{head}.layers.{number}."
    for layer in range(2):
        stems[f"vision_encoder.layers.{layer}."] = f"image_encoder.blocks.{layer}."
        for norm in range(1, 5):
            block, deep = f"blocks.{layer}.norm{norm}.", f"layers.{layer}.layer_norm{norm}."
            stems[f"vision_encoder.{deep}"] = f"image_encoder.{block}"
            stems[f"mask_decoder.transformer.{deep}"] = f"mask_decoder.transformer.layers.{layer}.norm{norm}."
    return stems


SAM_STEMS = _sam_stems()
