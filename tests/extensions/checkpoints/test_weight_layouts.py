"""Weights in the layouts of open_clip, segment_anything and sam2, and the encoders of SigLIP.

Written from the papers and the names in published checkpoints, apart from the product's own tables.
"""

import json
import re
import zipfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from string import ascii_lowercase
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from safetensors.torch import load_file, save_file
from torch import Tensor
from transformers import (
    CLIPConfig,
    CLIPModel,
    CLIPTokenizer,
    PreTrainedTokenizerFast,
    Siglip2Tokenizer,
    Tipsv2Tokenizer,
)

from langsplat_core.arrays import unit
from langsplat_core.errors import EncoderError, InputError
from langsplat_core.extensions.checkpoints.weight_layouts import Hiera, converted
from langsplat_core.semantics.encoders import CLIP_PIXELS, load_encoder, load_text_encoder
from langsplat_core.semantics.features import embed_regions
from langsplat_core.semantics.sam import FAMILIES, Segmenter, load_segmenter, load_text_segmenter
from langsplat_core.semantics.weights import Weights
from tests.support.tiny_models import (
    LENGTH,
    SAM_SIDE,
    SCALE,
    MakesFolder,
    tiny_clip,
    tiny_metaclip2,
    tiny_sam,
    tiny_sam2,
    tiny_sam3,
    tiny_sam3_lite,
    tiny_siglip,
    tiny_tipsv2,
)

pytestmark = pytest.mark.long

SIDE, PATCH, CONTEXT, SIZE = 32, 8, 20, 24
MARKS = "'&"
LETTERS = ascii_lowercase + MARKS
TOKENS = [*LETTERS, *(f"{letter}</w>" for letter in LETTERS), "<|startoftext|>", "<|endoftext|>"]
BEGIN, END = len(TOKENS) - 2, len(TOKENS) - 1
Tensors = dict[str, Tensor]


def clip_model(
    vision: int = 128, layers: int = 2, inner: int = 48, heads: tuple[int, int] = (2, 2), quick: bool = False
) -> CLIPModel:
    """A CLIP of transformers; vision: width of the half that sees; heads: of images and of text."""
    act = "quick_gelu" if quick else "gelu"
    half = {"intermediate_size": inner, "num_hidden_layers": layers, "hidden_act": act}
    text = {"hidden_size": 128, "num_attention_heads": heads[1], "vocab_size": len(TOKENS)}
    text |= {"bos_token_id": BEGIN, "eos_token_id": END, "pad_token_id": END}
    text |= {"max_position_embeddings": CONTEXT}
    seeing = {"hidden_size": vision, "num_attention_heads": heads[0], "image_size": SIDE, "patch_size": PATCH}
    torch.manual_seed(5)
    config = CLIPConfig(text_config=half | text, vision_config=half | seeing, projection_dim=SIZE)
    model = CLIPModel(config).eval()
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(torch.randn_like(parameter) * 0.1)
    return model


CLIP_WORDS = (
    (r"^vision_model\.embeddings\.class_embedding$", "visual.class_embedding"),
    (r"^vision_model\.embeddings\.patch_embedding\.", "visual.conv1."),
    (r"^vision_model\.embeddings\.position_embedding\.weight$", "visual.positional_embedding"),
    (r"^text_model\.embeddings\.token_embedding\.", "token_embedding."),
    (r"^text_model\.embeddings\.position_embedding\.weight$", "positional_embedding"),
    (r"^vision_model\.pre_layrnorm\.", "visual.ln_pre."),
    (r"^vision_model\.post_layernorm\.", "visual.ln_post."),
    (r"^text_model\.final_layer_norm\.", "ln_final."),
    (r"^vision_model\.encoder\.layers\.", "visual.transformer.resblocks."),
    (r"^text_model\.encoder\.layers\.", "transformer.resblocks."),
    (r"\.layer_norm(\d)\.", r".ln_\1."),
    (r"\.mlp\.fc1\.", ".mlp.c_fc."),
    (r"\.mlp\.fc2\.", ".mlp.c_proj."),
    (r"\.self_attn\.", ".attn."),
    (r"^visual_projection\.weight$", "visual.proj"),
    (r"^text_projection\.weight$", "text_projection"),
)


