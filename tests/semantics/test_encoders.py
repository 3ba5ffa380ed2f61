"""Encoders through the real loading path, with tiny models made here, broken folders, and vocabularies."""

import json
import os
import pickle
import re
import subprocess
import sys
from collections.abc import Callable
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tokenizers import Tokenizer
from transformers import CLIPModel, CLIPTokenizerFast

from langsplat_core.arrays import unit
from langsplat_core.errors import EncoderError, InputError
from langsplat_core.io.hostile import FromFile
from langsplat_core.scene import Calibration, PlattScaling
from langsplat_core.semantics.clip_plain import (
    PlainClipImages,
    PlainClipText,
    plain_text_tower,
    read_tokenizer,
)
from langsplat_core.semantics.encoders import (
    ClipText,
    PhraseEncoder,
    clip_images,
    clip_text,
    load_encoder,
    load_text_encoder,
)
from langsplat_core.semantics.relevancy import BUNDLED, bundled_vocabulary, read_vocabulary
from langsplat_core.semantics.sam import load_segmenter, load_text_segmenter
from langsplat_core.semantics.weights import Weights
from tests.support.tiny_models import (
    SAM_SIDE,
    SIDE,
    WORDS,
    MakesFolder,
    change_json,
    tiny_clip,
    tiny_metaclip2,
    tiny_sam,
    tiny_sam2,
    tiny_sam3,
    tiny_tipsv2,
)

pytestmark = pytest.mark.long


def crops(count: int) -> np.ndarray:
    return np.random.default_rng(1).integers(0, 256, (count, SIDE, SIDE, 3), dtype=np.uint8)


def test_images_in_numpy_agree_with_torch(tmp_path: Path) -> None:
    tiny_clip(tmp_path)
    want = load_encoder(str(tmp_path), "cpu").encode_images(crops(5))
    teach(tmp_path, "mug")
    assert isinstance(clip_images(Weights("tiny", tmp_path, "cpu")), PlainClipImages)
    np.testing.assert_allclose(load_encoder(str(tmp_path), "cpu").encode_images(crops(5)), want, atol=2e-6)


def test_pickled_weights_give_the_same_vectors(tmp_path: Path) -> None:
    state = tiny_clip(tmp_path).state_dict()
    before = load_encoder(str(tmp_path), "cpu").encode_images(crops(1))
    (tmp_path / "model.safetensors").unlink()
    torch.save(state, tmp_path / "pytorch_model.bin")
    after = load_encoder(str(tmp_path), "cpu").encode_images(crops(1))
    # equal weights at other addresses: torch may add up in another order
    np.testing.assert_allclose(after, before, rtol=0, atol=2e-7)


def test_a_vocabulary_makes_words_unknown(tmp_path: Path) -> None:
    tiny_clip(tmp_path)
    assert load_text_encoder(str(tmp_path)).unknown_words("ardent mule") == ()
    (tmp_path / "vocabulary.txt").write_text("\n".join(WORDS), encoding="utf-8")
    encoder = load_text_encoder(str(tmp_path))
    assert encoder.unknown_words("Red, APPLE handl") == ("handl",)
    assert encoder.encode_texts(["Red  mug"]).shape == (1, 24)
    with pytest.raises(
        EncoderError,
        match=r"'handl' \(did you mean 'handle'\?\); .* 7 words, such as apple, .*--clip\.model laion/",
    ):
        encoder.encode_texts(["handl"])


