"""The text half of a small CLIP in NumPy, from the files of its weights and tokenizer.

Written here so that search needs neither torch nor transformers nor tokenizers, which take seconds to import
and hundreds of megabytes to install.

The network is that of Radford et al. 2021: token and position vectors, layers of causal self-attention and a
two-layer perceptron, each behind a layer norm and added to what came in, a last norm, and the vector at the
end token projected. It is equal to `transformers.CLIPTextModelWithProjection` but for rounding. The tokenizer
is CLIP's byte-level byte-pair encoding (Sennrich et al. 2016), equal to that of `tokenizers` but for letters
that are newer than Python's table of Unicode.
"""

import json
import re
import unicodedata
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from itertools import groupby, pairwise
from pathlib import Path

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.semantics.encoder import FILE, check_whole
from langsplat_core.semantics.weights import CONFIG, SAFE, Weights

# Of the text half. NumPy was the quicker one at 63 million too; but checkpoints that large
# come from elsewhere, and their tokenizers have not been compared with transformers' reading of them.
MOST_WEIGHTS = 20_000_000
MOST_LAYERS = 64  # of a model that is small: beyond, its shapes alone could fill the memory
TEMPERATURE = 10.0  # of LERF and LangSplat, whatever scale a checkpoint ended its training with
# What reading a file raises that states something else.
UNCLEAR = (OSError, ValueError, TypeError, KeyError, AttributeError, OverflowError, RecursionError)
READABLE = ("F16", "F32", "F64")  # types of safetensors that NumPy has too
LEGACY_END = 2  # of configurations whose end token is the one with the highest number
PREFIX = "text_model."
TOKENS, POSITIONS = (f"{PREFIX}embeddings.{name}_embedding.weight" for name in ("token", "position"))
PROJECTION = "text_projection.weight"

Tensors = Mapping[str, Array]  # name -> float32

# How tokenizer.json states CLIP's rules; a file that states others is left to `tokenizers`.
NORMALIZERS = (
    {"type": "NFC"},
    {"type": "Replace", "pattern": {"Regex": "\\s+"}, "content": " "},
    {"type": "Lowercase"},
)
SPLIT = r"<\|startoftext\|>|<\|endoftext\|>|'s|'t|'re|'ve|'m|'ll|'d|[\p{L}]+|[\p{N}]|[^\s\p{L}\p{N}]+"
END_OF_WORD = "</w>"
# `SPLIT` in Python's syntax, which has no classes of letters and numbers: runs of both are parted afterwards.
# Unlike Unicode, it also counts four control characters as spaces.
PIECES = re.compile(
    r"<\|startoftext\|>|<\|endoftext\|>|'s|'t|'re|'ve|'m|'ll|'d|[^\W_]+|(?:[^\s\w]|[_\x1c-\x1f])+"
)