def open_clip_tensors(**sizes: int) -> Tensors:
    """The weights of `clip_model` as open_clip names them: queries, keys and values in one tensor."""
    found = {name: tensor.detach() for name, tensor in clip_model(**sizes).state_dict().items()}
    for pattern, by in CLIP_WORDS:
        found = {re.sub(pattern, by, name): tensor for name, tensor in found.items()}
    for name in [name for name in found if ".q_proj." in name]:
        thirds = [found.pop(name.replace(".q_proj.", f".{role}_proj.")) for role in "qkv"]
        found[name.replace(".q_proj.", ".in_proj_")] = torch.cat(thirds)
    for name in ("visual.proj", "text_projection"):
        found[name] = found[name].T.contiguous()
    return {name: tensor for name, tensor in found.items() if not name.endswith("position_ids")}


def letter_tokenizer(folder: Path) -> None:
    """A CLIP tokenizer that spells."""
    CLIPTokenizer(vocab={token: n for n, token in enumerate(TOKENS)}, merges=[]).save_pretrained(folder)


def segment_anything_tensors(model: Any) -> Tensors:
    """The weights of transformers' SamModel as segment_anything names them."""
    return renamed(model.state_dict(), SAM_WORDS + DECODER_WORDS)


def sam2_tensors(model: Any) -> Tensors:
    """The weights of transformers' Sam2Model as sam2 names them, with some of its memory of films."""
    state = model.state_dict()
    points = state.pop("prompt_encoder.point_embed.weight")
    found = {f"sam_prompt_encoder.point_embeddings.{n}.weight": points[n : n + 1] for n in range(4)}
    films = ("maskmem_tpos_enc", "memory_attention.layers.0.norm1.weight", "mask_downsample.bias")
    return found | renamed(state, DECODER_WORDS + SAM2_WORDS) | {name: torch.ones(3) for name in films}


def renamed(state: Tensors, words: tuple[tuple[str, str], ...]) -> Tensors:
    """`state` without its second grid, under other names; words: patterns, and what stands for them."""
    grid = state.pop("shared_image_embedding.positional_embedding")
    assert torch.equal(grid, state["prompt_encoder.shared_embedding.positional_embedding"])
    found = {}
    for name, tensor in state.items():
        for pattern, by in words:
            name = re.sub(pattern, by, name)
        found[name] = tensor
    assert not any("layer_norm" in name or "vision" in name or "proj_" in name for name in found)
    return found


def words(pattern: str, by: str, names: dict[str, int]) -> tuple[tuple[str, str], ...]:
    """A pattern and what stands for it, for each name and its number."""
    return tuple((pattern.format(re.escape(name)), by.format(number)) for name, number in names.items())


SAM_NECK = {"conv1": 0, "layer_norm1": 1, "conv2": 2, "layer_norm2": 3}
SAM_WORDS = (
    (r"^vision_encoder\.layers\.", "image_encoder.blocks."),
    *words(r"\.neck\.{}\.", ".neck.{}.", SAM_NECK),
    (r"^vision_encoder\.", "image_encoder."),
    (r"\.point_embed\.", ".point_embeddings."),
)
DOWN = {"conv1": 0, "conv2": 3, "conv3": 6, "layer_norm1": 1, "layer_norm2": 4}
DECODER_WORDS = (
    *words(r"(_head|_mlps\.\d)\.{}\.", r"\1.layers.{}.", {"layers.0": 1, "proj_in": 0, "proj_out": 2}),
    *words(r"\.mask_embed\.{}\.", ".mask_downscaling.{}.", DOWN),
    *words(r"\.upscale_{}\.", ".output_upscaling.{}.", {"conv1": 0, "layer_norm": 1, "conv2": 3}),
    (r"\.layer_norm(\d|_final_attn)\.", r".norm\1."),
    (r"\.shared_embedding\.positional_embedding", ".pe_layer.positional_encoding_gaussian_matrix"),
    (r"\.patch_embed\.projection\.", ".patch_embed.proj."),
)
SAM2_WORDS = (
    *words(r"\.mlp\.{}\.", ".mlp.layers.{}.", {"proj_in": 0, "proj_out": 1}),
    (r"\.o_proj\.", ".out_proj."),
    (r"^vision_encoder\.neck\.convs\.(\d)\.", r"image_encoder.neck.convs.\1.conv."),
    (r"^vision_encoder\.backbone\.", "image_encoder.trunk."),
    (r"^(prompt_en|mask_de)coder\.", r"sam_\1coder."),
    ("^no_memory_embedding$", "no_mem_embed"),
)


