"""Encoders, segmenters (in Hugging Face's layout) and a room, small enough to be made while a test runs."""

import json
import os
from collections.abc import Callable
from pathlib import Path
from string import ascii_lowercase, digits
from typing import Any

import numpy as np
import torch
from PIL import Image
from safetensors.torch import save_file
from tokenizers import Tokenizer, models, normalizers, pre_tokenizers, processors
from transformers import (
    CLIPConfig,
    CLIPModel,
    CLIPTokenizer,
    MetaClip2Config,
    MetaClip2Model,
    Sam2Config,
    Sam2HieraDetConfig,
    Sam2Model,
    Sam2VideoConfig,
    Sam2VideoModel,
    Sam2VisionConfig,
    Sam3LiteTextConfig,
    Sam3LiteTextModel,
    Sam3VideoConfig,
    Sam3VideoModel,
    SamConfig,
    SamModel,
    Siglip2Tokenizer,
    SiglipConfig,
    SiglipModel,
    Tipsv2Config,
    Tipsv2Model,
    Tipsv2Tokenizer,
)

from langsplat_core.config import (
    ClipConfig,
    CodecConfig,
    DatasetConfig,
    MaskConfig,
    RadianceConfig,
    TrainConfig,
)
from langsplat_core.raster.render import render
from langsplat_core.scene import Scene, look_at
from tests.support.scenes import random_gaussians, transforms

TOWER = {"hidden_size": 32, "intermediate_size": 48, "num_hidden_layers": 2, "num_attention_heads": 2}


class MakesFolder:
    """Unpickling it makes a folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def __reduce__(self) -> tuple[object, tuple[str]]:
        return os.mkdir, (str(self.folder),)


def _saved(kind: Any, config: Any, folder: Path, seed: int, alter: Callable[[Any], None]) -> Any:
    """A model with random weights, some of them altered."""
    torch.manual_seed(seed)
    model = kind(config).eval()
    with torch.no_grad():
        alter(model)
    model.save_pretrained(folder)
    return model


# -- image-text encoders -------------------------------------------------------------------------------------

WORDS = ["red", "green", "mug", "apple", "handle", "object", "things"]
SIDE = 32
LENGTH = 40  # tokens that every phrase is padded to by SigLIP
SCALE, BIAS = 110.0, -12.5


def change_json(path: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """Write a JSON file anew with what `change` has done to its content."""
    content = json.loads(path.read_text(encoding="utf-8"))
    change(content)
    path.write_text(json.dumps(content), encoding="utf-8")


def spelling_text(folder: Path, length: int) -> dict[str, Any]:
    """Settings of a CLIP's text tower of two narrow layers that spells, and its tokenizer in the folder."""
    letters = ascii_lowercase + digits
    tokens = ["<|startoftext|>", "<|endoftext|>", *letters, *(f"{letter}</w>" for letter in letters)]
    CLIPTokenizer(vocab={token: i for i, token in enumerate(tokens)}, merges=[]).save_pretrained(folder)
    text = TOWER | {"vocab_size": len(tokens), "max_position_embeddings": length}
    return text | {"bos_token_id": 0, "eos_token_id": 1, "pad_token_id": 1}


def tiny_clip(folder: Path, half: bool = False) -> CLIPModel:
    """A CLIP of two narrow layers that spells. It reads every everyday phrase whole, and no marks."""
    vision = TOWER | {"image_size": SIDE, "patch_size": 8}
    config = CLIPConfig(text_config=spelling_text(folder, 40), vision_config=vision, projection_dim=24)
    return _saved(CLIPModel, config, folder, 0, lambda model: model.half() if half else None).float()


