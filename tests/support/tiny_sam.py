"""Segmenters small enough to be made while a test runs, in the layout of Hugging Face."""

from pathlib import Path
from typing import Any

import torch
from transformers import (
    Sam2Config,
    Sam2HieraDetConfig,
    Sam2Model,
    Sam2VideoConfig,
    Sam2VideoModel,
    Sam2VisionConfig,
    SamConfig,
    SamModel,
)

SIDE = 64
DECODER = {
    "hidden_size": 16,
    "mlp_dim": 16,
    "num_attention_heads": 2,
    "iou_head_hidden_dim": 16,
    "num_hidden_layers": 2,
}
PROMPTS = {"hidden_size": 16, "image_size": SIDE, "patch_size": 16}
ENCODER = {
    "image_size": SIDE,
    "patch_size": 16,
    "hidden_size": 16,
    "num_hidden_layers": 2,
    "num_attention_heads": 2,
    "mlp_dim": 16,
    "output_channels": 16,
    "window_size": 2,
    "global_attn_indexes": [1],
    "num_pos_feats": 8,
}


def tiny_sam(folder: Path, decoder_heads: int = 2) -> SamModel:
    """A SAM with random weights that answers every point differently."""
    prompts = PROMPTS | {"image_embedding_size": SIDE // 16}
    decoder = DECODER | {"num_attention_heads": decoder_heads}
    config = SamConfig(vision_config=ENCODER, prompt_encoder_config=prompts, mask_decoder_config=decoder)
    return _saved(SamModel, config, folder, seed=9)


def sam2_vision() -> Sam2VisionConfig:
    """A Hiera of four stages, one of them with a block that attends everywhere, and its pyramid."""
    backbone = Sam2HieraDetConfig(
        hidden_size=8,
        image_size=[SIDE, SIDE],
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
        backbone_feature_sizes=[[SIDE // 4] * 2, [SIDE // 8] * 2, [SIDE // 16] * 2],
        fpn_hidden_size=16,
    )


def tiny_sam2(folder: Path, decoder_heads: int = 2) -> Sam2Model:
    """A SAM 2 likewise."""
    decoder = DECODER | {"num_attention_heads": decoder_heads}
    config = Sam2Config(
        vision_config=sam2_vision(), prompt_encoder_config=PROMPTS, mask_decoder_config=decoder
    )
    return _saved(Sam2Model, config, folder, seed=4)


def tiny_sam2_video(folder: Path) -> Sam2VideoModel:
    """The same with the memory of the video model, as the hub has SAM 2.1."""
    config = Sam2VideoConfig(
        vision_config=sam2_vision(),
        prompt_encoder_config=PROMPTS,
        mask_decoder_config=DECODER,
        image_size=SIDE,
        memory_attention_hidden_size=16,
        memory_attention_num_layers=1,
        memory_attention_feed_forward_hidden_size=16,
        memory_attention_rope_feat_sizes=[4, 4],
        memory_encoder_hidden_size=16,
        memory_encoder_output_channels=4,
        mask_downsampler_embed_dim=16,
        memory_fuser_embed_dim=16,
        memory_fuser_intermediate_dim=16,
    )
    return _saved(Sam2VideoModel, config, folder, seed=4)


def _saved(kind: Any, config: Any, folder: Path, seed: int) -> Any:
    torch.manual_seed(seed)
    model = kind(config).eval()
    with torch.no_grad():  # large enough weights that masks differ from point to point
        for parameter in model.mask_decoder.parameters():
            parameter.add_(torch.randn_like(parameter) * 0.4)
        for parameter in model.prompt_encoder.parameters():
            parameter.mul_(20)
    model.save_pretrained(folder)
    return model