@dataclass(frozen=True)
class TextConfig:
    """Settings that the weights alone do not say; defaults as of `transformers.CLIPTextConfig`."""

    vocab_size: int = 49_408
    hidden_size: int = 512
    intermediate_size: int = 2_048
    num_hidden_layers: int = 12
    num_attention_heads: int = 8
    max_position_embeddings: int = 77
    hidden_act: str = "quick_gelu"
    layer_norm_eps: float = 1e-5
    eos_token_id: int = 49_407
    projection_dim: int = 512

    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Every tensor of the text half and its shape."""
        wide, inner = self.hidden_size, self.intermediate_size
        found: dict[str, tuple[int, ...]] = {
            TOKENS: (self.vocab_size, wide),
            POSITIONS: (self.max_position_embeddings, wide),
            PROJECTION: (self.projection_dim, wide),
        }
        matrices = {f"self_attn.{name}_proj": (wide, wide) for name in ("q", "k", "v", "out")}
        matrices |= {"mlp.fc1": (inner, wide), "mlp.fc2": (wide, inner)}
        norms = [f"{PREFIX}final_layer_norm"]
        for number in range(self.num_hidden_layers):
            layer = _layer(number)
            norms += [f"{layer}layer_norm1", f"{layer}layer_norm2"]
            for name, shape in matrices.items():
                found |= {f"{layer}{name}.weight": shape, f"{layer}{name}.bias": shape[:1]}
        return found | {f"{name}.{part}": (wide,) for name in norms for part in ("weight", "bias")}


class PlainClipText:
    """A `TextTower` in NumPy."""

    def __init__(self, id: str, config: TextConfig, tensors: Tensors, tokenizer: "PairTokenizer") -> None:
        self.id = id
        self.temperature = TEMPERATURE
        self.config, self.tensors, self.tokenizer = config, tensors, tokenizer

    @property
    def dim(self) -> int:
        return self.config.projection_dim

    def encode(self, texts: list[str]) -> Array:
        begin, end = self.tokenizer.begin, self.tokenizer.end
        rows = [[begin, *self.tokenizer.encode(text), end] for text in texts]
        for text, row in zip(texts, rows, strict=True):
            check_whole(text, row[1:-1], self.config.max_position_embeddings - 2, {end})
        longest = max(map(len, rows))
        # What follows the end token is not seen by it.
        ids = np.array([row + [end] * (longest - len(row)) for row in rows])
        return text_vectors(self.tensors, self.config, ids, np.array([len(row) - 1 for row in rows]))


def plain_text_tower(weights: Weights) -> PlainClipText | None:
    """Return the text half in `weights`, if it is small, whole and of a kind that is computed here.

    Else None, and torch reads the folder, or says what is wrong with it.
    """
    if weights.device != "cpu" or weights.converted:
        return None
    config = _text_config(weights)
    if (
        config is None
        or config.hidden_act not in _ACTIVATIONS
        or config.num_hidden_layers > MOST_LAYERS
        or config.hidden_size % config.num_attention_heads
    ):
        return None
    shapes = config.shapes()
    if sum(int(np.prod(shape)) for shape in shapes.values()) > MOST_WEIGHTS:
        return None
    tokenizer = read_pair_tokenizer(weights.folder / FILE)
    tensors = _tensors(weights.folder, shapes) if tokenizer else None
    if tokenizer is None or tensors is None:
        return None
    numbers = set(tokenizer.numbers.values())
    end = config.eos_token_id if config.eos_token_id != LEGACY_END else max(numbers, default=-1)
    if tokenizer.end != end or not {tokenizer.begin, end} <= numbers <= set(range(config.vocab_size)):
        return None
    return PlainClipText(weights.id, config, tensors, tokenizer)


def text_vectors(tensors: Tensors, config: TextConfig, ids: Array, ends: Array) -> Array:
    """(B, L) token numbers, and (B,) where the end token of each row is -> (B, D) float32, of any length."""
    eps, activate = config.layer_norm_eps, _ACTIVATIONS[config.hidden_act]
    length = ids.shape[1]
    later = np.triu(np.full((length, length), -np.inf, np.float32), 1)
    x = tensors[TOKENS][ids] + tensors[POSITIONS][:length]
    for number in range(config.num_hidden_layers):
        layer = _layer(number)
        before = _norm(tensors, f"{layer}layer_norm1", x, eps)
        x = x + _attention(tensors, f"{layer}self_attn.", before, later, config.num_attention_heads)
        inner = _linear(tensors, f"{layer}mlp.fc1", _norm(tensors, f"{layer}layer_norm2", x, eps))
        x = x + _linear(tensors, f"{layer}mlp.fc2", activate(inner))
    last = _norm(tensors, f"{PREFIX}final_layer_norm", x[np.arange(len(ids)), ends], eps)
    return last @ tensors[PROJECTION].T


def _layer(number: int) -> str:
    return f"{PREFIX}encoder.layers.{number}."


def _linear(tensors: Tensors, name: str, x: Array) -> Array:
    weight = tensors[f"{name}.weight"]
    # As one product of matrices: NumPy would take (B, L, W) in B small ones, ten times slower.
    product = x.reshape(-1, x.shape[-1]) @ weight.T + tensors[f"{name}.bias"]
    return product.reshape(*x.shape[:-1], len(weight))


def _norm(tensors: Tensors, name: str, x: Array, eps: float) -> Array:
    centred = x - x.mean(-1, keepdims=True)
    spread = np.sqrt((centred**2).mean(-1, keepdims=True) + np.float32(eps))
    return centred / spread * tensors[f"{name}.weight"] + tensors[f"{name}.bias"]


def _attention(tensors: Tensors, name: str, x: Array, later: Array, heads: int) -> Array:
    """x: (B, L, W); later: (L, L), -infinity where a token comes after another one."""
    batch, length, wide = x.shape
    query, key, value = (
        _linear(tensors, f"{name}{part}_proj", x).reshape(batch, length, heads, -1).transpose(0, 2, 1, 3)
        for part in "qkv"
    )
    scores = query @ key.transpose(0, 1, 3, 2) * np.float32((wide // heads) ** -0.5) + later
    shares = np.exp(scores - scores.max(-1, keepdims=True))
    shares /= shares.sum(-1, keepdims=True)
    return _linear(tensors, f"{name}out_proj", (shares @ value).transpose(0, 2, 1, 3).reshape(x.shape))


def _quick_gelu(x: Array) -> Array:
    with np.errstate(over="ignore"):  # of a large negative number: 0
        gelu: Array = x / (1 + np.exp(np.float32(-1.702) * x))
    return gelu


def _gelu(x: Array) -> Array:
    from scipy.special import erf

    return np.float32(0.5) * x * (1 + erf(x * np.float32(0.5**0.5)))


_ACTIVATIONS: Mapping[str, Callable[[Array], Array]] = {"quick_gelu": _quick_gelu, "gelu": _gelu}


def _text_config(weights: Weights) -> TextConfig | None:
    """Return settings of the text half in config.json; None where they cannot be understood."""
    try:
        whole = json.loads((weights.folder / CONFIG).read_text(encoding="utf-8"))
        stated = {**(whole.get("text_config") or {}), **(whole.get("text_config_dict") or {})}
        stated["projection_dim"] = whole.get("projection_dim", TextConfig.projection_dim)
        kinds = {name: type(getattr(TextConfig, name)) for name in TextConfig.__dataclass_fields__}
        config = TextConfig(**{name: kind(stated[name]) for name, kind in kinds.items() if name in stated})
    except UNCLEAR:
        return None
    return (
        config if min(config.num_attention_heads, config.num_hidden_layers, config.hidden_size) > 0 else None
    )


@dataclass(frozen=True)
class PairTokenizer:
    """Tokenizer of CLIP's byte-pair encoding."""

    numbers: Mapping[str, int]  # token -> its number
    ranks: Mapping[tuple[str, str], int]  # pair of tokens that are merged -> its place, the lowest first
    begin: int  # number of the token before a phrase
    end: int  # of the one behind it, which also stands for what the vocabulary lacks

    def encode(self, text: str) -> list[int]:
        """Numbers of the tokens of `text`, without those that begin and end a phrase."""
        return [self.numbers.get(token, self.end) for piece in _pieces(text) for token in self._merged(piece)]

    def _merged(self, piece: str) -> list[str]:
        """Return the tokens of a word: its bytes, of which neighbours are merged by their ranks."""
        if piece in ("<|startoftext|>", "<|endoftext|>"):
            return [""]  # neither may stand within a phrase
        word = [BYTES[byte] for byte in piece.encode()]
        word[-1] += END_OF_WORD
        while pairs := [pair for pair in pairwise(word) if pair in self.ranks]:
            first = min(pairs, key=self.ranks.__getitem__)
            merged, at = [], 0
            while at < len(word):
                taken = 2 if tuple(word[at : at + 2]) == first else 1
                merged.append("".join(word[at : at + taken]))
                at += taken
            word = merged
        return word


