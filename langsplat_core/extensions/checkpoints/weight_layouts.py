"""Weights in other layouts than Hugging Face's; SigLIP, MetaCLIP 2, TIPS v2 and SAM 3 by transformers.

Tensors in the layouts of open_clip, OpenAI, segment_anything and sam2 are renamed to those of transformers.

The configuration of a model follows from the shapes of its tensors, except for the heads and the kind of
GELU, which an open_clip_config.json beside them states. Without one, CLIP's heads are 64 wide, at most 16 for
images, as published, and the GELU is OpenAI's quick one if the file has OpenAI's `input_resolution`,
`context_length` and `vocab_size`, or "quickgelu" or "openai" in its name, else the exact one. Windows and
heads of SAM 2 are those of the published sizes.
"""

import json
import math
import re
import string
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any, cast

import numpy as np
from PIL import Image

from langsplat_core.arrays import Array, unit
from langsplat_core.errors import EncoderError
from langsplat_core.semantics import encoders
from langsplat_core.semantics.sam import SAM3_PIXELS, Sam
from langsplat_core.semantics.weights import (
    OPEN_CLIP_CONFIG,
    Converted,
    Weights,
    load_config,
    load_model,
    loading_errors,
    weight_files,
)

Tensors = Mapping[str, Any]  # name -> torch.Tensor
Settings = dict[str, Any]  # as in a config.json of transformers
Names = tuple[tuple[str, str], ...]  # patterns of another layout's names, and their replacements

MOBILE_SAM = (
    "a MobileSAM, whose encoder TinyViT transformers does not have; pass sam_vit_b_01ec64.pth in its place, "
    "or for speed sam2.1_hiera_tiny.pt"
)
TIMM = "its image tower is timm's (PE-Core, MobileCLIP); pass facebook/metaclip-2-worldwide-b16 in its place"
HEAD_WIDTH, MOST_HEADS = 64, 16
SAM_HEADS = 8  # of the mask decoder, which do not follow from shapes
NOT_OURS = "open_clip's {part} states {name} {value!r}, which is not computed here"

CLIP_NAMES: Names = (
    (r"^visual\.class_embedding$", "vision_model.embeddings.class_embedding"),
    (r"^visual\.conv1\.weight$", "vision_model.embeddings.patch_embedding.weight"),
    (r"^visual\.positional_embedding$", "vision_model.embeddings.position_embedding.weight"),
    (r"^visual\.ln_pre\.", "vision_model.pre_layrnorm."),  # spelt so in transformers
    (r"^visual\.transformer\.resblocks\.", "vision_model.encoder.layers."),
    (r"^visual\.ln_post\.", "vision_model.post_layernorm."),
    (r"^visual\.proj$", "visual_projection.weight"),
    (r"^token_embedding\.", "text_model.embeddings.token_embedding."),
    (r"^positional_embedding$", "text_model.embeddings.position_embedding.weight"),
    (r"^transformer\.resblocks\.", "text_model.encoder.layers."),
    (r"^ln_final\.", "text_model.final_layer_norm."),
    (r"^text_projection$", "text_projection.weight"),
    (r"\.ln_(\d)\.", r".layer_norm\1."),
    (r"\.attn\.", ".self_attn."),
    (r"\.mlp\.c_fc\.", ".mlp.fc1."),
    (r"\.mlp\.c_proj\.", ".mlp.fc2."),
)
TRANSPOSED = ("text_projection", "visual.proj")
OPENAI = {"input_resolution", "context_length", "vocab_size"}  # numbers among OpenAI's weights
UNUSED = OPENAI | {"attn_mask"}
# Settings of open_clip_config.json that are read or follow from the shapes; and the names in transformers of
# those that are compared with the shapes.
STATED = {
    "model_cfg": {"embed_dim", "vision_cfg", "text_cfg", "quick_gelu", "custom_text", "init_logit_scale"},
    "vision_cfg": {"image_size", "patch_size", "width", "layers", "head_width", "mlp_ratio", "patch_dropout"},
    "text_cfg": {"context_length", "vocab_size", "width", "layers", "heads", "mlp_ratio"},
}
SAME = {
    "context_length": "max_position_embeddings", "width": "hidden_size", "layers": "num_hidden_layers",
    "image_size": "image_size", "patch_size": "patch_size", "vocab_size": "vocab_size",
}  # fmt: skip
WORLDWIDE = ("pool_type", "eos_id", "hf_tokenizer_name")  # of a MetaCLIP 2; its tokenizer.json has them too
# Values of other settings that have no effect.
USUAL: tuple[object, ...] = (None, False, 0, "", {}, "tok", "argmax", "linear")