# Weights in the layouts of open_clip, OpenAI, segment_anything and sam2, against
# the same weights in Hugging Face layout.

PHRASES = ["red mug", "a", "handle"]
CONFIG = "open_clip_config.json"
Case = tuple[Path, int, int, bool, Any]  # what to load, heads of pictures and of text, quick GELU, config


def crops() -> np.ndarray:
    return np.random.default_rng(2).integers(0, 256, (3, SIDE, SIDE, 3), dtype=np.uint8)


def with_config(folder: Path, heads: int, head_width: int, quick: bool, **more: object) -> Any:
    """Write the open_clip_config.json of `open_clip_tensors`."""
    half = {"width": 128, "layers": 2}
    vision = half | {"image_size": SIDE, "patch_size": PATCH, "head_width": head_width}
    text = half | {"context_length": CONTEXT, "vocab_size": len(TOKENS), "heads": heads} | more
    model = {"embed_dim": SIZE, "quick_gelu": quick, "vision_cfg": vision, "text_cfg": text}
    pixels = {"mean": [0.5, 0.4, 0.3], "std": [0.2, 0.3, 0.25]}
    config = {"model_cfg": model, "preprocess_cfg": pixels}
    (folder / CONFIG).write_text(json.dumps(config), encoding="utf-8")
    return config


def hub_folder(folder: Path, tensors: Tensors) -> Case:
    torch.save(tensors, folder / "open_clip_pytorch_model.bin")
    return folder, 4, 8, False, with_config(folder, 8, 32, quick=False)


def hub_folder_of_safetensors(folder: Path, tensors: Tensors) -> Case:
    whole = {name: tensor.contiguous() for name, tensor in tensors.items()}
    save_file(whole, folder / "open_clip_model.safetensors")
    return folder, 2, 4, True, with_config(folder, 4, 64, quick=True)


def worldwide(folder: Path, tensors: Tensors) -> Case:
    torch.save(tensors, folder / "open_clip_pytorch_model.bin")
    more = {"pool_type": "eos", "eos_id": END, "hf_tokenizer_name": "facebook/xlm-v-base"}
    return folder, 2, 4, False, with_config(folder, 4, 64, quick=False, **more)


def text_apart(folder: Path, tensors: Tensors) -> Case:
    halves = {k if k.startswith(("visual", "logit")) else f"text.{k}": t for k, t in tensors.items()}
    torch.save(halves, folder / "open_clip_pytorch_model.bin")
    config = with_config(folder, 4, 64, quick=False)
    config["model_cfg"] |= {"custom_text": True}
    config["model_cfg"]["vision_cfg"] |= {"pool_type": "tok", "ls_init_value": None}
    (folder / CONFIG).write_text(json.dumps(config), encoding="utf-8")
    return folder, 2, 4, False, config


def training_checkpoint(folder: Path, tensors: Tensors) -> Case:
    state = {f"module.{name}": tensor for name, tensor in tensors.items()}
    torch.save({"epoch": 3, "state_dict": state, "optimizer": {"state": {}}}, folder / "epoch_3.pt")
    return folder / "epoch_3.pt", 2, 2, False, None


def quick_by_name(folder: Path, tensors: Tensors) -> Case:
    path = folder / "vit_b_16-quickgelu-laion400m.safetensors"
    save_file({name: tensor.contiguous() for name, tensor in tensors.items()}, path)
    return path, 2, 2, True, None


def openai_state(folder: Path, tensors: Tensors) -> Case:
    numbers = {"input_resolution": SIDE, "context_length": 20, "vocab_size": 54}
    torch.save(tensors | {name: torch.tensor(n) for name, n in numbers.items()}, folder / "ViT.bin")
    return folder / "ViT.bin", 2, 2, True, None