def test_absent_weights_say_what_to_pass(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    with pytest.raises(EncoderError, match=r"no such folder; pass `--clip\.model FOLDER`"):
        load_encoder("./nowhere")
    with pytest.raises(EncoderError, match=r"no config\.json with model\.safetensors"):
        load_encoder(str(tmp_path))
    with pytest.raises(EncoderError, match=r"HF_HUB_OFFLINE is set.*`hf download nobody/nothing-here`"):
        load_encoder("nobody/nothing-here")


STRANGERS = ["~nosuchuser/x", "nobody/nothing-here", "//host/share", "/dev/zero", "a\0b"]


@pytest.mark.parametrize("name", [*STRANGERS, "x" * 5000, "a/" + "b" * 5000])
def test_names_in_files_neither_fetch_nor_end_the_program(name: str, monkeypatch) -> None:
    asked: list[object] = []
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", False)
    monkeypatch.setattr("socket.getaddrinfo", lambda *host, **_: asked.append(host) or [])
    with pytest.raises(EncoderError) as caught:
        load_text_encoder(FromFile(name))
    assert len(str(caught.value)) < 500
    assert "--encoder" in str(caught.value)
    assert asked == []


def said(encoder):
    return encoder.temperature, encoder.found, encoder.calibration


def test_reading_json_is_read_beside_the_weights(tmp_path):
    tiny_clip(tmp_path)
    odds = {"constant": -1, "whole": 18.5, "finer": 2.5, "found": 0.7}
    stated = {"thing": odds, "part": {"constant": 0, "whole": 0, "finer": 9}, "inside": odds}
    (tmp_path / "reading.json").write_text("{}")
    assert said(load_text_encoder(str(tmp_path))) == (10.0, 0.6, None)
    (tmp_path / "reading.json").write_text(json.dumps({"calibration": stated}))
    both = PlattScaling(-1, 18.5, 2.5, 0.7)
    want = 10.0, 0.6, Calibration(both, PlattScaling(0, 0, 9), both)
    assert said(load_text_encoder(str(tmp_path))) == said(load_encoder(str(tmp_path), "cpu")) == want
    (tmp_path / "reading.json").write_text('{"found": 0.8}')
    assert said(load_text_encoder(str(tmp_path))) == (10.0, 0.8, None)


ODDS = '{"constant": 0, "whole": 1, "finer": 0}'

BROKEN_READINGS = (
    *("[", '{"found": 2}', '{"verdict": {}}', '{"calibration": {}}'),
    *(
        f'{{"calibration": {{"thing": {ODDS}, "part": {{"constant": 0, {broken}}}, "inside": {ODDS}}}}}'
        for broken in ('"whole": 1', '"whole": NaN, "finer": 0', '"whole": -1, "finer": 0.5')
    ),
)

BROKEN_NORMALISATIONS = ("{", '{"image_mean": [0.5]}', '{"image_std": [0, 0, 0]}')
BROKEN_NORMALISATIONS += tuple(f'{{"image_std": [1, 1, {number}]}}' for number in ("1e308", f"1{400 * '0'}"))


@pytest.mark.parametrize(
    ("name", "text"),
    [
        *(("reading.json", text) for text in BROKEN_READINGS),
        *(("preprocessor_config.json", text) for text in BROKEN_NORMALISATIONS),
    ],
)
def test_broken_files_beside_weights_are_named(tmp_path, name, text):
    tiny_clip(tmp_path)
    (tmp_path / name).write_text(text, encoding="utf-8")
    with pytest.raises(EncoderError, match=re.escape(name)):
        load_encoder(str(tmp_path), "cpu")


def with_tokenizer(old: str, new: str) -> Callable[[Path], object]:
    """The folder's tokenizer.json with other words in it."""

    def write(folder: Path) -> None:
        path = folder / "tokenizer.json"
        path.write_text(path.read_text(encoding="utf-8").replace(old, new), encoding="utf-8")

    return write


def holding(name: str, text: str) -> Callable[[Path], object]:
    return lambda folder: (folder / name).write_text(text, encoding="utf-8")


NO_RULES = r"tokenizer\.json is no tokenizer of this model"


def tokenizer_of(change: Callable[[dict[str, Any]], object]) -> Callable[[Path], None]:
    return lambda folder: change_json(folder / "tokenizer.json", change)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (tokenizer_of(lambda stated: stated.update(normalizer=0)), NO_RULES),
        (lambda folder: (folder / "tokenizer.json").unlink(), r"no tokenizer\.json in"),
        (holding("tokenizer.json", '{"version": "1.0"}'), NO_RULES),
        (with_tokenizer("<|endoftext|>", "<o>"), "no eos_token"),
        (holding("config.json", '{"model_type": "bert"}'), "'bert' is none .* are clip"),
        (holding("config.json", "[" * 100_000), r"config\.json cannot be read"),
    ],
)
def test_a_broken_folder_is_named(tmp_path: Path, damage: Callable[[Path], object], message: str) -> None:
    tiny_clip(tmp_path)
    damage(tmp_path)
    with pytest.raises(EncoderError, match=message):
        load_text_encoder(str(tmp_path))


