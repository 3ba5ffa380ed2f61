"""Models of the field in their real sizes with random weights, in the layout of the hub, and what they cost.

    python -m tests.support.full_size make NAME FOLDER       # writes config, weights, tokenizer
    python -m tests.support.full_size pickle NAME FOLDER     # model.safetensors becomes pytorch_model.bin
    python -m tests.support.full_size measure NAME FOLDER    # loads and uses them; prints a line of JSON

Processes of their own, so that the memory of the last is that of using a model.
"""

import json
import resource
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

PHOTOGRAPH = (1080, 1440)  # height, width, px: what LangSplat shrinks photographs to
POINTS = 64  # of a grid of 1024, asked at once
CROPS = 64  # regions shown to an encoder; a photograph has about 300
PHRASES = ["red mug", "the handle of a green mug", "a wooden table with apples on it"]


@dataclass(frozen=True)
class Model:
    """A checkpoint of the hub."""

    id: str
    make: Callable[[Path], None]
    segments: bool  # else it encodes


def make_sam(folder: Path) -> None:
    """facebook/sam-vit-huge."""
    from transformers import SamConfig, SamModel

    vision = {"hidden_size": 1280, "num_hidden_layers": 32, "num_attention_heads": 16, "mlp_dim": 5120}
    vision |= {"global_attn_indexes": [7, 15, 23, 31], "output_channels": 256}
    vision |= {
        "initializer_range": 0.02
    }  # the default, 1e-10, makes numbers so small that sums of them crawl
    _save(SamModel, SamConfig(vision_config=vision), folder)


def make_sam2_tiny(folder: Path) -> None:
    """facebook/sam2.1-hiera-tiny."""
    from transformers import Sam2VideoConfig, Sam2VideoModel

    _save(Sam2VideoModel, Sam2VideoConfig(), folder)  # the defaults are its configuration


def make_sam2_large(folder: Path) -> None:
    """facebook/sam2.1-hiera-large."""
    from transformers import Sam2HieraDetConfig, Sam2VideoConfig, Sam2VideoModel, Sam2VisionConfig

    backbone = Sam2HieraDetConfig(
        hidden_size=144,
        num_attention_heads=2,
        blocks_per_stage=[2, 6, 36, 4],
        embed_dim_per_stage=[144, 288, 576, 1152],
        num_attention_heads_per_stage=[2, 4, 8, 16],
        window_size_per_stage=[8, 4, 16, 8],
        global_attention_blocks=[23, 33, 43],
    )
    vision = Sam2VisionConfig(backbone_config=backbone, backbone_channel_list=[1152, 576, 288, 144])
    _save(Sam2VideoModel, Sam2VideoConfig(vision_config=vision), folder)


def make_clip(folder: Path) -> None:
    """laion/CLIP-ViT-B-16-laion2B-s34B-b88K."""
    from transformers import CLIPConfig, CLIPModel, CLIPTokenizer

    letters = "abcdefghijklmnopqrstuvwxyz"
    tokens = ["<|startoftext|>", "<|endoftext|>", *letters, *(f"{letter}</w>" for letter in letters)]
    tokens += [f"word{i}</w>" for i in range(49408 - len(tokens))]
    tokenizer = CLIPTokenizer(vocab={token: i for i, token in enumerate(tokens)}, merges=[])
    tokenizer.save_pretrained(folder)
    text = {"hidden_size": 512, "intermediate_size": 2048, "num_attention_heads": 8, "hidden_act": "gelu"}
    text |= {"vocab_size": 49408, "bos_token_id": 0, "eos_token_id": 1, "projection_dim": 512}
    vision = {"patch_size": 16, "hidden_act": "gelu", "projection_dim": 512}
    _save(CLIPModel, CLIPConfig(text_config=text, vision_config=vision, projection_dim=512), folder)


def make_siglip(folder: Path) -> None:
    """google/siglip-base-patch16-224."""
    from tests.support.tiny_siglip import unigram_tokenizer

    _make_siglip(folder, unigram_tokenizer(folder, words=32_000))


def make_siglip2(folder: Path) -> None:
    """google/siglip2-base-patch16-224."""
    from tests.support.tiny_siglip import gemma_tokenizer

    _make_siglip(folder, gemma_tokenizer(folder, words=256_000))


