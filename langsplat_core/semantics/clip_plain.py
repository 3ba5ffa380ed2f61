"""A small CLIP with a closed vocabulary in NumPy, from the files of its weights and tokenizer.

It spares the bundled encoder torch, transformers and tokenizers: seconds to import, hundreds of megabytes.

The network is that of Radford et al. 2021: token and position embeddings, residual layers of causal
self-attention and a two-layer perceptron, each with a layer norm before it, a final norm, and a projection of
the end token. Image tokens are patches after a class token, which is projected. Results equal those of
`transformers.CLIPTextModelWithProjection` and `CLIPVisionModelWithProjection` up to rounding. The tokenizer
is CLIP's byte-pair encoding (Sennrich et al. 2016) for words of the letters a to z.
"""

import json
import math
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.errors import EncoderError, InputError, LangSplatError
from langsplat_core.semantics.weights import CONFIG, SAFE, Weights

TOKENIZER = "tokenizer.json"
VOCABULARY = "vocabulary.txt"  # beside the weights: all words that the encoder was taught, one per line
TEMPERATURE = 10.0  # of LERF and LangSplat; the logit scale of a checkpoint is not used
PREFIX = "text_model."
TOKENS, POSITIONS = (f"{PREFIX}embeddings.{name}_embedding.weight" for name in ("token", "position"))
PROJECTION = "text_projection.weight"
SEEN, PATCHES = "vision_model.", "vision_model.embeddings."

Tensors = Mapping[str, Array]  # name -> float32


@dataclass(frozen=True)
class TextConfig:
    """Settings that cannot be read from the weights; defaults as of `transformers.CLIPTextConfig`."""

    hidden_size: int = 512
    intermediate_size: int = 2_048
    num_hidden_layers: int = 12
    num_attention_heads: int = 8
    max_position_embeddings: int = 77
    hidden_act: str = "quick_gelu"
    layer_norm_eps: float = 1e-5
    eos_token_id: int = 49_407
    projection_dim: int = 512


@dataclass(frozen=True)
class VisionConfig(TextConfig):
    """The same for the image half."""

    num_attention_heads: int = 12


def check_whole(text: str, ids: Sequence[int], room: int, ends: Collection[int]) -> None:
    """Raise an error for a phrase of which the model would read only a part.

    ids: its tokens without those that begin and end a phrase; room: number that the model reads; ends: tokens
    that end a phrase, which some tokenizers return for every character that they cannot read. Raises
    InputError for a phrase that is too long, EncoderError for one that would end early.
    """
    if len(ids) > room:
        raise InputError(f"'{text[:40]} ...' is too long: {len(ids)} tokens, not {room}; use fewer words")
    if not set(ends).isdisjoint(ids):
        raise EncoderError(f"{text[:80]!r} holds marks that this encoder cannot read; use plain words")


class PlainClipText:
    """A `TextTower` in NumPy."""

    batch = 512  # small matrix products spend their time on synchronising threads

    def __init__(self, config: TextConfig, tensors: Tensors, tokenizer: "PairTokenizer") -> None:
        self.temperature, self.dim = TEMPERATURE, config.projection_dim
        self.config, self.tensors, self.tokenizer = config, tensors, tokenizer

    def encode(self, texts: list[str]) -> Array:
        begin, end = self.tokenizer.begin, self.tokenizer.end
        rows = [[begin, *self.tokenizer.encode(text), end] for text in texts]
        for text, row in zip(texts, rows, strict=True):
            check_whole(text, row[1:-1], self.config.max_position_embeddings - 2, {end})
        longest = max(map(len, rows))
        # By the causal mask, padding after the end token does not change its vector.
        ids = np.array([row + [end] * (longest - len(row)) for row in rows])
        return text_vectors(self.tensors, self.config, ids, np.array([len(row) - 1 for row in rows]))


def plain_text_tower(weights: Weights) -> PlainClipText | None:
    """Return the text half of `weights` if it is complete with a vocabulary of plain words; else None."""
    if weights.converted or weights.device != "cpu" or not (weights.folder / VOCABULARY).is_file():
        return None
    try:
        words = (weights.folder / VOCABULARY).read_text(encoding="utf-8").split()
        stated = json.loads((weights.folder / CONFIG).read_text(encoding="utf-8"))
        settings = {"projection_dim": stated["projection_dim"]}
        config = msgspec.convert({**stated["text_config"], **settings}, TextConfig)
        tokenizer = read_tokenizer(weights.folder / TOKENIZER)
        tensors = _tensors(weights.folder, config, PREFIX, PROJECTION, others=5)
        tower = PlainClipText(config, tensors, tokenizer)
        rows = len(tensors[TOKENS]), len(tensors[POSITIONS])
        # Checked here so that no later phrase fails.
        fits = set(tokenizer.numbers.values()) <= set(range(rows[0])) and tokenizer.end == config.eos_token_id
        fits = fits and config.hidden_act == "quick_gelu"
        plain = rows[1] == config.max_position_embeddings and all(re.fullmatch("[a-z]+", w) for w in words)
        return tower if fits and plain and tower.encode(words[:1]).shape == (1, tower.dim) else None
    except (OSError, ValueError, TypeError, LookupError, AttributeError, ArithmeticError, RecursionError):
        return None
    except LangSplatError:
        return None


