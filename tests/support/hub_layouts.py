"""Names and shapes of the weights in checkpoints of the hub, written down by hand.

One line a group: a kind, a name, sizes. `[n]` stands for each of 0 .. n - 1. A `linear` (or convolution) is
a weight and a bias as long as its first size, an `upward` convolution has one as long as its second, a `norm`
is two vectors, a `tensor` is itself.
"""

import re
from collections.abc import Iterator

DECODER = """
tensor mask_decoder.iou_token.weight 1 256
tensor mask_decoder.mask_tokens.weight 4 256
linear mask_decoder.transformer.layers.[2].self_attn.q_proj 256 256
linear mask_decoder.transformer.layers.[2].self_attn.k_proj 256 256
linear mask_decoder.transformer.layers.[2].self_attn.v_proj 256 256
linear mask_decoder.transformer.layers.[2].cross_attn_token_to_image.q_proj 128 256
linear mask_decoder.transformer.layers.[2].cross_attn_token_to_image.k_proj 128 256
linear mask_decoder.transformer.layers.[2].cross_attn_token_to_image.v_proj 128 256
linear mask_decoder.transformer.layers.[2].cross_attn_image_to_token.q_proj 128 256
linear mask_decoder.transformer.layers.[2].cross_attn_image_to_token.k_proj 128 256
linear mask_decoder.transformer.layers.[2].cross_attn_image_to_token.v_proj 128 256
norm mask_decoder.transformer.layers.[2].layer_norm1 256
norm mask_decoder.transformer.layers.[2].layer_norm2 256
norm mask_decoder.transformer.layers.[2].layer_norm3 256
norm mask_decoder.transformer.layers.[2].layer_norm4 256
linear mask_decoder.transformer.final_attn_token_to_image.q_proj 128 256
linear mask_decoder.transformer.final_attn_token_to_image.k_proj 128 256
linear mask_decoder.transformer.final_attn_token_to_image.v_proj 128 256
norm mask_decoder.transformer.layer_norm_final_attn 256
upward mask_decoder.upscale_conv1 256 64 2 2
upward mask_decoder.upscale_conv2 64 32 2 2
norm mask_decoder.upscale_layer_norm 64
linear mask_decoder.output_hypernetworks_mlps.[4].proj_in 256 256
linear mask_decoder.output_hypernetworks_mlps.[4].layers.[1] 256 256
linear mask_decoder.output_hypernetworks_mlps.[4].proj_out 32 256
linear mask_decoder.iou_prediction_head.proj_in 256 256
linear mask_decoder.iou_prediction_head.layers.[1] 256 256
linear mask_decoder.iou_prediction_head.proj_out 4 256
linear prompt_encoder.mask_embed.conv1 4 1 2 2
linear prompt_encoder.mask_embed.conv2 16 4 2 2
linear prompt_encoder.mask_embed.conv3 256 16 1 1
norm prompt_encoder.mask_embed.layer_norm1 4
norm prompt_encoder.mask_embed.layer_norm2 16
tensor prompt_encoder.no_mask_embed.weight 1 256
tensor prompt_encoder.not_a_point_embed.weight 1 256
tensor shared_image_embedding.positional_embedding 2 128
"""
SAM = """
linear mask_decoder.transformer.layers.[2].self_attn.out_proj 256 256
linear mask_decoder.transformer.layers.[2].cross_attn_token_to_image.out_proj 256 128
linear mask_decoder.transformer.layers.[2].cross_attn_image_to_token.out_proj 256 128
linear mask_decoder.transformer.final_attn_token_to_image.out_proj 256 128
linear mask_decoder.transformer.layers.[2].mlp.lin1 2048 256
linear mask_decoder.transformer.layers.[2].mlp.lin2 256 2048
tensor prompt_encoder.point_embed.[4].weight 1 256
tensor vision_encoder.pos_embed 1 64 64 1280
linear vision_encoder.patch_embed.projection 1280 3 16 16
norm vision_encoder.layers.[32].layer_norm1 1280
norm vision_encoder.layers.[32].layer_norm2 1280
linear vision_encoder.layers.[32].attn.qkv 3840 1280
linear vision_encoder.layers.[32].attn.proj 1280 1280
tensor vision_encoder.layers.[32].attn.rel_pos_h 27 80
tensor vision_encoder.layers.[32].attn.rel_pos_w 27 80
linear vision_encoder.layers.[32].mlp.lin1 5120 1280
linear vision_encoder.layers.[32].mlp.lin2 1280 5120
tensor vision_encoder.neck.conv1.weight 256 1280 1 1
norm vision_encoder.neck.layer_norm1 256
tensor vision_encoder.neck.conv2.weight 256 256 3 3
norm vision_encoder.neck.layer_norm2 256
"""
GLOBAL_ATTENTION = (7, 15, 23, 31)  # of SAM's layers: these look 64 patches far, not 14
SAM2 = """
linear mask_decoder.transformer.layers.[2].self_attn.o_proj 256 256
linear mask_decoder.transformer.layers.[2].cross_attn_token_to_image.o_proj 256 128
linear mask_decoder.transformer.layers.[2].cross_attn_image_to_token.o_proj 256 128
linear mask_decoder.transformer.final_attn_token_to_image.o_proj 256 128
linear mask_decoder.transformer.layers.[2].mlp.proj_in 2048 256
linear mask_decoder.transformer.layers.[2].mlp.proj_out 256 2048
linear mask_decoder.conv_s0 32 256 1 1
linear mask_decoder.conv_s1 64 256 1 1
tensor mask_decoder.obj_score_token.weight 1 256
linear mask_decoder.pred_obj_score_head.proj_in 256 256
linear mask_decoder.pred_obj_score_head.layers.[1] 256 256
linear mask_decoder.pred_obj_score_head.proj_out 1 256
tensor prompt_encoder.point_embed.weight 4 256
tensor prompt_encoder.shared_embedding.positional_embedding 2 128
tensor no_memory_embedding 1 1 256
"""
CLIP = """
tensor text_model.embeddings.token_embedding.weight 49408 512
tensor text_model.embeddings.position_embedding.weight 77 512
norm text_model.final_layer_norm 512
tensor text_projection.weight 512 512
tensor vision_model.embeddings.class_embedding 768
tensor vision_model.embeddings.patch_embedding.weight 768 3 16 16
tensor vision_model.embeddings.position_embedding.weight 197 768
norm vision_model.pre_layrnorm 768
norm vision_model.post_layernorm 768
tensor visual_projection.weight 512 768
tensor logit_scale
"""
SIGLIP = """
tensor text_model.embeddings.position_embedding.weight 64 768
norm text_model.final_layer_norm 768
linear text_model.head 768 768
linear vision_model.embeddings.patch_embedding 768 3 16 16
tensor vision_model.embeddings.position_embedding.weight 196 768
norm vision_model.post_layernorm 768
tensor vision_model.head.probe 1 1 768
tensor vision_model.head.attention.in_proj_weight 2304 768
tensor vision_model.head.attention.in_proj_bias 2304
linear vision_model.head.attention.out_proj 768 768
norm vision_model.head.layernorm 768
linear vision_model.head.mlp.fc1 3072 768
linear vision_model.head.mlp.fc2 768 3072
tensor logit_scale 1
tensor logit_bias 1
"""