# The text half of a small CLIP in NumPy, against transformers' in float64.

DEMO = Path(str(files("langsplat_assets"))) / "demo_encoder"

CLOSE = 1e-5  # of unit vectors


def by_transformers(folder: Path, phrases: list[str]) -> np.ndarray:
    """Return (M, D) float64 unit vectors, one phrase at a time and so without padding."""
    model = CLIPModel.from_pretrained(folder, dtype=torch.float64).eval()
    tokenizer = CLIPTokenizerFast.from_pretrained(folder)
    with torch.inference_mode():
        ids = [torch.tensor([tokenizer(phrase).input_ids]) for phrase in phrases]
        rows = [model.text_projection(model.text_model(input_ids=row).pooler_output)[0] for row in ids]
    return unit(torch.stack(rows).numpy())


def setting(folder: Path, part: str, name: str, value: object) -> str:
    """The folder, with a number of a part of its configuration changed."""
    change_json(folder / "config.json", lambda stated: stated[part].update({name: value}))
    return str(folder)


def teach(folder: Path, *words: str) -> None:
    (folder / "vocabulary.txt").write_text("\n".join(words), encoding="utf-8")


def taught(folder: Path) -> list[str]:
    return (folder / "vocabulary.txt").read_text(encoding="utf-8").split()


def test_bundled_encoder_in_numpy_agrees_with_torch(measured) -> None:
    words = taught(DEMO)
    phrases = [*words, *(f"{a} {b}" for a, b in zip(words, words[7:], strict=False)), "handle of the red mug"]
    tower = clip_text(Weights("demo", DEMO, "cpu"))
    assert isinstance(tower, PlainClipText)
    got, want = unit(tower.encode(phrases)), by_transformers(DEMO, phrases)
    assert got.dtype == np.float32
    error = np.abs(got - want).max()
    measured("demo text vectors", "largest error", float(error))
    assert error < CLOSE


@pytest.mark.parametrize("half", [False, True])
def test_random_weights_agree_with_float64(tmp_path: Path, half: bool) -> None:
    tiny_clip(tmp_path, half)
    teach(tmp_path, "red", "mug", "a", "handle")
    tower = clip_text(Weights("tiny", tmp_path, "cpu"))
    assert isinstance(tower, PlainClipText)
    phrases = ["red mug", "a", "handle"]
    want = by_transformers(tmp_path, phrases)
    np.testing.assert_allclose(unit(tower.encode(phrases)), want, atol=CLOSE)
    np.testing.assert_allclose(load_encoder(str(tmp_path), "cpu").encode_texts(phrases), want, atol=CLOSE)
    by_torch = ClipText(Weights("tiny", tmp_path, "cpu"))
    np.testing.assert_allclose(tower.encode(phrases), by_torch.encode(phrases), rtol=1e-4, atol=CLOSE)
    assert tower.dim == by_torch.dim == 24


NOT_PLAIN: dict[str, Callable[[Path], object]] = {
    "no tokenizer": lambda folder: (folder / "tokenizer.json").unlink(),
    "tokens that have no vector": tokenizer_of(lambda stated: stated["model"]["vocab"].update(rare=10**6)),
    "long phrases": lambda folder: setting(folder, "text_config", "max_position_embeddings", 10**6),
    "another activation": lambda folder: setting(folder, "text_config", "hidden_act", "gelu"),
    "fewer layers": lambda folder: setting(folder, "text_config", "num_hidden_layers", 1),
    "open words": lambda folder: (folder / "vocabulary.txt").unlink(),
    "words of other letters": lambda folder: teach(folder, "mug", "café"),
    "cut weights": lambda folder: os.truncate(folder / "model.safetensors", 2000),
}


