"""The text half of a small CLIP in NumPy, against transformers' in float64."""

import json
import subprocess
import sys
from collections.abc import Callable
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tokenizers import Tokenizer
from transformers import CLIPModel, CLIPTokenizerFast

from langsplat_core.errors import EncoderError, InputError
from langsplat_core.semantics.clip_plain import (
    BYTES,
    PlainClipText,
    TextConfig,
    plain_text_tower,
    read_pair_tokenizer,
)
from langsplat_core.semantics.encoders import ClipText, clip_text, load_text_encoder
from langsplat_core.semantics.weights import Weights
from tests.semantics.test_siglip import change_config
from tests.support.tiny_clip import tiny_clip

pytestmark = pytest.mark.long

DEMO = Path(str(files("langsplat_assets"))) / "demo_encoder"
PHRASES = ["red mug", "handle", "a", "the handle of a red mug things"]
CLOSE = 1e-5  # of unit vectors


def unit_rows(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def by_transformers(folder: Path, phrases: list[str]) -> np.ndarray:
    """(M, D) float64 unit vectors, one phrase at a time and so without padding."""
    model = CLIPModel.from_pretrained(folder, dtype=torch.float64).eval()
    tokenizer = CLIPTokenizerFast.from_pretrained(folder)
    with torch.inference_mode():
        ids = [torch.tensor([tokenizer(phrase).input_ids]) for phrase in phrases]
        rows = [model.text_projection(model.text_model(input_ids=row).pooler_output)[0] for row in ids]
    return unit_rows(torch.stack(rows).numpy())


def taught(folder: Path) -> list[str]:
    return (folder / "vocabulary.txt").read_text(encoding="utf-8").split()


def test_the_bundled_encoder_says_the_same_of_every_word_it_knows(measured) -> None:
    words = taught(DEMO)
    phrases = [*words, *(f"{a} {b}" for a, b in zip(words, words[7:], strict=False)), "handle of the red mug"]
    tower = clip_text(Weights("demo", DEMO, "cpu"))
    assert isinstance(tower, PlainClipText)
    got, want = unit_rows(tower.encode(phrases)), by_transformers(DEMO, phrases)
    assert got.dtype == np.float32
    error = np.abs(got - want).max()
    measured("demo text vectors", "largest error", float(error))
    assert error < CLOSE


@pytest.mark.parametrize("activation", ["quick_gelu", "gelu"])
@pytest.mark.parametrize("half", [False, True])
def test_a_random_one_agrees_with_float64(tmp_path: Path, activation: str, half: bool) -> None:
    tiny_clip(tmp_path, half)
    change_config(tmp_path, lambda config: config["text_config"].update(hidden_act=activation))
    tower = clip_text(Weights("tiny", tmp_path, "cpu"))
    assert isinstance(tower, PlainClipText)
    phrases = ["red mug", "a", "handle"]
    np.testing.assert_allclose(
        unit_rows(tower.encode(phrases)), by_transformers(tmp_path, phrases), atol=CLOSE
    )
    by_torch = ClipText(Weights("tiny", tmp_path, "cpu"))
    np.testing.assert_allclose(tower.encode(phrases), by_torch.encode(phrases), rtol=1e-4, atol=CLOSE)
    assert tower.dim == by_torch.dim == 24


def test_an_end_token_numbered_as_of_old(tmp_path: Path) -> None:
    """OpenAI's and OpenCLIP's configurations say 2, and mean the token with the highest number."""
    tiny_clip(tmp_path)
    path = tmp_path / "tokenizer.json"
    path.write_text(path.read_text(encoding="utf-8"), encoding="utf-8")
    change_config(tmp_path, lambda config: config["text_config"].update(eos_token_id=2))
    assert plain_text_tower(Weights("tiny", tmp_path, "cpu")) is None  # whose end token is the second


def rename_tokenizer(folder: Path) -> None:
    (folder / "tokenizer.json").rename(folder / "other.json")


def other_activation(folder: Path) -> None:
    change_config(folder, lambda config: config["text_config"].update(hidden_act="relu"))


def more_layers(folder: Path) -> None:
    change_config(folder, lambda config: config["text_config"].update(num_hidden_layers=3))


def narrower(folder: Path) -> None:
    change_config(folder, lambda config: config["text_config"].update(intermediate_size=40))


def cut_weights(folder: Path) -> None:
    weights = folder / "model.safetensors"
    weights.write_bytes(weights.read_bytes()[:2000])


def broken_config(folder: Path) -> None:
    (folder / "config.json").write_text("[]", encoding="utf-8")


def no_heads(folder: Path) -> None:
    change_config(folder, lambda config: config["text_config"].update(num_attention_heads=0))


@pytest.mark.parametrize(
    "damage",
    [rename_tokenizer, other_activation, more_layers, narrower, cut_weights, broken_config, no_heads],
)
def test_what_is_not_computed_here_is_left_to_torch(tmp_path: Path, damage: Callable[[Path], None]) -> None:
    tiny_clip(tmp_path)
    weights = Weights("tiny", tmp_path, "cpu")
    assert plain_text_tower(weights) is not None
    damage(tmp_path)
    assert plain_text_tower(weights) is None


def test_large_models_and_other_devices_are_left_to_torch(tmp_path: Path) -> None:
    tiny_clip(tmp_path)
    count = sum(int(np.prod(shape)) for shape in TextConfig().shapes().values())
    assert count == 63_428_096  # the text half of ViT-B/16
    assert plain_text_tower(Weights("tiny", tmp_path, "cpu"), most=1_000) is None
    assert plain_text_tower(Weights("tiny", tmp_path, "cuda")) is None


@pytest.mark.parametrize("plain", [True, False])
def test_no_phrase_loses_words_in_silence(tmp_path: Path, plain: bool) -> None:
    """The tokenizer's token for what it cannot read is the one that ends a phrase."""
    tiny_clip(tmp_path)
    weights = Weights("tiny", tmp_path, "cpu")
    tower = clip_text(weights) if plain else ClipText(weights)
    assert isinstance(tower, PlainClipText) == plain
    for phrase in ("red-mug", '"red"', "mug ☕ mug", "red <|endoftext|> mug"):
        with pytest.raises(EncoderError, match="marks that this encoder cannot read"):
            tower.encode(["red", phrase])
    with pytest.raises(InputError, match="is too long: 42 tokens; this encoder reads 38"):
        tower.encode(["handle " * 7])
    assert tower.encode(["handle mugs"]).shape == (1, 24)


@pytest.mark.parametrize(
    ("written", "meant"),
    [
        ('"red mug"', "red mug"),
        ("red-mug!", "red mug"),
        ("lamp-shade", "lamp shade"),
        ("duck/penguin", "duck penguin"),
        ("the mug's handle", "the mug handle"),
        ("red <mug>", "red mug"),
    ],
)
def test_the_bundled_encoder_is_asked_words_alone(written: str, meant: str) -> None:
    encoder = load_text_encoder("demo")
    np.testing.assert_array_equal(encoder.encode_texts([written]), encoder.encode_texts([meant]))
    assert encoder.unknown_words("penguni's") == ("penguni's",)
    assert encoder.near_words("penguni")[0] == "penguin"


def spelled_bytes(path: Path) -> Tokenizer:
    """The bundled tokenizer with a vocabulary that has every byte, within a word and at its end, and a few
    merges; written to `path`."""
    stated = json.loads((DEMO / "tokenizer.json").read_text(encoding="utf-8"))
    tokens = ["<|startoftext|>", "<|endoftext|>", *(byte + end for end in ("", "</w>") for byte in BYTES)]
    merges = [["a", "b"], ["ab", "ab"], ["a", "a"], ["'", "'"], ["Ã", "Ł"], ["0", "1</w>"], ["b", "a</w>"]]
    tokens += ["".join(pair) for pair in merges]
    stated["model"] |= {"vocab": {token: i for i, token in enumerate(tokens)}, "merges": merges}
    path.write_text(json.dumps(stated), encoding="utf-8")
    return Tokenizer.from_file(str(path))


def test_phrases_are_read_as_tokenizers_reads_them(tmp_path: Path) -> None:
    theirs = spelled_bytes(tmp_path / "tokenizer.json")
    ours = read_pair_tokenizer(tmp_path / "tokenizer.json")
    assert ours is not None
    # Letters as old as any table of Unicode: the two libraries have tables of different years.
    likely = st.sampled_from("aaabb01' -_.sÀßΣσİé\u0301²½Ⅷ漢ﬁ\t\n")

    @given(st.text(likely | st.characters(max_codepoint=0x2FF)))
    def check(phrase: str) -> None:
        assert ours.encode(phrase) == theirs.encode(phrase, add_special_tokens=False).ids

    check()
    assert ours.encode("red <|endoftext|>")[-1] == ours.end


@pytest.mark.parametrize("place", ["normalizer", "pre_tokenizer", "post_processor"])
def test_a_tokenizer_of_other_rules_is_not_read(tmp_path: Path, place: str) -> None:
    path = tmp_path / "tokenizer.json"
    spelled_bytes(path)
    stated = json.loads(path.read_text(encoding="utf-8"))
    path.write_text(json.dumps(stated | {place: {"type": "Sequence"}}), encoding="utf-8")
    assert read_pair_tokenizer(path) is None


def test_neither_torch_nor_transformers_is_imported() -> None:
    code = (
        "import sys; from langsplat_core import load_text_encoder;"
        "assert load_text_encoder('demo').encode_texts(['red mug']).shape == (1, 512);"
        "heavy = ('torch', 'transformers', 'tokenizers', 'huggingface_hub', 'scipy');"
        "print([m for m in heavy if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