LAYOUTS = [
    *(hub_folder, hub_folder_of_safetensors, text_apart, worldwide),
    *(training_checkpoint, quick_by_name, openai_state),
]


def compare(case: Case, tmp_path: Path, **sizes: int) -> None:
    """Both halves of what `case` loads against the same weights as transformers has them."""
    path, vision_heads, text_heads, quick, config = case
    encoder = load_encoder(str(path), "cpu")
    assert (encoder.id, encoder.image_size, encoder.dim) == (str(path), SIDE, 24)
    texts = []
    for act in (quick, not quick):
        folder = tmp_path / f"quick_{act}"
        clip_model(**sizes, heads=(vision_heads, text_heads), quick=act).save_pretrained(folder)
        letter_tokenizer(folder)
        if config:
            pixels = {f"image_{name}": values for name, values in config["preprocess_cfg"].items()}
            (folder / "preprocessor_config.json").write_text(json.dumps(pixels))
        other = load_encoder(str(folder), "cpu")
        texts.append(other.encode_texts(PHRASES))
        if act == quick:
            seen = (one.encode_images(crops()) for one in (encoder, other))
            np.testing.assert_allclose(*seen, atol=1e-5)
    np.testing.assert_allclose(encoder.encode_texts(PHRASES), texts[0], atol=1e-5)
    assert abs(texts[0] - texts[1]).max() > 2e-4  # so the kind of GELU was seen


@pytest.mark.parametrize("write", LAYOUTS)
def test_each_layout_of_clip_gives_the_vectors_of_open_clip(write, tmp_path):
    letter_tokenizer(tmp_path)
    compare(write(tmp_path, open_clip_tensors()), tmp_path)


def test_heads_of_a_wide_model_without_configuration(tmp_path: Path) -> None:
    sizes = {"vision": 1280, "layers": 1, "inner": 8}  # as ViT-H-14: 16 heads of 80
    letter_tokenizer(tmp_path)
    torch.save(open_clip_tensors(**sizes), tmp_path / "quickgelu.pt")
    compare((tmp_path / "quickgelu.pt", 16, 2, True, None), tmp_path, **sizes)


CLEANED = {
    "the cat’s mug": "the cat's mug",
    "mug &amp;amp; bowl": "mug & bowl",
    "of\ufb01ce   chair": "office chair",
    "‘mug’": "'mug'",
}


def test_texts_are_cleaned_as_open_clip_does(tmp_path: Path) -> None:
    letter_tokenizer(tmp_path)
    encoder = load_text_encoder(str(training_checkpoint(tmp_path, open_clip_tensors())[0]))
    got, want = encoder.encode_texts(list(CLEANED)), encoder.encode_texts(list(CLEANED.values()))
    np.testing.assert_array_equal(got, want)
    assert (abs(want - encoder.encode_texts(["the cats mug"])).max(1) > 1e-3).all()  # so the marks are read
    for nothing in ("&nbsp;", "&amp;amp;"):
        with pytest.raises(InputError, match="empty phrase"):
            encoder.encode_texts(["mug", nothing])


def without(name: str) -> Callable[[Tensors], object]:
    return lambda tensors: {key: tensor for key, tensor in tensors.items() if key != name}


def replaced(name: str, by: torch.Tensor) -> Callable[[Tensors], object]:
    return lambda tensors: tensors | {name: by}


def refusal(load: Callable[[str], object], path: Path) -> str:
    with pytest.raises(EncoderError) as error:
        load(str(path))
    said = str(error.value)
    assert len(said) < 420
    assert said.startswith(str(path))
    return said


def load_sam2(id: str) -> Segmenter:
    """Load a file of the tiny SAM 2 as if it were one of the published sizes."""
    found = converted(id, Path(id), {(8, 5): Hiera(1, (8, 4, 4, 2), (3,))}, SAM_SIDE)
    assert found is not None
    return FAMILIES["sam2"](Weights(id, Path(id).parent, "cpu", found))