@pytest.mark.parametrize("case", NOT_PLAIN)
def test_unknown_clip_configurations_are_left_to_torch(tmp_path: Path, case: str) -> None:
    tiny_clip(tmp_path)
    teach(tmp_path, "mug")
    weights = Weights("tiny", tmp_path, "cpu")
    assert plain_text_tower(weights) is not None
    assert plain_text_tower(Weights("tiny", tmp_path, "cuda")) is None
    NOT_PLAIN[case](tmp_path)
    assert plain_text_tower(weights) is None


@pytest.mark.parametrize("plain", [True, False])
def test_long_phrases_are_refused_and_not_cut(tmp_path: Path, plain: bool) -> None:
    """The tokenizer's token for what it cannot read is the one that ends a phrase."""
    tiny_clip(tmp_path)
    teach(tmp_path, "red")
    weights = Weights("tiny", tmp_path, "cpu")
    tower = clip_text(weights) if plain else ClipText(weights)
    assert isinstance(tower, PlainClipText) == plain
    for phrase in ("red-mug", '"red"', "mug ☕ mug", "red <|endoftext|> mug"):
        with pytest.raises(EncoderError, match="marks that this encoder cannot read"):
            tower.encode(["red", phrase])
    with pytest.raises(InputError, match="is too long: 42 tokens, not 38"):
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


def test_words_are_read_as_tokenizers_reads_them() -> None:
    ours, theirs = read_tokenizer(DEMO / "tokenizer.json"), Tokenizer.from_file(str(DEMO / "tokenizer.json"))
    for word in (*taught(DEMO), "penguni", "aab"):
        assert ours.encode(word) == theirs.encode(word, add_special_tokens=False).ids


def test_neither_torch_nor_transformers_is_imported() -> None:
    """By the bundled encoder, and by a command that asks it."""
    code = (
        "import sys; from importlib.resources import files; from langsplat_core import load_text_encoder;"
        "assert load_text_encoder('demo').encode_texts(['red mug']).shape == (1, 512);"
        "heavy = {'torch', 'transformers', 'tokenizers', 'huggingface_hub'};"
        "assert not (heavy | {'scipy'}) & sys.modules.keys();"
        "from langsplat_core.cli.app import parse; scene = files('langsplat_assets') / 'demo' / 'scene.ply';"
        "parse(['query', str(scene), 'blue gift']).run(); print(heavy & sys.modules.keys())"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "set()"


# Folders of weights that hold something else: one line each, and nothing in them is run.

PLAIN, WEIGHTS = "pytorch_model.bin", "model.safetensors"


@pytest.mark.parametrize("write", [lambda content, path: path.write_bytes(pickle.dumps(content)), torch.save])
@pytest.mark.parametrize(
    ("make", "load"), [(tiny_clip, load_encoder), (tiny_clip, load_text_encoder), (tiny_sam, load_segmenter)]
)
def test_a_pickle_with_code_is_refused_and_not_run(write, make, load, tmp_path: Path, recwarn) -> None:  # type: ignore[no-untyped-def]
    folder = tmp_path / "model"
    folder.mkdir()
    make(folder)
    (folder / WEIGHTS).unlink()
    enough = bytes(1 << 20)  # for as many numbers as the model has
    write({"text_model.embeddings": MakesFolder(tmp_path / "ran"), "more": enough}, folder / PLAIN)
    with pytest.raises(EncoderError, match="a pickle that holds more than tensors") as caught:
        load(str(folder))
    assert len(str(caught.value)) < 300
    assert not (tmp_path / "ran").exists()
    assert not recwarn.list


@pytest.mark.parametrize("content", [b"", b"\x80", b"words", bytes(8) + b"{}", b"PK\x03\x04" + bytes(40)])
@pytest.mark.parametrize(("name", "size"), [(PLAIN, 0), (WEIGHTS, 0), (PLAIN, 1 << 20), (WEIGHTS, 1 << 20)])
def test_bytes_that_are_no_weights_are_refused(content: bytes, name: str, size: int, tmp_path: Path) -> None:
    tiny_clip(tmp_path)
    (tmp_path / WEIGHTS).unlink()
    (tmp_path / name).write_bytes(content + bytes(size))
    with pytest.raises(EncoderError, match="weights"):
        load_text_encoder(str(tmp_path))


FOLDERS: dict[str, tuple[Callable[[Path], object], Callable[[str], Any]]] = {
    "CLIP": (tiny_clip, load_encoder),
    "SAM": (tiny_sam, load_segmenter),
    "SAM 2": (tiny_sam2, load_segmenter),
    "SAM 3": (tiny_sam3, load_segmenter),
    "SAM 3, phrases": (tiny_sam3, load_text_segmenter),
    "MetaCLIP 2": (tiny_metaclip2, load_encoder),
    "TIPS v2": (tiny_tipsv2, load_encoder),
}


def replace(config: dict[str, Any], name: str, value: object) -> None:
    """Change every setting of a name, in all parts of a configuration."""
    for key, part in config.items():
        if isinstance(part, dict):
            replace(part, name, value)
        elif key == name:
            config[key] = value


@pytest.mark.parametrize("kind", FOLDERS)
@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("hidden_size", 10**9),
        ("num_hidden_layers", 10**9),
        ("num_hidden_layers", 1),  # one fewer than the weights have
        ("num_hidden_layers", 3),
        ("intermediate_size", 40),
        ("blocks_per_stage", [10**9]),
    ],
)
def test_a_configuration_of_other_sizes_is_refused(kind, name, value, tmp_path):
    """Before a model of these sizes is filled with random numbers."""
    make, load = FOLDERS[kind]
    make(tmp_path)
    path = tmp_path / "config.json"
    before = path.read_text(encoding="utf-8")
    change_json(path, lambda config: replace(config, name, value))
    if json.loads(before) != json.loads(path.read_text(encoding="utf-8")):
        with pytest.raises(EncoderError) as caught:
            load(str(tmp_path))
        assert str(caught.value).startswith(str(tmp_path))