SAM_NAMES: Names = (
    (r"^image_encoder\.", "vision_encoder."),
    (r"^vision_encoder\.blocks\.", "vision_encoder.layers."),
    (r"\.patch_embed\.proj\.", ".patch_embed.projection."),
    (r"\.norm(\d|_final_attn)\.", r".layer_norm\1."),
    (r"\.neck\.0\.", ".neck.conv1."),
    (r"\.neck\.1\.", ".neck.layer_norm1."),
    (r"\.neck\.2\.", ".neck.conv2."),
    (r"\.neck\.3\.", ".neck.layer_norm2."),
    (r"\.pe_layer\.positional_encoding_gaussian_matrix$", ".shared_embedding.positional_embedding"),
    (r"\.point_embeddings\.", ".point_embed."),
    (r"\.mask_downscaling\.0\.", ".mask_embed.conv1."),
    (r"\.mask_downscaling\.1\.", ".mask_embed.layer_norm1."),
    (r"\.mask_downscaling\.3\.", ".mask_embed.conv2."),
    (r"\.mask_downscaling\.4\.", ".mask_embed.layer_norm2."),
    (r"\.mask_downscaling\.6\.", ".mask_embed.conv3."),
    (r"\.output_upscaling\.0\.", ".upscale_conv1."),
    (r"\.output_upscaling\.1\.", ".upscale_layer_norm."),
    (r"\.output_upscaling\.3\.", ".upscale_conv2."),
    (r"(_head|_mlps\.\d)\.layers\.0\.", r"\1.proj_in."),
    (r"(_head|_mlps\.\d)\.layers\.1\.", r"\1.layers.0."),
    (r"(_head|_mlps\.\d)\.layers\.2\.", r"\1.proj_out."),
)
SAM2_NAMES: Names = (  # additional patterns of SAM 2
    (r"^vision_encoder\.trunk\.", "vision_encoder.backbone."),
    (r"(\.neck\.convs\.\d)\.conv\.", r"\1."),
    (r"\.mlp\.layers\.0\.", ".mlp.proj_in."),
    (r"\.mlp\.layers\.1\.", ".mlp.proj_out."),
    (r"\.out_proj\.", ".o_proj."),
    (r"^no_mem_embed$", "no_memory_embedding"),
)
SAM_GRID = "prompt_encoder.shared_embedding.positional_embedding"
SAM2_POINTS = [f"prompt_encoder.point_embeddings.{n}.weight" for n in range(4)]  # outside, inside, corners


@dataclass(frozen=True)
class Hiera:
    """Settings of a SAM 2's encoder that do not follow from shapes of tensors."""

    heads: int  # of the first stage; they double with the width
    windows: tuple[int, int, int, int]  # side by stage, in positions of its grid
    everywhere: tuple[int, ...]  # blocks that attend to the whole image


SAM2_SIZES: Mapping[tuple[int, int], Hiera] = MappingProxyType(  # by width of the first stage and blocks
    {
        (96, 12): Hiera(1, (8, 4, 14, 7), (5, 7, 9)),  # tiny
        (96, 16): Hiera(1, (8, 4, 14, 7), (7, 10, 13)),  # small
        (112, 24): Hiera(2, (8, 4, 14, 7), (12, 16, 20)),  # base plus
        (144, 48): Hiera(2, (8, 4, 16, 8), (23, 33, 43)),  # large
    }
)