def sam2_checkpoint(folder: Path) -> Tensors:
    model = tiny_sam2(folder / "folder", decoder_heads=8)
    model.shared_image_embedding = model.prompt_encoder.shared_embedding
    return sam2_tensors(model)


def sam_checkpoint(folder: Path) -> Tensors:
    return segment_anything_tensors(tiny_sam(folder, decoder_heads=8))


CLIP = (lambda folder: open_clip_tensors()), load_encoder
SAM, SAM2 = (sam_checkpoint, load_segmenter), (sam2_checkpoint, load_sam2)
BROKEN: dict[str, tuple[Any, Any]] = {
    "a short norm": (CLIP, replaced("ln_final.bias", torch.zeros(5))),
    "a tensor too many": (CLIP, replaced("visual.conv1.bias", torch.zeros(128))),
    "a tower of timm's": (CLIP, replaced("visual.trunk.stem.weight", torch.zeros(3))),
    "more than the file": (CLIP, replaced("positional_embedding", torch.zeros(1).expand(1 << 40, 128))),
    "SAM-HQ": (SAM, replaced("mask_decoder.hf_token.weight", torch.zeros(1, 16))),
    "no head": (SAM, without("mask_decoder.iou_prediction_head.layers.2.weight")),
    "three points": (SAM2, without("sam_prompt_encoder.point_embeddings.2.weight")),
    "another width": (SAM2, replaced("image_encoder.trunk.pos_embed", torch.zeros(1, 9, 2, 2))),
}


@pytest.mark.parametrize("case", BROKEN)
def test_tensors_of_no_model_known_are_named(case: str, tmp_path: Path) -> None:
    (make, load), change = BROKEN[case]
    letter_tokenizer(tmp_path)
    changed = change(make(tmp_path))
    torch.save({"model": changed} if make is sam2_checkpoint else changed, tmp_path / "model.pt")
    refusal(load, tmp_path / "model.pt")


@pytest.mark.parametrize("load", [load_encoder, load_segmenter])
def test_damaged_weights_are_named_and_run_nothing(load: Callable[[str], object], tmp_path: Path) -> None:
    whole = tmp_path / "whole.pt"
    torch.save(open_clip_tensors(), whole)
    for name, content in (("a.pt", whole.read_bytes()[:-900]), ("b.pth", b""), ("c.safetensors", b"\x08{}")):
        (tmp_path / name).write_bytes(content)
        refusal(load, tmp_path / name)
    torch.save(open_clip_tensors() | {"logit_scale": MakesFolder(tmp_path / "ran")}, whole)
    assert "a pickle that holds more than tensors" in refusal(load, whole)
    assert not (tmp_path / "ran").exists()
    with zipfile.ZipFile(tmp_path / "ViT-B-16.pt", "w") as archive:
        archive.writestr("ViT-B-16/constants.pkl", b"3")
    assert "TorchScript" in refusal(load, tmp_path / "ViT-B-16.pt")


FILES = {
    "sam_vit_b_01ec64.pth": (tiny_sam, segment_anything_tensors, load_segmenter),
    "sam2.1_hiera_tiny.pt": (tiny_sam2, lambda model: {"model": sam2_tensors(model)}, load_sam2),
}