class PlainClipImages:
    """An `ImageTower` in NumPy."""

    batch = 8  # images at a time: activations of more do not fit the processor's cache

    def __init__(self, config: VisionConfig, tensors: Tensors, statistics: tuple[Array, Array]) -> None:
        self.config, self.tensors, self.statistics = config, tensors, statistics
        self.patch = len(tensors[f"{PATCHES}patch_embedding.weight"][0, 0])  # px, its side
        self.side = math.isqrt(len(tensors[f"{PATCHES}position_embedding.weight"]) - 1)  # patches
        self.image_size = self.side * self.patch

    def encode(self, pixels: Array) -> Array:
        tensors, eps, shape = self.tensors, self.config.layer_norm_eps, (self.side, self.patch)
        cut = pixels.reshape(len(pixels), 3, *shape, *shape).transpose(0, 2, 4, 1, 3, 5)
        weight = tensors[f"{PATCHES}patch_embedding.weight"]
        patches = cut.reshape(len(pixels), self.side**2, -1) @ weight.reshape(len(weight), -1).T
        first = np.broadcast_to(tensors[f"{PATCHES}class_embedding"], (len(pixels), 1, len(weight)))
        x = np.concatenate([first, patches], 1) + tensors[f"{PATCHES}position_embedding.weight"]
        x = _layers(tensors, SEEN, self.config, _norm(tensors, f"{SEEN}pre_layrnorm", x, eps))  # spelt so
        return _norm(tensors, f"{SEEN}post_layernorm", x[:, 0], eps) @ tensors["visual_projection.weight"].T


def plain_image_tower(weights: Weights, statistics: tuple[Array, Array]) -> PlainClipImages | None:
    """Return the image half of weights as for `plain_text_tower`, if it is complete; else None."""
    if weights.converted or weights.device != "cpu" or not (weights.folder / VOCABULARY).is_file():
        return None
    try:
        stated = json.loads((weights.folder / CONFIG).read_text(encoding="utf-8"))["vision_config"]
        config = msgspec.convert(stated, VisionConfig)
        tensors = _tensors(weights.folder, config, SEEN, "visual_projection.weight", others=8)
        tower = PlainClipImages(config, tensors, statistics)
        fits = config.hidden_act == "quick_gelu" and tower.image_size == stated.get("image_size", 224)
        return tower if fits and tower.encode(np.zeros((1, 3, *2 * [tower.image_size]))).any() else None
    except (OSError, ValueError, TypeError, LookupError, AttributeError, ArithmeticError):
        return None


def _tensors(folder: Path, config: TextConfig, prefix: str, projection: str, others: int) -> dict[str, Array]:
    """Return the tensors of one half as float32; ValueError if their number does not fit its layers."""
    from safetensors import SafetensorError, safe_open

    found: dict[str, Array] = {}
    try:
        for path in (path for pattern in SAFE for path in folder.glob(pattern)):
            with safe_open(path, framework="np") as file:
                names = [name for name in file.keys() if name.startswith(prefix) or name == projection]  # noqa: SIM118
                found |= {name: file.get_tensor(name).astype(np.float32) for name in names}
    except SafetensorError as error:
        raise ValueError(error) from None
    if len(found) != others + 16 * config.num_hidden_layers:
        raise ValueError(f"{len(found)} tensors")
    return found


def text_vectors(tensors: Tensors, config: TextConfig, ids: Array, ends: Array) -> Array:
    """Return (B, D) float32 vectors, not normalised, of (B, L) tokens; ends: (B,) index of each end token."""
    eps, length = config.layer_norm_eps, ids.shape[1]
    later = np.triu(np.full((length, length), -np.inf, np.float32), 1)
    x = tensors[TOKENS][ids] + tensors[POSITIONS][:length]
    x = _layers(tensors, PREFIX, config, x, later)
    last = _norm(tensors, f"{PREFIX}final_layer_norm", x[np.arange(len(ids)), ends], eps)
    return last @ tensors[PROJECTION].T


