"""SigLIPs small enough to be made while a test runs, in the layout of Hugging Face."""

import json
from pathlib import Path
from typing import Any

import torch
from tokenizers import Tokenizer, models, normalizers, pre_tokenizers, processors
from transformers import Siglip2Tokenizer, SiglipConfig, SiglipModel

SIDE = 32
LENGTH = 40  # tokens that every phrase is padded to
SCALE, BIAS = 110.0, -12.5
TOWER = {"hidden_size": 32, "intermediate_size": 48, "num_hidden_layers": 2, "num_attention_heads": 2}
LETTERS = "abcdefghijklmnopqrstuvwxyz"


def unigram_tokenizer(folder: Path, words: int = 0) -> int:
    """SigLIP's: SentencePiece unigram with end and padding in one token; returns the size of its vocabulary,
    which `words` made-up words enlarge."""
    pieces = [("<pad>", 0.0), ("</s>", 0.0), ("<unk>", -9.0), ("▁", -2.0), ("▁red", -1.0), ("▁mug", -1.0)]
    pieces += [(letter, -3.0) for letter in LETTERS]
    pieces += [(f"▁word{i}", -5.0) for i in range(words - len(pieces))]
    tokenizer = Tokenizer(models.Unigram(pieces, unk_id=2, byte_fallback=False))
    tokenizer.normalizer = normalizers.Lowercase()
    tokenizer.pre_tokenizer = pre_tokenizers.Metaspace()
    tokenizer.post_processor = processors.TemplateProcessing("$A </s>", special_tokens=[("</s>", 1)])
    folder.mkdir(parents=True, exist_ok=True)
    tokenizer.save(str(folder / "tokenizer.json"))
    stated = {"tokenizer_class": "SiglipTokenizer", "eos_token": "</s>", "model_max_length": 64}
    stated |= {"pad_token": {"__type": "AddedToken", "content": "</s>"}}  # type: ignore[dict-item]
    (folder / "tokenizer_config.json").write_text(json.dumps(stated), encoding="utf-8")
    return len(pieces)


def gemma_tokenizer(folder: Path, words: int = 0) -> int:
    """SigLIP 2's: byte pairs, an end token and another one for padding; else as `unigram_tokenizer`."""
    special = ["<pad>", "<eos>", "<bos>", "<unk>", "<mask>"]
    pieces = [*special, "▁", *LETTERS, "re", "red", "mu", "mug"]
    pieces += [f"word{i}" for i in range(words - len(pieces))]
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
    return _saved(SiglipModel, config, folder)


def _saved(kind: Any, config: Any, folder: Path) -> Any:
    torch.manual_seed(3)
    model = kind(config).eval()
    with torch.no_grad():
        model.logit_scale.fill_(torch.tensor(SCALE).log())
        model.logit_bias.fill_(BIAS)
    model.save_pretrained(folder)
    return model