def _pieces(text: str) -> Iterator[str]:
    """Pieces that `SPLIT` finds in `text` behind the normalizers: words, single numbers, runs of marks."""
    plain = "".join(letter.lower() for letter in unicodedata.normalize("NFC", text))
    for found in PIECES.findall(plain):
        for is_word, letters in groupby(found, str.isalpha) if found[0].isalnum() else [(True, found)]:
            yield from ["".join(letters)] if is_word else letters


def _byte_letters() -> tuple[str, ...]:
    """Return the letter that stands for each byte in a byte-level vocabulary (Radford et al. 2019).

    It is the byte itself where Latin-1 prints it, the others from U+0100 on.
    """
    shown = [*range(0x21, 0x7F), *range(0xA1, 0xAD), *range(0xAE, 0x100)]
    others = [byte for byte in range(256) if byte not in shown]
    return tuple(chr(byte if byte in shown else 256 + others.index(byte)) for byte in range(256))


BYTES = _byte_letters()


def read_pair_tokenizer(path: Path) -> PairTokenizer | None:
    """Return the tokenizer of a tokenizer.json that states CLIP's rules.

    None for another, and for no file.
    """
    try:
        stated = json.loads(path.read_text(encoding="utf-8"))
        model, ends = stated["model"], stated["post_processor"]
        split, level = stated["pre_tokenizer"]["pretokenizers"]
        rules = (
            *stated["normalizer"]["normalizers"],
            *(model["type"], model["end_of_word_suffix"], model["unk_token"], ends["type"]),
            *(split["pattern"], split["behavior"], split["invert"]),
            *(level["type"], level["add_prefix_space"]),
        )
        (last, end), (_, begin) = ends["sep"], ends["cls"]
        if rules != (
            *NORMALIZERS,
            *("BPE", END_OF_WORD, last, "RobertaProcessing"),
            *({"Regex": SPLIT}, "Removed", True),
            *("ByteLevel", False),
        ):
            return None
        merges = [pair.split() if isinstance(pair, str) else pair for pair in model["merges"]]
        ranks = {(first, second): rank for rank, (first, second) in enumerate(merges)}
        return PairTokenizer({str(k): int(v) for k, v in model["vocab"].items()}, ranks, int(begin), int(end))
    except UNCLEAR:
        return None


def _tensors(folder: Path, shapes: Mapping[str, tuple[int, ...]]) -> dict[str, Array] | None:
    """Return the tensors of these names as float32, from all safetensors of a folder.

    None where one is absent, has another shape, or is of a type that NumPy lacks.
    """
    from safetensors import SafetensorError, safe_open

    found: dict[str, Array] = {}
    try:
        for path in sorted(path for pattern in SAFE for path in folder.glob(pattern)):
            with safe_open(path, framework="np") as file:
                for name in shapes.keys() & set(file.keys()):
                    tensor = file.get_slice(name)
                    if tuple(tensor.get_shape()) != shapes[name] or tensor.get_dtype() not in READABLE:
                        return None
                    found[name] = file.get_tensor(name).astype(np.float32)
    except (OSError, ValueError, SafetensorError):
        return None
    return found if len(found) == len(shapes) else None