def test_asking_names_a_configuration_that_does_not_fit(tmp_path: Path) -> None:
    tiny_clip(tmp_path / "clip")
    encoder = load_encoder(setting(tmp_path / "clip", "text_config", "eos_token_id", None))
    with pytest.raises(EncoderError, match=r"the encoder: cannot be asked; does config\.json belong to it"):
        encoder.encode_texts(["red mug"])
    tiny_sam2(tmp_path / "sam")
    segmenter = load_segmenter(setting(tmp_path / "sam", "vision_config", "fpn_padding", -1))
    with pytest.raises(EncoderError, match="the segmenter: cannot be asked"):
        segmenter.encode(np.zeros((SAM_SIDE, SAM_SIDE, 3), np.uint8))


# Vocabularies: the bundled lists, and files of others with everything that can be wrong in them.


def test_vocabulary_files_are_read_leniently(tmp_path):
    """A byte order mark, lines ended as on Windows, capitals, spaces, doubles, comments, other scripts."""
    path = tmp_path / "mine.txt"
    path.write_bytes("\ufeffRed  Mug\r\n# kitchen\r\n\r\n  cup # chipped\r\nred mug\r\nтарелка\r\n".encode())
    assert read_vocabulary(path) == ("red mug", "cup", "тарелка")
    assert min(len(bundled_vocabulary(name)) for name in BUNDLED) > 10


def test_a_text_tower_need_not_say_its_batch(tmp_path: Path) -> None:
    """As those of extensions, which know `dim`, `temperature` and `encode` alone."""
    sizes: list[int] = []

    class Tower:
        dim, temperature = 3, 10.0

        def encode(self, texts: list[str]) -> np.ndarray:
            sizes.append(len(texts))
            return np.ones((len(texts), 3), np.float32)

    vectors = PhraseEncoder(Weights("x", tmp_path, "cpu"), Tower()).encode_texts(["mug"] * 150)
    assert vectors.shape == (150, 3)
    assert sum(sizes) == 150