@pytest.mark.parametrize("name", FILES)
def test_a_file_of_a_segmenter_answers_as_the_folder_does(name: str, tmp_path: Path) -> None:
    make, renamed, load_file = FILES[name]
    model = make(tmp_path / "folder", decoder_heads=8)
    with torch.no_grad():  # what is zero in a new one too
        for parameter in model.parameters():
            parameter.add_(torch.randn_like(parameter) * 0.1)
        grid = model.prompt_encoder.shared_embedding.positional_embedding
        model.shared_image_embedding.positional_embedding.copy_(grid)  # as published ones
    model.save_pretrained(tmp_path / "folder")
    torch.save(renamed(model), tmp_path / name)
    image = np.random.default_rng(3).integers(0, 256, (48, 80, 3), dtype=np.uint8)
    points = np.array([[5, 7], [60, 40]], np.float32)
    with torch.inference_mode():
        (got, masks), (want, folder_masks) = (
            load(str(tmp_path / path)).encode(image).masks_at(points)
            for load, path in ((load_file, name), (load_segmenter, "folder"))
        )
    torch.testing.assert_close(got, want, rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(masks, folder_masks, rtol=1e-5, atol=1e-5)
    assert masks.std() > 0.01
    assert (masks[0] - masks[1]).abs().max() > 0.01


# CLIP, SigLIP, MetaCLIP 2 and TIPS v2 against the whole models of transformers.


def plain_tokenizer(folder: Path) -> Any:
    return PreTrainedTokenizerFast(tokenizer_file=str(folder / "tokenizer.json"), pad_token="</s>")


HALVES, CLIPS = ((0.5,) * 3, (0.5,) * 3), tuple(CLIP_PIXELS)
WHOLE: dict[str, tuple[Callable[[Path], Any], Callable[[Path], Any], Any]] = {
    "clip": (tiny_clip, CLIPTokenizer.from_pretrained, CLIPS),
    "siglip": (tiny_siglip, plain_tokenizer, HALVES),
    "siglip 2": (partial(tiny_siglip, second=True), Siglip2Tokenizer.from_pretrained, HALVES),
    "metaclip 2": (tiny_metaclip2, plain_tokenizer, CLIPS),
    "metaclip 2 of mT5": (partial(tiny_metaclip2, template="$A </s>"), plain_tokenizer, CLIPS),
    "tips v2": (tiny_tipsv2, Tipsv2Tokenizer.from_pretrained, ((0,) * 3, (1,) * 3)),
}


@pytest.mark.parametrize("family", WHOLE)
def test_vectors_agree_with_the_whole_model(family: str, tmp_path: Path) -> None:
    make, tokenizer, (mean, deviation) = WHOLE[family]
    model, encoder = make(tmp_path), load_encoder(str(tmp_path), "cpu", batch=2)
    phrases = ["Red mug", "red", "a red mug with a very long handle"]
    padded = tokenizer(tmp_path)(phrases, padding="max_length", max_length=LENGTH, return_tensors="pt")
    assert padded.input_ids.shape == (3, LENGTH)
    asked = {"attention_mask": padded.attention_mask} if family == "tips v2" else {}
    texts = model.get_text_features(input_ids=padded.input_ids, **asked).pooler_output
    pictures = np.random.default_rng(0).integers(0, 256, (5, SIDE, SIDE, 3)).astype(np.uint8)
    pixels = ((pictures / 255 - mean) / deviation).transpose(0, 3, 1, 2).astype(np.float32)
    images = model.get_image_features(pixel_values=torch.from_numpy(pixels)).pooler_output
    assert (encoder.dim, encoder.image_size, encoder.id) == (texts.shape[1], SIDE, str(tmp_path))
    np.testing.assert_allclose(encoder.encode_images(pictures), unit(images.detach().numpy()), atol=2e-6)
    read = load_text_encoder(str(tmp_path))
    one_by_one = [read.encode_texts([phrase])[0] for phrase in phrases]  # none depends on its neighbours
    for got in (encoder.encode_texts(phrases), np.stack(one_by_one)):
        assert got.dtype == np.float32
        np.testing.assert_allclose(got, unit(texts.detach().numpy()), atol=2e-6)
    assert abs(got[0] - got[1]).max() > 1e-3


@pytest.mark.parametrize("second", [False, True])
def test_siglip_reads_no_case_and_only_its_second_punctuation(second: bool, tmp_path: Path) -> None:
    tiny_siglip(tmp_path, second=second)
    encoder = load_text_encoder(str(tmp_path))
    small, large, dotted = encoder.encode_texts(["red mug", "RED Mug", "red mug!"])
    np.testing.assert_allclose(small, large, atol=1e-6)
    assert np.allclose(small, dotted, atol=1e-6) != second
    for read in (encoder, load_encoder(str(tmp_path), "cpu")):
        assert read.temperature == pytest.approx(SCALE / 10)  # a tenth of the learned scale


def test_siglip_without_its_scale_is_refused(tmp_path: Path) -> None:
    tiny_siglip(tmp_path)
    state = load_file(tmp_path / "model.safetensors")
    del state["logit_scale"]
    save_file(state, tmp_path / "model.safetensors", {"format": "pt"})
    with pytest.raises(EncoderError, match="logit_scale is not in them"):
        load_text_encoder(str(tmp_path))


def test_regions_of_tips_v2_are_means_of_their_patches(tmp_path: Path) -> None:
    model, encoder = tiny_tipsv2(tmp_path), load_encoder(str(tmp_path), "cpu")
    image = np.random.default_rng(4).integers(0, 256, (SIDE, 2 * SIDE, 3), dtype=np.uint8)
    pixels = torch.from_numpy((image / 255).transpose(2, 0, 1)[None].astype(np.float32))
    with torch.inference_mode():
        grid = model.vision_model(pixels).last_hidden_state[0, 2:].numpy().reshape(4, 8, -1)  # 8 px a patch
    maps = np.full((3, SIDE, 2 * SIDE), -1, np.int32)
    maps[0, :8, :16], maps[1, :, 32:], maps[2, 4:12, :8] = 0, 1, 2
    got = embed_regions(image, maps, encoder)
    want = [unit(some).mean((0, 1)) for some in (grid[:1, :2], grid[:, 4:], grid[:2, :1])]
    np.testing.assert_allclose(got, unit(np.stack(want)), atol=2e-6)
    assert embed_regions(image, np.full_like(maps, -1), encoder).shape == (0, encoder.dim)


def test_sam_3_sees_images_as_its_tracker_does(tmp_path: Path) -> None:
    model, image = tiny_sam3(tmp_path), crops()[0]
    square = np.asarray(Image.fromarray(image).resize((SAM_SIDE, SAM_SIDE), Image.Resampling.BILINEAR))
    pixels = torch.from_numpy((square / 127.5 - 1).transpose(2, 0, 1)[None].astype(np.float32))
    with torch.inference_mode():
        encoded = load_segmenter(str(tmp_path), "cpu").encode(image)
        seen = model.detector_model.vision_encoder(pixels)
        *fine, last = model.get_vision_features_for_tracker(seen)[0]
        want = [*fine, last + model.tracker_model.no_memory_embedding]
        ious, logits = encoded.masks_at(np.array([[5, 7], [30, 20]], np.float32))
    for got, map in zip(encoded.seen["image_embeddings"], want, strict=True):
        torch.testing.assert_close(got.flatten(2).permute(2, 0, 1), map, rtol=1e-5, atol=1e-5)
    assert ious.shape == (2, 3)
    areas = (logits > 0).flatten(2).sum(2)
    assert (areas[:, :-1] <= areas[:, 1:]).all()
    assert (logits[0] - logits[1]).abs().max() > 0.01


@pytest.mark.parametrize("make", [tiny_sam3, tiny_sam3_lite])
def test_sam_3_outlines_phrases_as_its_processor_asks(make: Callable[[Path], Any], tmp_path: Path) -> None:
    model, image = make(tmp_path), np.ascontiguousarray(crops()[0][:20])
    detector, reader = getattr(model, "detector_model", model), CLIPTokenizer.from_pretrained(tmp_path)
    square = Image.fromarray(image).resize((SAM_SIDE, SAM_SIDE), Image.Resampling.BILINEAR)
    pixels = torch.from_numpy((np.asarray(square) / 127.5 - 1).transpose(2, 0, 1)[None].astype(np.float32))
    phrases, length = ["red mug", "apple"], min(32, detector.config.text_config.max_position_embeddings)
    masks = load_text_segmenter(str(tmp_path), "cpu").segment(image, phrases)
    for phrase, mask in zip(phrases, np.moveaxis(masks, 2, 0), strict=True):
        asked = reader(phrase, padding="max_length", max_length=length, return_tensors="pt")
        with torch.inference_mode():
            found = detector(pixels, input_ids=asked["input_ids"], attention_mask=asked["attention_mask"])
        there = (found.pred_logits.sigmoid() * found.presence_logits.sigmoid())[0] > 0.5
        full = torch.nn.functional.interpolate(found.pred_masks.sigmoid(), image.shape[:2], mode="bilinear")
        assert (mask == (full[0, there] > 0.5).any(0).numpy()).mean() > 0.99
        assert 0 < there.sum() < len(there)