def _transformer(prefix: str, width: int) -> str:
    """Twelve layers as CLIP and SigLIP name them."""
    layer = f"{prefix}.encoder.layers.[12]"
    lines = [f"linear {layer}.self_attn.{role}_proj {width} {width}" for role in ("q", "k", "v", "out")]
    lines += [f"linear {layer}.mlp.fc1 {4 * width} {width}", f"linear {layer}.mlp.fc2 {width} {4 * width}"]
    return "\n".join([*lines, f"norm {layer}.layer_norm1 {width}", f"norm {layer}.layer_norm2 {width}"])


def _hiera(widths: list[int], blocks: list[int]) -> str:
    """SAM 2's picture encoder: a stage's first block widens what it takes from the stage before."""
    lines = [f"linear vision_encoder.backbone.patch_embed.projection {widths[0]} 3 7 7"]
    lines += [f"tensor vision_encoder.backbone.pos_embed 1 {widths[0]} 7 7"]
    lines += [f"tensor vision_encoder.backbone.pos_embed_window 1 {widths[0]} 8 8"]
    number = 0
    for stage, (width, count) in enumerate(zip(widths, blocks, strict=True)):
        lines.append(f"linear vision_encoder.neck.convs.{stage} 256 {widths[3 - stage]} 1 1")
        for index in range(count):
            block = f"vision_encoder.backbone.blocks.{number}"
            before = widths[stage - 1] if stage and not index else width
            lines += [f"linear {block}.attn.qkv {3 * width} {before}"]
            lines += [f"linear {block}.attn.proj {width} {width}"]
            lines += [f"norm {block}.layer_norm1 {before}", f"norm {block}.layer_norm2 {width}"]
            lines += [f"linear {block}.mlp.proj_in {4 * width} {width}"]
            lines += [f"linear {block}.mlp.proj_out {width} {4 * width}"]
            lines += [f"linear {block}.proj {width} {before}"] if before != width else []
            number += 1
    return "\n".join(lines)


