"""A CLIP small enough to be made while a test runs, in the layout of Hugging Face."""

import json
from collections.abc import Callable
from pathlib import Path
from string import ascii_lowercase, digits
from typing import Any

import torch
from transformers import CLIPConfig, CLIPModel, CLIPTokenizer

WORDS = ["red", "green", "mug", "apple", "handle", "object", "things"]
SIDE = 32


def change_json(path: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """Write a JSON file anew with what `change` has done to its content."""
    content = json.loads(path.read_text(encoding="utf-8"))
    change(content)
    path.write_text(json.dumps(content), encoding="utf-8")


def tiny_clip(folder: Path, half: bool = False) -> CLIPModel:
    """A CLIP of two narrow layers that spells, saved in Hugging Face layout. It reads every everyday phrase
    whole, and no marks."""
    letters = ascii_lowercase + digits
    tokens = ["<|startoftext|>", "<|endoftext|>", *letters, *(f"{letter}</w>" for letter in letters)]
    tokenizer = CLIPTokenizer(vocab={token: i for i, token in enumerate(tokens)}, merges=[])
    tokenizer.save_pretrained(folder)
    tower = {"hidden_size": 32, "intermediate_size": 48, "num_hidden_layers": 2, "num_attention_heads": 2}
    text = tower | {"vocab_size": len(tokens), "max_position_embeddings": 40}
    text |= {"bos_token_id": 0, "eos_token_id": 1, "pad_token_id": 1}
    torch.manual_seed(0)
    model = CLIPModel(
        CLIPConfig(
            text_config=text, vision_config=tower | {"image_size": SIDE, "patch_size": 8}, projection_dim=24
        )
    ).eval()
    (model.half() if half else model).save_pretrained(folder)
    return model.float()
