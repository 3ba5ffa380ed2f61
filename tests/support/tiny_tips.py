"""A TIPS v2 small enough to be made while a test runs, in the layout of Hugging Face."""

from pathlib import Path

import torch
from transformers import Tipsv2Config, Tipsv2Model, Tipsv2Tokenizer

SIDE = 28
LENGTH = 10  # tokens of the longest phrase


def tiny_tips(folder: Path) -> Tipsv2Model:
    """Two narrow layers with random weights and a tokenizer of its class."""
    pieces = ["<pad>", "<unk>", "▁", "▁r", *"abcdefghijklmnopqrstuvwxyz", "▁re", "▁red"]
    tokenizer = Tipsv2Tokenizer(
        vocab={piece: i for i, piece in enumerate(pieces)},
        merges=[("▁", "r"), ("▁r", "e"), ("▁re", "d")],
    )
    tokenizer.save_pretrained(folder)
    tower = {"hidden_size": 32, "num_hidden_layers": 2, "num_attention_heads": 2}
    text = {"vocab_size": len(pieces), "intermediate_size": 48, "max_position_embeddings": LENGTH}
    torch.manual_seed(5)
    model = Tipsv2Model(
        Tipsv2Config(text_config=tower | text, vision_config=tower | {"image_size": SIDE, "patch_size": 7})
    ).eval()
    model.save_pretrained(folder)
    return model