def converted(
    id: str, file: Path, sizes: Mapping[tuple[int, int], Hiera] = SAM2_SIZES, side: int = 1024
) -> Converted | None:
    """Return weights with the names of transformers; None for an unknown layout.

    id: for messages; sizes, side: settings of a SAM 2 that do not follow from shapes, those of its encoder
    and the side of its square input, px. Raises EncoderError for a damaged file.
    """
    with loading_errors(id, "CLIP or SAM"):
        tensors = _read(id, file)
        if "image_encoder.pos_embed" in tensors:
            return Converted(_sam_config(tensors), _sam_tensors(tensors, SAM_NAMES), {})
        if "image_encoder.trunk.pos_embed" in tensors:
            own = {name.removeprefix("sam_"): tensor for name, tensor in tensors.items()}
            return Converted(_sam2_config(own, sizes, side), _sam2_tensors(own), {})
        if "image_encoder.patch_embed.seq.0.c.weight" in tensors:
            raise EncoderError(f"{id}: {MOBILE_SAM}")
        if any(name.startswith("visual.trunk.") for name in tensors):
            raise EncoderError(f"{id}: {TIMM}")
        return _clip(file, tensors) if "visual.class_embedding" in tensors else None


def _stored(path: Path) -> Any:
    """Return the content of a file of safetensors or torch; tensors are read on access. No code is run."""
    import torch
    from safetensors.torch import load_file

    if path.suffix == ".safetensors":
        return load_file(path)
    mapped = zipfile.is_zipfile(path)  # files from before PyTorch 1.6 are no archives
    return torch.load(path, map_location="cpu", weights_only=True, mmap=mapped)


def _read(id: str, file: Path) -> Tensors:
    """Return the tensors of a file, taken out of a checkpoint's dictionaries."""
    import torch

    parts = zipfile.ZipFile(file).namelist() if zipfile.is_zipfile(file) else []
    if any(name.endswith("/constants.pkl") for name in parts):
        raise EncoderError(
            f"{id}: a TorchScript archive, whose code would have to be run; pass the same weights in another "
            "layout, such as the hub id openai/clip-vit-base-patch16"
        )
    found = _stored(file)
    if file.suffix == ".safetensors":
        return found
    found = found.get("state_dict", found.get("model", found)) if isinstance(found, dict) else {}
    if not isinstance(found, dict):
        raise ValueError("it holds no named tensors")
    tensors = {name: tensor for name, tensor in found.items() if isinstance(tensor, torch.Tensor)}
    if any(tensor.nbytes > file.stat().st_size for tensor in tensors.values()):
        raise ValueError("a tensor claims more numbers than the file holds")
    return {str(name).removeprefix("module.").removeprefix("text."): tensors[name] for name in tensors}


def _clip(file: Path, tensors: Tensors) -> Converted:
    stated = _stated(file.parent / OPEN_CLIP_CONFIG)
    config = _clip_config(tensors)
    if stated:
        model = stated["model_cfg"]
        if model["text_cfg"].get("pool_type") == "eos":
            config["model_type"] = "metaclip_2"
            model["text_cfg"] = {k: value for k, value in model["text_cfg"].items() if k not in WORLDWIDE}
        _check(model, config)
        quick = bool(model.get("quick_gelu", False))
        head_width = int(model["vision_cfg"].get("head_width", HEAD_WIDTH))
        config["vision_config"]["num_attention_heads"] = config["vision_config"]["hidden_size"] // head_width
        config["text_config"]["num_attention_heads"] = int(model["text_cfg"].get("heads", 8))
    else:
        named = file.name.lower().replace("_", "").replace("-", "")
        quick = tensors.keys() >= OPENAI or "quickgelu" in named or "openai" in named
    for half in ("text_config", "vision_config"):
        config[half]["hidden_act"] = "quick_gelu" if quick else "gelu"
    pixels = stated.get("preprocess_cfg") or {}
    statistics = {f"image_{name}": pixels[name] for name in ("mean", "std") if name in pixels}
    return Converted(config, _clip_tensors(tensors), statistics)


def _stated(path: Path) -> Settings:
    """Return the content of open_clip_config.json; empty without the file."""
    if not path.is_file():
        return {}
    try:
        stated: Settings = json.loads(path.read_text(encoding="utf-8"))
        parts = [stated["model_cfg"], stated["model_cfg"]["vision_cfg"], stated["model_cfg"]["text_cfg"]]
        if all(isinstance(part, dict) for part in parts):
            return stated
    except (ValueError, LookupError, TypeError, RecursionError):
        pass
    raise ValueError(f"{path.name} states no model_cfg with vision_cfg and text_cfg")