def _make_siglip(folder: Path, words: int) -> None:
    import torch
    from transformers import SiglipConfig, SiglipModel

    model = SiglipModel(SiglipConfig(text_config={"vocab_size": words}, vision_config={"patch_size": 16}))
    torch.nn.init.constant_(model.logit_scale, 4.7)
    torch.nn.init.constant_(model.logit_bias, -12.9)
    model.save_pretrained(folder)


def _save(kind: Any, config: Any, folder: Path) -> None:
    import torch

    torch.manual_seed(0)
    kind(config).save_pretrained(folder)


MODELS = {
    "sam-vit-huge": Model("facebook/sam-vit-huge", make_sam, True),
    "sam2.1-hiera-large": Model("facebook/sam2.1-hiera-large", make_sam2_large, True),
    "sam2.1-hiera-tiny": Model("facebook/sam2.1-hiera-tiny", make_sam2_tiny, True),
    "clip": Model("laion/CLIP-ViT-B-16-laion2B-s34B-b88K", make_clip, False),
    "siglip": Model("google/siglip-base-patch16-224", make_siglip, False),
    "siglip2": Model("google/siglip2-base-patch16-224", make_siglip2, False),
}


def measure_segmenter(folder: Path) -> dict[str, float]:
    """Seconds of each step on one photograph; every mask of a batch is enlarged, as if all passed."""
    import torch

    from langsplat_core.semantics.sam import grid_points, load_segmenter

    seconds = Stopwatch()
    segmenter = load_segmenter(str(folder), "cpu")
    seconds("load")
    image = np.random.default_rng(0).integers(0, 256, (*PHOTOGRAPH, 3), dtype=np.uint8)
    with torch.inference_mode():
        look = segmenter.look(image)
        seconds("picture")
        ious, logits = look.ask(grid_points(8, PHOTOGRAPH))
        seconds("64 points")
        for rows in logits.flatten(0, 1).split(16):
            full = look.enlarge(rows)
        seconds("192 masks")
    assert ious.shape == (POINTS, 3)
    assert logits.shape == (POINTS, 3, 256, 256)
    assert full.shape == (16, *PHOTOGRAPH)
    assert bool(torch.isfinite(ious).all() and torch.isfinite(full).all())
    return seconds.laps


def measure_encoder(folder: Path) -> dict[str, float]:
    """Seconds of each step; the first phrase pays for what is set up once."""
    from langsplat_core.semantics.encoders import load_encoder

    seconds = Stopwatch()
    encoder = load_encoder(str(folder), "cpu")
    seconds("load")
    texts = encoder.encode_texts(PHRASES)
    seconds("3 phrases")
    side = encoder.image_size
    crops = np.random.default_rng(0).integers(0, 256, (CROPS, side, side, 3), dtype=np.uint8)
    pictures = encoder.encode_images(crops)
    seconds("64 crops")
    for vectors, count in ((texts, len(PHRASES)), (pictures, CROPS)):
        assert vectors.shape == (count, encoder.dim)
        assert np.isfinite(vectors).all()
        assert np.allclose(np.linalg.norm(vectors, axis=1), 1, atol=1e-5)
    return seconds.laps | {"temperature": encoder.temperature, "dim": encoder.dim, "side": side}


def pickle_weights(folder: Path) -> None:
    """The hub's older layout of the same weights."""
    import torch
    from safetensors.torch import load_file

    torch.save(load_file(folder / "model.safetensors"), folder / "pytorch_model.bin")
    (folder / "model.safetensors").unlink()


class Stopwatch:
    """Seconds from one call to the next."""

    def __init__(self) -> None:
        self.laps: dict[str, float] = {}
        self._last = time.perf_counter()

    def __call__(self, name: str) -> None:
        now = time.perf_counter()
        self.laps[name], self._last = now - self._last, now


def main(task: str, name: str, folder: str) -> None:
    """See the module."""
    if task == "make":
        MODELS[name].make(Path(folder))
        return
    if task == "pickle":
        pickle_weights(Path(folder))
        return
    measure = measure_segmenter if MODELS[name].segments else measure_encoder
    found = measure(Path(folder))
    found["peak MB"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024  # Linux counts in KB
    print(json.dumps(found))


if __name__ == "__main__":
    main(*sys.argv[1:])