def _siglip(words: int) -> str:
    tokens = f"tensor text_model.embeddings.token_embedding.weight {words} 768\n"
    towers = [_transformer("text_model", 768), _transformer("vision_model", 768)]
    return SIGLIP + tokens + "\n".join(towers)


LAYOUTS = {
    "sam-vit-huge": DECODER + SAM,
    "sam2.1-hiera-tiny": DECODER + SAM2 + _hiera([96, 192, 384, 768], [1, 2, 7, 2]),
    "sam2.1-hiera-large": DECODER + SAM2 + _hiera([144, 288, 576, 1152], [2, 6, 36, 4]),
    "clip": CLIP + _transformer("text_model", 512) + "\n" + _transformer("vision_model", 768),
    "siglip": _siglip(32_000),
    "siglip2": _siglip(256_000),
}
# What a checkpoint holds besides: the video model's memory.
BESIDES = {
    "sam2.1-hiera-tiny": "memory_|mask_downsample|object_pointer|temporal_|no_memory_pos|no_object|occlusion",
}
BESIDES["sam2.1-hiera-large"] = BESIDES["sam2.1-hiera-tiny"]


def layout(name: str) -> dict[str, tuple[int, ...]]:
    """Name -> shape of the weights of one of `LAYOUTS`."""
    found: dict[str, tuple[int, ...]] = {}
    for line in LAYOUTS[name].split("\n"):
        if line:
            kind, pattern, *sizes = line.split()
            for each in _numbered(pattern):
                found |= dict(_tensors(kind, each, tuple(map(int, sizes))))
    if name == "sam-vit-huge":
        far = [f"vision_encoder.layers.{i}.attn.rel_pos_{axis}" for i in GLOBAL_ATTENTION for axis in "hw"]
        found |= dict.fromkeys(far, (127, 80))
    return found


def _numbered(pattern: str) -> Iterator[str]:
    many = re.search(r"\[(\d+)\]", pattern)
    if many is None:
        yield pattern
        return
    for i in range(int(many[1])):
        yield from _numbered(pattern[: many.start()] + str(i) + pattern[many.end() :])


def _tensors(kind: str, name: str, shape: tuple[int, ...]) -> Iterator[tuple[str, tuple[int, ...]]]:
    if kind == "tensor":
        yield name, shape
        return
    yield f"{name}.weight", shape
    yield f"{name}.bias", shape[1:2] if kind == "upward" else shape[:1]
