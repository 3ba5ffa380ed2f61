"""CLIP through the real loading path, with a tiny model made here."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from transformers import CLIPModel, CLIPTokenizer

from langsplat_core.errors import EncoderError, InputError
from langsplat_core.scene import Calibration, Odds, Reading
from langsplat_core.semantics.encoders import CLIP_MEAN, CLIP_STD, load_encoder, load_text_encoder
from tests.support.tiny_clip import SIDE, WORDS, tiny_clip

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("clip")
    tiny_clip(folder)
    return folder


def crops(count: int) -> np.ndarray:
    return np.random.default_rng(1).integers(0, 256, (count, SIDE, SIDE, 3), dtype=np.uint8)


def test_images_agree_with_the_whole_model(folder: Path) -> None:
    pictures = crops(5)
    encoder = load_encoder(str(folder), "cpu", batch=2)
    got = encoder.encode_images(pictures)
    assert (encoder.dim, encoder.image_size, encoder.id) == (24, SIDE, str(folder))
    model = CLIPModel.from_pretrained(folder).eval()
    pixels = (pictures / 255 - np.array(CLIP_MEAN)) / np.array(CLIP_STD)
    inputs = torch.from_numpy(pixels.transpose(0, 3, 1, 2).astype(np.float32))
    with torch.no_grad():
        want = model.visual_projection(model.vision_model(inputs).pooler_output).numpy()
    want /= np.linalg.norm(want, axis=1, keepdims=True)
    assert got.dtype == np.float32
    np.testing.assert_allclose(got, want, atol=2e-6)  # float32, batches of another size


def test_texts_agree_with_the_whole_model_one_at_a_time(folder: Path) -> None:
    phrases = ["red mug", "handle", "green mug"]
    got = load_text_encoder(str(folder)).encode_texts(phrases)
    np.testing.assert_array_equal(got, load_encoder(str(folder), "cpu").encode_texts(phrases))
    model = CLIPModel.from_pretrained(folder).eval()
    tokenizer = CLIPTokenizer.from_pretrained(folder)
    for phrase, vector in zip(phrases, got, strict=True):  # alone, so without any padding
        tokens = tokenizer([phrase], truncation=True, max_length=12, return_tensors="pt").input_ids
        with torch.no_grad():
            want = model.text_projection(model.text_model(input_ids=tokens).pooler_output).numpy()[0]
        np.testing.assert_allclose(vector, want / np.linalg.norm(want), atol=2e-6)


def test_half_precision_weights_are_used_in_float32(tmp_path: Path) -> None:
    tiny_clip(tmp_path, half=True)
    vectors = load_encoder(str(tmp_path), "cpu").encode_images(crops(1))
    np.testing.assert_allclose(np.linalg.norm(vectors, axis=1), 1, atol=1e-6)


def test_the_folder_may_state_its_own_normalisation(tmp_path: Path) -> None:
    tiny_clip(tmp_path)
    before = load_encoder(str(tmp_path), "cpu").encode_images(crops(1))
    settings = '{"image_mean": [0.5, 0.5, 0.5], "image_std": [0.5, 0.5, 0.5]}'
    (tmp_path / "preprocessor_config.json").write_text(settings, encoding="utf-8")
    assert abs(load_encoder(str(tmp_path), "cpu").encode_images(crops(1)) - before).max() > 1e-4


@pytest.mark.parametrize("text", ["{", "[]", '{"image_mean": [0.5]}', '{"image_std": [0, 0, 0]}'])
def test_a_broken_normalisation_is_one_line(tmp_path: Path, text: str) -> None:
    tiny_clip(tmp_path)
    (tmp_path / "preprocessor_config.json").write_text(text, encoding="utf-8")
    with pytest.raises(EncoderError, match=r"preprocessor_config\.json") as error:
        load_encoder(str(tmp_path), "cpu")
    assert "\n" not in str(error.value)


def test_pickled_weights_give_the_same_vectors(tmp_path: Path) -> None:
    state = tiny_clip(tmp_path).state_dict()
    before = load_encoder(str(tmp_path), "cpu").encode_images(crops(1))
    (tmp_path / "model.safetensors").unlink()
    torch.save(state, tmp_path / "pytorch_model.bin")
    after = load_encoder(str(tmp_path), "cpu").encode_images(crops(1))
    # equal weights at other addresses: torch may add up in another order
    np.testing.assert_allclose(after, before, rtol=0, atol=2e-7)


def test_pictures_of_the_wrong_size_are_refused(folder: Path) -> None:
    with pytest.raises(ValueError, match="32 x 32"):
        load_encoder(str(folder), "cpu").encode_images(np.zeros((1, 16, 16, 3), np.uint8))


@pytest.mark.parametrize("phrase", ["", "   ", "?!"])
def test_an_empty_phrase_is_an_input_error(folder: Path, phrase: str) -> None:
    with pytest.raises(InputError, match="type a word"):
        load_text_encoder(str(folder)).encode_texts([phrase])


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
    ) as error:
        encoder.encode_texts(["handl"])
    assert "\n" not in str(error.value)


def test_absent_weights_say_what_to_pass(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    with pytest.raises(EncoderError, match=r"no such folder; pass `--clip\.model FOLDER`"):
        load_encoder("./nowhere")
    with pytest.raises(EncoderError, match=r"no config\.json with model\.safetensors"):
        load_encoder(str(tmp_path))
    with pytest.raises(
        EncoderError, match=r"HF_HUB_OFFLINE is set.*`hf download nobody/nothing-here`"
    ) as error:
        load_encoder("nobody/nothing-here")
    assert "\n" not in str(error.value)


def test_weights_of_another_model_are_refused(tmp_path: Path) -> None:
    tiny_clip(tmp_path)
    config = tmp_path / "config.json"
    text = config.read_text(encoding="utf-8")
    config.write_text(text.replace('"intermediate_size": 48', '"intermediate_size": 40'), encoding="utf-8")
    with pytest.raises(EncoderError, match="6 do not fit, such as"):
        load_encoder(str(tmp_path), "cpu")
    config.write_text(text.replace('"num_hidden_layers": 2', '"num_hidden_layers": 3'), encoding="utf-8")
    with pytest.raises(EncoderError, match="16 do not fit, such as"):  # else they would be random
        load_encoder(str(tmp_path), "cpu")


def test_how_an_encoder_is_read_lies_beside_its_weights(tmp_path):
    tiny_clip(tmp_path)
    odds = {"constant": -1, "whole": 18.5, "finer": 2.5, "found": 0.7}
    stated = {"thing": odds, "part": {"constant": 0, "whole": 0, "finer": 9}, "inside": odds}
    (tmp_path / "reading.json").write_text("{}")
    assert load_text_encoder(str(tmp_path)).reading == Reading(10.0, 0.6)
    (tmp_path / "reading.json").write_text(json.dumps({"calibration": stated}))
    want = Reading(10.0, 0.6, Calibration(Odds(-1, 18.5, 2.5, 0.7), Odds(0, 0, 9), Odds(-1, 18.5, 2.5, 0.7)))
    assert load_text_encoder(str(tmp_path)).reading == want
    assert load_encoder(str(tmp_path), "cpu").reading == want
    odds.pop("found")
    (tmp_path / "reading.json").write_text(json.dumps({"found": 0.8, "calibration": stated}))
    reading = load_text_encoder(str(tmp_path)).reading
    assert reading == Reading(10.0, 0.8, Calibration(Odds(-1, 18.5, 2.5), Odds(0, 0, 9), Odds(-1, 18.5, 2.5)))


ODDS = '{"constant": 0, "whole": 1, "finer": 0}'
BROKEN_READINGS = (
    *('{"found": 2}', '{"found": null}', '{"found": 1' + "0" * 400 + "}", "[", "[]", "3", "", '"found"'),
    *('{"calibration": null}', '{"calibration": {}}', '{"verdict": {}}'),
    f'{{"calibration": {{"thing": {ODDS}, "part": {ODDS}}}}}',
    f'{{"calibration": {{"thing": {ODDS}, "part": {ODDS}, "inside": {ODDS}, "other": {ODDS}}}}}',
    *(
        f'{{"calibration": {{"thing": {ODDS}, "part": {{"constant": 0, {broken}}}, "inside": {ODDS}}}}}'
        for broken in (
            '"whole": 1',
            '"whole": 1, "finer": 0, "part": 2',
            '"whole": NaN, "finer": 0',
            '"whole": "1", "finer": 0',
            '"whole": -1, "finer": 0.5',
            '"whole": 1, "finer": 0, "found": 0.4',
            '"whole": 1' + "0" * 400 + ', "finer": 0',
        )
    ),
)


@pytest.mark.parametrize("broken", BROKEN_READINGS)
def test_a_broken_reading_is_one_line(tmp_path, broken):
    tiny_clip(tmp_path)
    (tmp_path / "reading.json").write_text(broken)
    with pytest.raises(EncoderError, match=r"reading\.json is not") as caught:
        load_text_encoder(str(tmp_path))
    assert "\n" not in str(caught.value)
