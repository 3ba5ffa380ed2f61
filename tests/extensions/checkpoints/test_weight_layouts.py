"""Weights in the layouts of open_clip, segment_anything and sam2, and what open_clip computes.

Written from the papers and the names in published checkpoints, apart from the product's own tables.
"""

import json
import re
import zipfile
from collections.abc import Callable
from pathlib import Path
from string import ascii_lowercase
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import save_file
from torch import Tensor
from torch.nn import functional
from transformers import CLIPTokenizer

from langsplat_core.errors import EncoderError, InputError
from langsplat_core.extensions.checkpoints.weight_layouts import Hiera, converted
from langsplat_core.semantics.encoders import CLIP_PIXELS, load_encoder, load_text_encoder
from langsplat_core.semantics.sam import FAMILIES, Segmenter, load_segmenter
from langsplat_core.semantics.weights import Weights
from tests.support.tiny_models import SAM_SIDE, MakesFolder, tiny_sam, tiny_sam2

pytestmark = pytest.mark.long

SIDE, PATCH, CONTEXT, SIZE = 32, 8, 20, 24
MARKS = "'&"
LETTERS = ascii_lowercase + MARKS
TOKENS = [*LETTERS, *(f"{letter}</w>" for letter in LETTERS), "<|startoftext|>", "<|endoftext|>"]
BEGIN, END = len(TOKENS) - 2, len(TOKENS) - 1
PROJECTIONS = ("in_proj_weight", "in_proj_bias", "out_proj.weight", "out_proj.bias")
Tensors = dict[str, Tensor]