def unigram_tokenizer(folder: Path, template: str = "$A </s>") -> int:
    """SigLIP's: SentencePiece unigram, end and padding in one token; returns the size of its vocabulary."""
    pieces = [("<pad>", 0.0), ("</s>", 0.0), ("<unk>", -9.0), ("▁", -2.0), ("▁red", -1.0), ("▁mug", -1.0)]
    pieces += [(letter, -3.0) for letter in ascii_lowercase] + [("<s>", 0.0)]
    tokenizer = Tokenizer(models.Unigram(pieces, unk_id=2, byte_fallback=False))
    tokenizer.normalizer = normalizers.Lowercase()
    tokenizer.pre_tokenizer = pre_tokenizers.Metaspace()
    ends = [("</s>", 1), ("<s>", len(pieces) - 1)]
    tokenizer.post_processor = processors.TemplateProcessing(template, special_tokens=ends)
    folder.mkdir(parents=True, exist_ok=True)
    tokenizer.save(str(folder / "tokenizer.json"))
    stated = {"tokenizer_class": "SiglipTokenizer", "eos_token": "</s>", "model_max_length": 64}
    stated |= {"pad_token": {"__type": "AddedToken", "content": "</s>"}}  # type: ignore[dict-item]
    (folder / "tokenizer_config.json").write_text(json.dumps(stated), encoding="utf-8")
    return len(pieces)


def gemma_tokenizer(folder: Path) -> int:
    """SigLIP 2's: byte pairs, an end token and another one for padding; else as `unigram_tokenizer`."""
    special = ["<pad>", "<eos>", "<bos>", "<unk>", "<mask>"]
    pieces = [*special, "▁", *ascii_lowercase, "re", "red", "mu", "mug"]
    Siglip2Tokenizer(
        vocab={piece: i for i, piece in enumerate(pieces)},
        merges=[("r", "e"), ("re", "d"), ("m", "u"), ("mu", "g")],  # type: ignore[arg-type]
        add_bos_token=False,
        add_eos_token=True,
        padding_side="right",
    ).save_pretrained(folder)
    return len(pieces)


def tiny_siglip(folder: Path, second: bool = False) -> SiglipModel:
    """A SigLIP, or with `second` a SigLIP 2 of fixed resolution, with random weights."""
    words = (gemma_tokenizer if second else unigram_tokenizer)(folder)
    config = SiglipConfig(
        text_config=TOWER | {"vocab_size": words, "max_position_embeddings": LENGTH, "projection_size": 32},
        vision_config=TOWER | {"image_size": SIDE, "patch_size": 8},
    )

    def scaled(model: SiglipModel) -> None:
        model.logit_scale.fill_(torch.tensor(SCALE).log())
        model.logit_bias.fill_(BIAS)

    return _saved(SiglipModel, config, folder, 3, scaled)


def tiny_metaclip2(folder: Path, template: str = "<s> $A </s>") -> MetaClip2Model:
    """A MetaCLIP 2 with XLM-V's marks around a phrase, or those of another `template`, as mT5's."""
    text = TOWER | {"vocab_size": unigram_tokenizer(folder, template), "max_position_embeddings": LENGTH}
    vision = TOWER | {"image_size": SIDE, "patch_size": 8}
    config = MetaClip2Config(text_config=text | {"eos_token_id": 1}, vision_config=vision, projection_dim=24)
    return _saved(MetaClip2Model, config, folder, 6, lambda model: None)


def tiny_tipsv2(folder: Path) -> Tipsv2Model:
    """A TIPS v2, whose phrases have no token at either end."""
    pieces = ["<pad>", "<unk>", "▁", *ascii_lowercase, "re", "red"]
    vocabulary = {piece: i for i, piece in enumerate(pieces)}
    Tipsv2Tokenizer(vocab=vocabulary, merges=[("r", "e"), ("re", "d")]).save_pretrained(folder)
    config = Tipsv2Config(
        text_config=TOWER | {"vocab_size": len(pieces), "max_position_embeddings": LENGTH},
        vision_config=TOWER | {"image_size": SIDE, "patch_size": 8},
    )
    return _saved(Tipsv2Model, config, folder, 7, lambda model: None)


# -- segmenters, which answer every point differently --------------------------------------------------------

