"""SigLIP and SigLIP 2 through the real loading path, with tiny models made here."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from transformers import PreTrainedTokenizerFast, Siglip2Tokenizer, SiglipModel

from langsplat_core.errors import EncoderError
from langsplat_core.semantics.encoders import load_encoder, load_text_encoder
from tests.semantics.test_clip import crops
from tests.support.tiny_clip import SIDE
from tests.support.tiny_siglip import LENGTH, SCALE, tiny_siglip

pytestmark = pytest.mark.long

Maker = Callable[[Path], Any]
MAKERS: dict[str, Maker] = {
    "siglip": tiny_siglip,
    "siglip2": lambda folder: tiny_siglip(folder, second=True),
}


@pytest.fixture(scope="module", params=sorted(MAKERS))
def made(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Any]:
    folder = tmp_path_factory.mktemp("made") / request.param
    folder.mkdir()
    return folder, MAKERS[request.param](folder)


def unit_tensor(tensor: torch.Tensor) -> np.ndarray:
    rows = tensor.detach().numpy()
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


def padded_ids(tokenizer: Any, phrases: list[str]) -> torch.Tensor:
    """As the model's own pages say: padding="max_length", and no attention mask."""
    found = tokenizer(phrases, padding="max_length", max_length=LENGTH, truncation=True, return_tensors="pt")
    return found.input_ids


def test_texts_agree_with_the_whole_model(tmp_path: Path) -> None:
    model = tiny_siglip(tmp_path)
    phrases = ["red mug", "red", "a red mug with a very long handle"]
    tokenizer = PreTrainedTokenizerFast(
        tokenizer_file=str(tmp_path / "tokenizer.json"), pad_token="</s>", eos_token="</s>"
    )
    ids = padded_ids(tokenizer, phrases)
    assert ids.shape == (3, LENGTH)
    assert ids[0].tolist() == [4, 5] + [1] * (LENGTH - 2)  # end and padding are one token
    want = unit_tensor(model.get_text_features(input_ids=ids).pooler_output)
    got = load_text_encoder(str(tmp_path)).encode_texts(phrases)
    assert got.dtype == np.float32
    np.testing.assert_allclose(got, want, atol=2e-6)
    one_by_one = np.concatenate([load_text_encoder(str(tmp_path)).encode_texts([p]) for p in phrases])
    np.testing.assert_allclose(got, one_by_one, atol=2e-6)  # a phrase does not depend on its neighbours


def test_texts_of_the_second_generation_agree_with_transformers(tmp_path: Path) -> None:
    model = MAKERS["siglip2"](tmp_path)
    phrases = ["Red mug", "red", "a red mug, with a very long handle"]
    ids = padded_ids(Siglip2Tokenizer.from_pretrained(tmp_path), phrases)
    assert ids[1].tolist()[1:] == [1] + [0] * (LENGTH - 2)  # an end, then padding to the right
    want = unit_tensor(model.get_text_features(input_ids=ids).pooler_output)
    got = load_text_encoder(str(tmp_path)).encode_texts(phrases)
    np.testing.assert_allclose(got, want, atol=2e-6)


def test_case_does_not_matter_and_punctuation_only_to_the_second(made: tuple[Path, Any]) -> None:
    encoder = load_text_encoder(str(made[0]))
    small, large, dotted = encoder.encode_texts(["red mug", "RED Mug", "red mug!"])
    np.testing.assert_allclose(small, large, atol=1e-6)
    assert np.allclose(small, dotted, atol=1e-6) == (made[0].name == "siglip")


def test_images_agree_with_the_whole_model(tmp_path: Path) -> None:
    model, pictures = tiny_siglip(tmp_path), crops(5)
    encoder = load_encoder(str(tmp_path), "cpu", batch=2)
    assert (encoder.dim, encoder.image_size, encoder.id) == (32, SIDE, str(tmp_path))
    pixels = torch.from_numpy((pictures / 127.5 - 1).transpose(0, 3, 1, 2).astype(np.float32))
    want = unit_tensor(model.get_image_features(pixel_values=pixels).pooler_output)
    np.testing.assert_allclose(encoder.encode_images(pictures), want, atol=2e-6)


def test_the_temperature_is_a_tenth_of_the_learned_scale(made: tuple[Path, Any]) -> None:
    for load in (load_encoder, load_text_encoder):
        assert load(str(made[0]), "cpu").temperature == pytest.approx(SCALE / 10)


def remove_tokenizer(folder: Path) -> None:
    (folder / "tokenizer.json").unlink()


def damage_tokenizer(folder: Path) -> None:
    (folder / "tokenizer.json").write_text('{"version": "1.0"}', encoding="utf-8")


def remove_special_tokens(folder: Path) -> None:
    path = folder / "tokenizer.json"
    path.write_text(path.read_text(encoding="utf-8").replace("</s>", "<o>"), encoding="utf-8")


def remove_logit_scale(folder: Path) -> None:
    model = SiglipModel.from_pretrained(folder)
    state = {name: value for name, value in model.state_dict().items() if name != "logit_scale"}
    (folder / "model.safetensors").unlink()
    torch.save(state, folder / "pytorch_model.bin")


def another_model(folder: Path) -> None:
    change_config(folder, lambda config: config.update(model_type="bert"))


def no_json(folder: Path) -> None:
    (folder / "config.json").write_text("{", encoding="utf-8")


def change_config(folder: Path, change: Callable[[dict[str, Any]], None]) -> None:
    path = folder / "config.json"
    config = json.loads(path.read_text(encoding="utf-8"))
    change(config)
    path.write_text(json.dumps(config), encoding="utf-8")


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (remove_tokenizer, r"no tokenizer\.json in this folder"),
        (damage_tokenizer, r"tokenizer\.json is no tokenizer"),
        (remove_special_tokens, "no eos_token"),
        (remove_logit_scale, "logit_scale is not in them"),
        (another_model, "'bert' model is no image-text encoder known here; known are clip, siglip"),
        (no_json, r"config\.json cannot be read"),
    ],
)
def test_a_broken_folder_is_one_line(tmp_path: Path, damage: Callable[[Path], None], message: str) -> None:
    tiny_siglip(tmp_path)
    damage(tmp_path)
    with pytest.raises(EncoderError, match=message) as error:
        load_text_encoder(str(tmp_path))
    assert "\n" not in str(error.value)