def _clip_config(tensors: Tensors) -> Settings:
    words, wide = _shape(tensors, "token_embedding.weight", 2)
    channels, _, patch, _ = _shape(tensors, "visual.conv1.weight", 4)
    positions, _ = _shape(tensors, "visual.positional_embedding", 2)
    first = "transformer.resblocks.0.mlp.c_fc.weight"
    text = {
        "vocab_size": words,
        "hidden_size": wide,
        "intermediate_size": _shape(tensors, first, 2)[0],
        "num_hidden_layers": _count(tensors, r"transformer\.resblocks\.(\d+)\."),
        "num_attention_heads": wide // HEAD_WIDTH,
        "max_position_embeddings": _shape(tensors, "positional_embedding", 2)[0],
        "eos_token_id": 2,  # in transformers: the end token has the highest number, as in open_clip
    }
    vision = {
        "image_size": patch * round((positions - 1) ** 0.5),
        "patch_size": patch,
        "hidden_size": channels,
        "intermediate_size": _shape(tensors, f"visual.{first}", 2)[0],
        "num_hidden_layers": _count(tensors, r"visual\.transformer\.resblocks\.(\d+)\."),
        "num_attention_heads": min(channels // HEAD_WIDTH, MOST_HEADS),
    }
    size = _shape(tensors, "text_projection", 2)[1]
    return {"model_type": "clip", "projection_dim": size, "text_config": text, "vision_config": vision}


def _check(model: Settings, config: Settings) -> None:
    """Raise ValueError if open_clip_config.json states another network than that of the tensors."""
    for part, known in STATED.items():
        settings, found = model.get(part, model), config.get(part.replace("cfg", "config"), {})
        for name, value in settings.items():
            if name not in known and value not in USUAL:
                raise ValueError(NOT_OURS.format(part=part, name=name, value=value))
            number = found.get(SAME.get(name), value)
            if value != number:
                raise ValueError(f"{OPEN_CLIP_CONFIG} states {name} {value}, tensors have {number}")


def _renamed(tensors: Tensors, names: Names) -> dict[str, Any]:
    renamed = {}
    for old, tensor in tensors.items():
        name = old
        for pattern, by in names:
            name = re.sub(pattern, by, name)
        renamed[name] = tensor
    return renamed


def _clip_tensors(tensors: Tensors) -> dict[str, Any]:
    own = {name: tensor for name, tensor in tensors.items() if name not in UNUSED}
    own |= {name: own[name].T for name in TRANSPOSED if name in own}
    renamed = _renamed(own, CLIP_NAMES)
    if more := renamed.keys() & own.keys() - {"logit_scale"}:
        raise ValueError(f"{min(more)} is no tensor of a CLIP with a vision transformer")
    for name in [name for name in renamed if ".in_proj_" in name]:
        # open_clip has queries, keys and values in one tensor
        thirds = zip("qkv", renamed.pop(name).chunk(3), strict=True)
        renamed |= {name.replace(".in_proj_", f".{role}_proj."): third for role, third in thirds}
    return renamed


def _sam_tensors(tensors: Tensors, names: Names) -> dict[str, Any]:
    renamed = _renamed(tensors, names)
    renamed["shared_image_embedding.positional_embedding"] = renamed[SAM_GRID]
    return renamed


def _sam_config(tensors: Tensors) -> Settings:
    _, grid, _, wide = _shape(tensors, "image_encoder.pos_embed", 4)
    patch = _shape(tensors, "image_encoder.patch_embed.proj.weight", 4)[2]
    layers = _count(tensors, r"image_encoder\.blocks\.(\d+)\.")
    reach = [_shape(tensors, f"image_encoder.blocks.{n}.attn.rel_pos_h", 2) for n in range(layers)]
    everywhere = [n for n, (rows, _) in enumerate(reach) if rows == 2 * grid - 1]
    windows = [(rows + 1) // 2 for n, (rows, _) in enumerate(reach) if n not in everywhere]
    vision = {
        "image_size": grid * patch,
        "patch_size": patch,
        "hidden_size": wide,
        "num_hidden_layers": layers,
        "num_attention_heads": wide // reach[0][1],
        "mlp_dim": _shape(tensors, "image_encoder.blocks.0.mlp.lin1.weight", 2)[0],
        "output_channels": _shape(tensors, "image_encoder.neck.0.weight", 4)[0],
        "window_size": windows[0] if windows else 0,
        "global_attn_indexes": everywhere,
        "num_pos_feats": _shape(tensors, "prompt_encoder.pe_layer.positional_encoding_gaussian_matrix", 2)[1],
    }
    settings = _decoder_config(tensors, "lin1") | {"model_type": "sam", "vision_config": vision}
    settings["prompt_encoder_config"] |= {
        "image_size": grid * patch,
        "patch_size": patch,
        "image_embedding_size": grid,
    }
    return settings


def _decoder_config(tensors: Tensors, first: str) -> Settings:
    """Return settings of prompt encoder and mask decoder from shapes; first: name of an MLP's first layer."""
    tokens, size = _shape(tensors, "mask_decoder.mask_tokens.weight", 2)
    decoder = "mask_decoder.transformer.layers.0."
    narrow = _shape(tensors, f"{decoder}cross_attn_token_to_image.q_proj.weight", 2)[0]
    masks = {
        "hidden_size": size,
        "mlp_dim": _shape(tensors, f"{decoder}mlp.{first}.weight", 2)[0],
        "num_hidden_layers": _count(tensors, r"mask_decoder\.transformer\.layers\.(\d+)\."),
        "num_attention_heads": SAM_HEADS,
        "attention_downsample_rate": size // narrow,
        "num_multimask_outputs": tokens - 1,
        "iou_head_hidden_dim": _shape(tensors, "mask_decoder.iou_prediction_head.layers.0.weight", 2)[0],
    }
    channels = _shape(tensors, "prompt_encoder.mask_downscaling.3.weight", 4)[0]
    prompts = {"hidden_size": size, "mask_input_channels": channels}
    return {"prompt_encoder_config": prompts, "mask_decoder_config": masks}


def _sam2_tensors(tensors: Tensors) -> dict[str, Any]:
    """Return the tensors of a SAM 2 or 2.1 for single images, without its memory for videos.

    tensors: without the prefix "sam_" of prompt encoder and mask decoder.
    """
    import torch

    points = [tensors[name] for name in SAM2_POINTS if _shape(tensors, name, 2)]
    rest = {name: tensor for name, tensor in tensors.items() if name not in SAM2_POINTS}
    renamed = _sam_tensors(rest, SAM_NAMES + SAM2_NAMES)
    renamed["prompt_encoder.point_embed.weight"] = torch.cat(points)
    return renamed


def _sam2_config(tensors: Tensors, sizes: Mapping[tuple[int, int], Hiera], side: int) -> Settings:
    _, wide, *background = _shape(tensors, "image_encoder.trunk.pos_embed", 4)
    blocks = _count(tensors, r"image_encoder\.trunk\.blocks\.(\d+)\.")
    if (wide, blocks) not in sizes:
        raise ValueError(f"a SAM 2 of {blocks} blocks, {wide} wide, which is none of the published ones")
    size = sizes[wide, blocks]
    widths = [
        _shape(tensors, f"image_encoder.trunk.blocks.{n}.attn.proj.weight", 2)[0] for n in range(blocks)
    ]
    stages = sorted(set(widths))
    backbone = {
        "model_type": "sam2_hiera_det_model",
        "hidden_size": wide,
        "num_attention_heads": size.heads,
        "image_size": [side, side],
        "window_positional_embedding_background_size": background,
        "blocks_per_stage": [widths.count(width) for width in stages],
        "embed_dim_per_stage": stages,
        "num_attention_heads_per_stage": [size.heads * width // wide for width in stages],
        "window_size_per_stage": list(size.windows),
        "global_attention_blocks": list(size.everywhere),
    }
    vision = {
        "backbone_config": backbone,
        "backbone_channel_list": stages[::-1],
        "backbone_feature_sizes": [[side // step] * 2 for step in (4, 8, 16)],
        "fpn_hidden_size": _shape(tensors, "image_encoder.neck.convs.0.conv.weight", 4)[0],
    }
    settings = _decoder_config(tensors, "layers.0") | {"model_type": "sam2", "vision_config": vision}
    settings["prompt_encoder_config"]["image_size"] = side
    return settings


def _shape(tensors: Tensors, name: str, axes: int) -> tuple[int, ...]:
    found = tensors.get(name)
    if found is None or found.ndim != axes or not found.numel():
        raise ValueError(f"no {name} of {axes} axes among the tensors")
    return tuple(found.shape)


def _count(tensors: Tensors, pattern: str) -> int:
    """Return the count of distinct numbers in names that begin with `pattern`."""
    return len({found[1] for found in map(re.compile(pattern).match, tensors) if found})


# SigLIP (Zhai et al. 2023) and SigLIP 2 (Tschannen et al. 2025), trained with a sigmoid loss per pair.
#
# SigLIP 2's fixed-resolution checkpoints are SigLIP models with another vocabulary and the same `model_type`.
# A text's vector is that of its last token, padding or not, and no token is masked: a phrase is always padded
# to the length of training.
#
# Their logits are scale * cosine + bias, with a learned scale of 110 to 120 and a bias of -12 to -17. The
# bias reflects that of n^2 pairs in a batch only n are right; it cancels in relevancy, which depends on
# differences of cosines.

# Temperature of relevancy, as a share of a model's logit scale. LERF and LangSplat use 10 for CLIP, whose
# training caps the scale at 100. With a larger scale, training needs smaller gaps between cosines of right
# and wrong pairs, so a tenth of the scale gives two families similar relevancies. It is a rule of proportion
# and no calibration: verdicts need thresholds of their own.
SHARE_OF_SCALE = 0.1


class SiglipText(encoders.TorchText):
    """The text tower of a SigLIP in torch."""

    padded = True

    def __init__(self, weights: Weights) -> None:
        from transformers import SiglipTextModel as Model

        config = _siglip_config(weights).text_config
        super().__init__(Model, weights, config, "pooler_output", config.projection_size)
        scale = _logit_scale(weights)
        if not math.isfinite(scale):
            raise EncoderError(f"{weights.id}: not SigLIP weights: logit_scale is not in them")
        self.temperature = SHARE_OF_SCALE * math.exp(scale)
        # The first generation, with SentencePiece's unigram model, was trained without punctuation.
        gone = string.punctuation if type(self.tokenizer.model).__name__ == "Unigram" else ""
        self._without = str.maketrans("", "", gone)

    def encode(self, texts: list[str]) -> Array:
        """Return the vectors of texts, cleaned and in lower case as in its training."""
        lower = (encoders.clean_text(text).lower().translate(self._without) for text in texts)
        return super().encode([" ".join(text.split()) for text in lower])


def siglip_images(weights: Weights) -> encoders.ImageTower:
    """Return the image tower of a SigLIP in torch."""
    from transformers import SiglipVisionModel as Model

    usual = np.full((2, 3), 0.5)
    return encoders.Images(Model, weights, _siglip_config(weights).vision_config, "pooler_output", usual)


def _siglip_config(weights: Weights) -> Any:
    from transformers import SiglipConfig

    return load_config(SiglipConfig, weights, "SigLIP")


def _logit_scale(weights: Weights) -> float:
    """Return `logit_scale` without reading the other weights; NaN if missing, as in half a model."""
    with loading_errors(weights.id, "readable"):
        for path in weight_files(weights.folder):
            tensors = _stored(path)
            if "logit_scale" in tensors:
                return float(tensors["logit_scale"])
    return math.nan


SIGLIP = encoders.Family(SiglipText, siglip_images)


class MetaClip2Text(encoders.ClipText):
    """The text tower of a MetaCLIP 2 (Chuang et al. 2025), a CLIP for 300 languages."""

    def __init__(self, weights: Weights) -> None:
        super().__init__(weights, "MetaClip2", "")
        # XLM-V's tokenizer has a begin token, mT5's has only an end token; tokenizer.json defines them.
        self._begin = self.tokenizer.encode("").ids[:-1]
        self._model.text_model.eos_token_id = self._end[0]  # config.json may have that of a CLIP


METACLIP2 = encoders.Family(MetaClip2Text, partial(encoders.torch_clip_images, name="MetaClip2"))


class Tipsv2Text(encoders.TorchText):
    """The text tower of a TIPS v2 (Cao et al. 2026) in torch."""

    ends = False

    def __init__(self, weights: Weights) -> None:
        from transformers import Tipsv2Config, Tipsv2TextModel

        both = load_config(Tipsv2Config, weights, "TIPS v2")
        text = both.text_config
        super().__init__(Tipsv2TextModel, weights, text, "pooler_output", text.hidden_size)
        self.temperature = SHARE_OF_SCALE / both.temperature_init_value  # it is not in the weights

    def encode(self, texts: list[str]) -> Array:
        """Return the vectors of texts in lower case, as in its training."""
        return super().encode([text.lower() for text in texts])


class Tipsv2Images(encoders.Images):
    """The image tower of a TIPS v2 in torch; its pixels are not normalised."""

    def __init__(self, weights: Weights) -> None:
        from transformers import Tipsv2Config, Tipsv2VisionModel

        config = load_config(Tipsv2Config, weights, "TIPS v2").vision_config
        usual = np.array([[0.0] * 3, [1.0] * 3])
        super().__init__(Tipsv2VisionModel, weights, config, "pooler_output", usual)
        self.patch, self._before = int(config.patch_size), 1 + int(config.num_register_tokens)

    def patches(self, pixels: Array) -> Array:
        """Return (P, D) vectors of patches, row by row, of (1, 3, H, W) float32 pixels in whole patches."""
        return self.infer(pixels, "last_hidden_state")[0, self._before :]


class Tipsv2Encoder(encoders.Encoder):
    """Both halves of a TIPS v2: a region's vector is the mean over its pixels of their patches' vectors.

    An image is encoded once, its shorter side as long as in training, that of a panorama shorter.
    """

    def encode_regions(self, image: Array, label_maps: Array) -> Array:
        """Return one unit vector per region, see `features.embed_regions`."""
        tower = cast("Tipsv2Images", self._images)
        height, width = image.shape[:2]
        # A panorama's longer side is at most four times the length of training.
        scale = self.image_size / max(min(height, width), max(height, width) / 4) / tower.patch
        grid = [max(1, round(side * scale)) for side in (height, width)]
        size = grid[1] * tower.patch, grid[0] * tower.patch
        seen = Image.fromarray(image).resize(size, Image.Resampling.BILINEAR)
        patches = self._encode(np.asarray(seen)[None], tower.patches)
        rows, columns = (np.arange(side) * n // side for side, n in zip((height, width), grid, strict=True))
        cells = rows[:, None] * grid[1] + columns
        shape = int(label_maps.max()) + 1, len(patches)
        places = (labels[labels >= 0] * shape[1] + cells[labels >= 0] for labels in label_maps)
        pixels = sum(np.bincount(some, minlength=shape[0] * shape[1]) for some in places)
        return unit(np.asarray(pixels, np.float32).reshape(shape) @ patches)


TIPSV2 = encoders.Family(Tipsv2Text, Tipsv2Images, Tipsv2Encoder)


def load_sam3(weights: Weights) -> Sam:
    """Load the tracker of a SAM 3 (Carion et al. 2025), prompted with points, out of the video model."""
    from transformers import Sam3TrackerConfig, Sam3TrackerModel

    config = load_config(Sam3TrackerConfig, weights, "SAM 3")
    if hasattr(config, "tracker_config"):  # the encoder's settings are those of the detector
        with loading_errors(weights.id, "SAM 3"):
            vision = {"vision_config": config.detector_config["vision_config"]}
            config = Sam3TrackerConfig(**config.tracker_config | vision)
    model = load_model(Sam3TrackerModel, weights, config)
    # The coarsest map is for the detector; transformers would add the embedding of "no memory" to it.
    neck = model.vision_encoder.neck
    neck.fpn_layers = neck.fpn_layers[: len(model.backbone_feature_sizes)]
    side = int(model.config.prompt_encoder_config.image_size)
    return Sam("SAM 3", model, side, ordered=False, statistics=SAM3_PIXELS)