SAM_SIDE = 64
LAYERS = {"hidden_size": 16, "num_attention_heads": 2, "num_hidden_layers": 2, "mlp_dim": 16}
DECODER = LAYERS | {"iou_head_hidden_dim": 16}
PROMPTS = {"hidden_size": 16, "image_size": SAM_SIDE, "patch_size": 16}
ENCODER = LAYERS | {
    "image_size": SAM_SIDE,
    "patch_size": 16,
    "output_channels": 16,
    "window_size": 2,
    "global_attn_indexes": [1],
    "num_pos_feats": 8,
}


def tiny_sam(folder: Path, decoder_heads: int = 2) -> SamModel:
    """A SAM with random weights."""
    prompts = PROMPTS | {"image_embedding_size": SAM_SIDE // 16}
    decoder = DECODER | {"num_attention_heads": decoder_heads}
    config = SamConfig(vision_config=ENCODER, prompt_encoder_config=prompts, mask_decoder_config=decoder)
    return _saved(SamModel, config, folder, 9, _tell_points_apart)


def _sam2_vision() -> Sam2VisionConfig:
    """A Hiera of four stages, one of them with a block that attends everywhere, and its pyramid."""
    backbone = Sam2HieraDetConfig(
        hidden_size=8,
        image_size=[SAM_SIDE, SAM_SIDE],
        blocks_per_stage=[1, 1, 2, 1],
        embed_dim_per_stage=[8, 16, 32, 64],
        num_attention_heads_per_stage=[1, 2, 4, 8],
        window_size_per_stage=[8, 4, 4, 2],
        window_positional_embedding_background_size=[2, 2],
        global_attention_blocks=[3],
    )
    return Sam2VisionConfig(
        backbone_config=backbone,
        backbone_channel_list=[64, 32, 16, 8],
        backbone_feature_sizes=[[SAM_SIDE // part] * 2 for part in (4, 8, 16)],
        fpn_hidden_size=16,
    )


def tiny_sam2(folder: Path, decoder_heads: int = 2) -> Sam2Model:
    """A SAM 2 likewise."""
    decoder = DECODER | {"num_attention_heads": decoder_heads}
    config = Sam2Config(
        vision_config=_sam2_vision(), prompt_encoder_config=PROMPTS, mask_decoder_config=decoder
    )
    return _saved(Sam2Model, config, folder, 4, _tell_points_apart)


MEMORY: dict[str, Any] = {
    **{f"memory_attention_{name}": 16 for name in ("hidden_size", "feed_forward_hidden_size")},
    **{f"memory_{name}": 16 for name in ("encoder_hidden_size", "fuser_embed_dim", "fuser_intermediate_dim")},
    "memory_attention_num_layers": 1,
    "memory_attention_rope_feat_sizes": [4, 4],
    "memory_encoder_output_channels": 4,
    "mask_downsampler_embed_dim": 16,
    "image_size": SAM_SIDE,
}


def tiny_sam2_video(folder: Path) -> Sam2VideoModel:
    """The same with the memory of the video model, as the hub has SAM 2.1."""
    config = Sam2VideoConfig(
        vision_config=_sam2_vision(), prompt_encoder_config=PROMPTS, mask_decoder_config=DECODER, **MEMORY
    )
    return _saved(Sam2VideoModel, config, folder, 4, _tell_points_apart)


def _detector(folder: Path, length: int) -> dict[str, Any]:
    """Settings of the half of a SAM 3 that reads phrases of so many tokens."""
    encoder = TOWER | {"image_size": SAM_SIDE, "patch_size": 16, "window_size": 2, "global_attn_indexes": [1]}
    vision = {
        "backbone_config": encoder | {"model_type": "sam3_vit_model", "pretrain_image_size": SAM_SIDE // 2},
        "backbone_feature_sizes": [[SAM_SIDE // part] * 2 for part in (4, 8, 16)],
        "fpn_hidden_size": 16,
    }
    layer = {"hidden_size": 16, "num_attention_heads": 2, "num_layers": 1, "intermediate_size": 16}
    parts = ("geometry_encoder_config", "detr_encoder_config", "detr_decoder_config", "mask_decoder_config")
    towers = {"vision_config": vision, "text_config": spelling_text(folder, length)}
    return towers | dict.fromkeys(parts, layer)


def _sure(detector: Any) -> None:
    """Let a detector find much, and all of it somewhere else."""
    for parameter in detector.parameters():
        parameter.add_(torch.randn_like(parameter) * 0.2)
    detector.detr_decoder.presence_head.layer3.bias.fill_(9)


def tiny_sam3_lite(folder: Path) -> Sam3LiteTextModel:
    """A SAM 3 with the text encoder of a MobileCLIP; phrases of 16 tokens."""
    return _saved(Sam3LiteTextModel, Sam3LiteTextConfig(**_detector(folder, 16)), folder, 14, _sure)


def tiny_sam3(folder: Path) -> Sam3VideoModel:
    """The whole of a SAM 3, as the hub has it: a detector, and a tracker with a neck of its own."""
    detector = _detector(folder, 40)
    tracker = {"prompt_encoder_config": PROMPTS, "mask_decoder_config": DECODER}
    tracker |= MEMORY | {"vision_config": detector["vision_config"]}
    config = Sam3VideoConfig(detector_config=detector, tracker_config=tracker)
    torch.manual_seed(8)
    model = Sam3VideoModel(config).eval()
    with torch.no_grad():
        _tell_points_apart(model.tracker_model)
        model.tracker_model.no_memory_embedding.normal_()
        _sure(model.detector_model)
    config.save_pretrained(folder)  # save_pretrained of the model names what is the tracker's otherwise
    save_file(model.state_dict(), folder / "model.safetensors", {"format": "pt"})
    return model


def _tell_points_apart(model: Any) -> None:
    """Large enough weights that masks differ from point to point."""
    for parameter in model.mask_decoder.parameters():
        parameter.add_(torch.randn_like(parameter) * 0.4)
    for parameter in model.prompt_encoder.parameters():
        parameter.mul_(20)


# -- photographs of a few large Gaussians, and settings with which they train in seconds ---------------------

SIZE = (64, 48)
VIEWS = 5


def tiny_room(folder: Path) -> Path:
    """A nerfstudio folder in the empty `folder`, and a tiny encoder in it."""
    (folder / "images").mkdir(parents=True)
    gaussians = random_gaussians(60, 5, scale_range=(0.15, 0.4))
    eyes = [3 * np.array([np.sin(angle), -0.2, -np.cos(angle)]) for angle in 0.5 * np.arange(VIEWS)]
    cameras = [look_at(eye, np.zeros(3), np.array([0.0, -1, 0]), SIZE) for eye in eyes]
    files = [f"images/photo_{index}.png" for index in range(VIEWS)]
    for file, camera in zip(files, cameras, strict=True):
        image = render(Scene(gaussians), camera).colours
        Image.fromarray((255 * np.clip(image, 0, 1)).astype(np.uint8)).save(folder / file)
    header = f"ply\nformat ascii 1.0\nelement vertex {len(gaussians)}\n"
    header += "".join(f"property float {axis}\n" for axis in "xyz") + "end_header\n"
    body = "".join("{} {} {}\n".format(*mean) for mean in gaussians.means)
    (folder / "points.ply").write_text(header + body)
    text = transforms(cameras, files, ply_file_path="points.ply", metres_per_unit=0.5)
    (folder / "transforms.json").write_text(text)
    tiny_clip(folder / "encoder")
    return folder


def tiny_settings(room: Path) -> TrainConfig:
    return TrainConfig(
        dataset=DatasetConfig(max_side=64, test_every=4, hold_out="every"),
        radiance=RadianceConfig(steps=20, sh_degree=0, checkpoint_every=5),
        masks=MaskConfig(source="graph"),
        clip=ClipConfig(model=str(room / "encoder"), device="cpu"),
        codec=CodecConfig(),
        phrases=("red mug",),
    )