def open_clip_tensors(vision: int = 128, layers: int = 2, inner: int = 48) -> Tensors:
    """Random weights of a CLIP as open_clip names them; `vision`: width of the half that sees."""
    text = 128
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
            shapes = {"attn.out_proj": (wide, wide), "mlp.c_fc": (inner, wide), "mlp.c_proj": (wide, inner)}
            for name, (rows, columns) in shapes.items():
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
        projections = [tensors[f"{block}attn.{name}"] for name in PROJECTIONS]
        x = (
            x
            + functional.multi_head_attention_forward(
                *(y, y, y, y.shape[-1], heads, *projections[:2], None, None, False, 0.0, *projections[2:]),
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


# Weights in the layouts of open_clip, OpenAI, segment_anything and sam2, against open_clip's arithmetic and
# against the same weights in Hugging Face layout.

PHRASES = ["red mug", "a", "handle"]
CONFIG = "open_clip_config.json"
Case = tuple[Path, int, int, bool, Any]  # what to load, heads of pictures and of text, quick GELU, config


def crops() -> np.ndarray:
    return np.random.default_rng(2).integers(0, 256, (3, SIDE, SIDE, 3), dtype=np.uint8)


def with_config(folder: Path, heads: int, head_width: int, quick: bool) -> Any:
    """Write the open_clip_config.json of `open_clip_tensors`."""
    half = {"width": 128, "layers": 2}
    vision = half | {"image_size": SIDE, "patch_size": PATCH, "head_width": head_width}
    text = half | {"context_length": CONTEXT, "vocab_size": len(TOKENS), "heads": heads}
    model = {"embed_dim": SIZE, "quick_gelu": quick, "vision_cfg": vision, "text_cfg": text}
    pixels = {"mean": [0.5, 0.4, 0.3], "std": [0.2, 0.3, 0.25]}
    config = {"model_cfg": model, "preprocess_cfg": pixels}
    (folder / CONFIG).write_text(json.dumps(config), encoding="utf-8")
    return config


def hub_folder(folder: Path, tensors: Tensors) -> Case:
    torch.save(tensors, folder / "open_clip_pytorch_model.bin")
    return folder, 4, 8, False, with_config(folder, 8, 32, quick=False)


def hub_folder_of_safetensors(folder: Path, tensors: Tensors) -> Case:
    save_file(
        {name: tensor.contiguous() for name, tensor in tensors.items()},
        folder / "open_clip_model.safetensors",
    )
    return folder, 2, 4, True, with_config(folder, 4, 64, quick=True)


def text_apart(folder: Path, tensors: Tensors) -> Case:
    halves = {
        name if name.startswith(("visual", "logit")) else f"text.{name}": t for name, t in tensors.items()
    }
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
    *(hub_folder, hub_folder_of_safetensors, text_apart),
    *(training_checkpoint, quick_by_name, openai_state),
]


def compare(case: Case, tensors: Tensors, tolerance: float = 1e-5) -> None:
    """Both halves of what `case` loads against open_clip's arithmetic."""
    path, vision_heads, text_heads, quick, config = case
    encoder = load_encoder(str(path), "cpu")
    assert (encoder.id, encoder.image_size, encoder.dim) == (str(path), SIDE, 24)
    stated = (
        config["preprocess_cfg"] if config else dict(zip(("mean", "std"), CLIP_PIXELS.tolist(), strict=True))
    )
    pixels = (crops() / 255 - np.array(stated["mean"])) / np.array(stated["std"])
    given = torch.from_numpy(pixels.transpose(0, 3, 1, 2).astype(np.float32))
    pictures, texts = encoder.encode_images(crops()), encoder.encode_texts(PHRASES)
    np.testing.assert_allclose(pictures, plain_pictures(tensors, given, vision_heads, quick), atol=tolerance)
    np.testing.assert_allclose(texts, plain_texts(tensors, PHRASES, text_heads, quick), atol=tolerance)
    other = plain_texts(tensors, PHRASES, text_heads, not quick)
    assert abs(texts - other.numpy()).max() > 20 * tolerance  # so the kind of GELU was seen


@pytest.mark.parametrize("write", LAYOUTS)
def test_each_layout_of_clip_gives_the_vectors_of_open_clip(
    write: Callable[[Path, Tensors], Case], tmp_path: Path
) -> None:
    tensors = open_clip_tensors()
    letter_tokenizer(tmp_path)
    compare(write(tmp_path, tensors), tensors)


def test_heads_of_a_wide_model_without_configuration(tmp_path: Path) -> None:
    tensors = open_clip_tensors(vision=1280, layers=1, inner=8)  # as ViT-H-14: 16 heads of 80
    letter_tokenizer(tmp_path)
    torch.save(tensors, tmp_path / "quickgelu.pt")
    compare((tmp_path / "quickgelu.pt", 16, 2, True, None), tensors)


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


BROKEN_CLIP = {
    "no projection": without("visual.proj"),
    "a hole": lambda t: {k.replace("resblocks.0", "resblocks.7"): v for k, v in t.items()},
    "a short norm": replaced("ln_final.bias", torch.zeros(5)),
    "a scalar": replaced("transformer.resblocks.0.attn.in_proj_weight", torch.tensor(1.0)),
    "a tensor too many": replaced("visual.conv1.bias", torch.zeros(128)),
    "nothing": lambda t: {},
    "a number for its state": lambda t: {"state_dict": 5},
    "more than the file": lambda t: t | {"positional_embedding": torch.zeros(1).expand(1 << 40, 128)},
}
BROKEN_SAM = {
    "SAM-HQ": replaced("mask_decoder.hf_token.weight", torch.zeros(1, 16)),
    "no reach": without("image_encoder.blocks.1.attn.rel_pos_h"),
    "no head": without("mask_decoder.iou_prediction_head.layers.2.weight"),
}
BROKEN_SAM2 = {
    "three points": without("sam_prompt_encoder.point_embeddings.2.weight"),
    "no block": lambda t: {name: tensor for name, tensor in t.items() if "blocks.2" not in name},
    "another width": replaced("image_encoder.trunk.pos_embed", torch.zeros(1, 9, 2, 2)),
}


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


@pytest.mark.parametrize(
    ("make", "change", "load"),
    [
        *((lambda folder: open_clip_tensors(), change, load_encoder) for change in BROKEN_CLIP.values()),
        *((sam_checkpoint, change, load_segmenter) for change in BROKEN_SAM.values()),
        *((sam2_checkpoint, change, load_sam2) for change in BROKEN_SAM2.values()),
    ],
    ids=[*BROKEN_CLIP, *(f"SAM: {case}" for case in BROKEN_SAM), *(f"SAM 2: {c}" for c in BROKEN_SAM2)],
)
def test_tensors_of_no_model_known_are_named(make, change, load, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
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


def stating(part: str, **settings: object) -> Callable[[Any], Any]:
    return lambda config: config["model_cfg"][part].update(settings) or config


OTHER_CONFIGS = {
    "other width": stating("vision_cfg", width=64),
    "timm": stating("vision_cfg", timm_model_name="vit_base"),
    "heads that do not divide": stating("text_cfg", heads=7),
    "no text": lambda config: {"model_cfg": {"vision_cfg": {}}},
    "a captioner": lambda config: {"model_cfg": config["model_cfg"] | {"multimodal_cfg": {"width": 8}}},
    "two colours": lambda config: config | {"preprocess_cfg": {"mean": [0, 0]}},
}


@pytest.mark.parametrize("case", OTHER_CONFIGS)
def test_a_configuration_of_another_model_is_named(case: str, tmp_path: Path) -> None:
    letter_tokenizer(tmp_path)
    config = hub_folder(tmp_path, open_clip_tensors())[-1]
    (tmp_path / CONFIG).write_text(json.dumps(OTHER_CONFIGS[case](config)), encoding="utf-8")
    refusal(load_encoder, tmp_path)


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