def _layers(tensors: Tensors, prefix: str, config: TextConfig, x: Array, later: Array | None = None) -> Array:
    """Return (B, L, W) tokens after all layers; `later` as in `_attention`."""
    for number in range(config.num_hidden_layers):
        layer, eps = f"{prefix}encoder.layers.{number}.", config.layer_norm_eps
        before = _norm(tensors, f"{layer}layer_norm1", x, eps)
        x = x + _attention(tensors, f"{layer}self_attn.", before, later, config.num_attention_heads)
        inner = _linear(tensors, f"{layer}mlp.fc1", _norm(tensors, f"{layer}layer_norm2", x, eps))
        x = x + _linear(tensors, f"{layer}mlp.fc2", _quick_gelu(inner))
    return x


def _linear(tensors: Tensors, name: str, x: Array) -> Array:
    weight = tensors[f"{name}.weight"]
    # One matrix product: NumPy computes (B, L, W) as B small ones, ten times slower.
    product = x.reshape(-1, x.shape[-1]) @ weight.T
    product += tensors[f"{name}.bias"]
    return product.reshape(*x.shape[:-1], len(weight))


def _norm(tensors: Tensors, name: str, x: Array, eps: float) -> Array:
    centred = x - x.mean(-1, keepdims=True)
    squares = np.einsum("...i,...i", centred, centred)[..., None]
    centred /= np.sqrt(squares / np.float32(x.shape[-1]) + np.float32(eps))
    centred *= tensors[f"{name}.weight"]
    return centred + tensors[f"{name}.bias"]


def _attention(tensors: Tensors, name: str, x: Array, later: Array | None, heads: int) -> Array:
    """x: (B, L, W); later: (L, L) causal mask, -infinity for later tokens; None: no mask."""
    batch, length, wide = x.shape
    query, key, value = (
        _linear(tensors, f"{name}{part}_proj", x).reshape(batch, length, heads, -1).transpose(0, 2, 1, 3)
        for part in "qkv"
    )
    shares = (query * np.float32((wide // heads) ** -0.5)) @ key.transpose(0, 1, 3, 2)
    if later is not None:
        shares += later
    shares -= shares.max(-1, keepdims=True)
    np.exp(shares, out=shares)
    seen = (shares @ value) / shares.sum(-1, keepdims=True)
    return _linear(tensors, f"{name}out_proj", seen.transpose(0, 2, 1, 3).reshape(x.shape))


def _quick_gelu(x: Array) -> Array:
    shares = np.float32(-1.702) * x
    with np.errstate(over="ignore"):  # x / infinity = 0 for a large negative x
        np.exp(shares, out=shares)
    shares += 1
    return np.asarray(np.divide(x, shares, out=shares))


@dataclass(frozen=True)
class PairTokenizer:
    """Tokenizer with CLIP's byte-pair encoding, for words of the letters a to z separated by blanks."""

    numbers: Mapping[str, int]  # token -> its number
    ranks: Mapping[tuple[str, str], int]  # pair of tokens to merge -> rank; the lowest merges first
    begin: int  # number of the token before a phrase
    end: int  # of the one after it, also used for tokens that are not in the vocabulary

    def encode(self, text: str) -> list[int]:
        """Return the numbers of the tokens of `text`, without those that begin and end a phrase."""
        return [self.numbers.get(token, self.end) for word in text.split() for token in self._merged(word)]

    def _merged(self, text: str) -> list[str]:
        """Return the tokens of a word: its letters, merged in pairs by rank."""
        word = [*text[:-1], f"{text[-1]}</w>"]
        while pairs := [pair for pair in pairwise(word) if pair in self.ranks]:
            first = min(pairs, key=self.ranks.__getitem__)
            merged, at = [], 0
            while at < len(word):
                taken = 2 if tuple(word[at : at + 2]) == first else 1
                merged.append("".join(word[at : at + taken]))
                at += taken
            word = merged
        return word


def read_tokenizer(path: Path) -> PairTokenizer:
    """Return the tokenizer of a tokenizer.json of CLIP; ValueError or LookupError for another kind."""
    model: Any = json.loads(path.read_text(encoding="utf-8"))["model"]
    if (model["type"], model["end_of_word_suffix"]) != ("BPE", "</w>"):
        raise ValueError("no byte-pair encoding of CLIP's kind")
    pairs = [pair.split() if isinstance(pair, str) else pair for pair in model["merges"]]
    ranks = {(first, second): rank for rank, (first, second) in enumerate(pairs)}
    numbers = {str(token): int(number) for token, number in model["vocab"].items()}
    return PairTokenizer(numbers, ranks, numbers["<|startoftext|>"], numbers["<|endoftext|>"])
