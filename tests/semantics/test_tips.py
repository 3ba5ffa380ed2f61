"""TIPS v2 through the real loading path, with a tiny model made here."""

from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file
from transformers import Tipsv2Tokenizer

from langsplat_core.semantics.encoders import load_encoder, load_text_encoder
from tests.support.tiny_tips import SIDE, tiny_tips

pytestmark = pytest.mark.long  # transformers alone takes seconds to load


def unit_rows(tensor: torch.Tensor) -> np.ndarray:
    rows = tensor.detach().numpy()
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


def test_texts_agree_with_the_whole_model(tmp_path: Path) -> None:
    model = tiny_tips(tmp_path)
    phrases = ["red mug", "Red", "blue"]
    tokenizer = Tipsv2Tokenizer.from_pretrained(tmp_path)
    given = tokenizer(phrases, padding="max_length", max_length=10, truncation=True, return_tensors="pt")
    want = model.get_text_features(input_ids=given.input_ids, attention_mask=given.attention_mask)
    got = load_text_encoder(str(tmp_path)).encode_texts(phrases)
    np.testing.assert_allclose(got, unit_rows(want.pooler_output), atol=2e-6)


def test_images_agree_with_the_whole_model(tmp_path: Path) -> None:
    model = tiny_tips(tmp_path)
    pictures = np.random.default_rng(1).integers(0, 256, (3, SIDE, SIDE, 3), dtype=np.uint8)
    pixels = torch.from_numpy((pictures / 255).transpose(0, 3, 1, 2).astype(np.float32))
    want = model.get_image_features(pixel_values=pixels).pooler_output
    encoder = load_encoder(str(tmp_path), "cpu", batch=2)
    assert (encoder.dim, encoder.image_size) == (32, SIDE)
    np.testing.assert_allclose(encoder.encode_images(pictures), unit_rows(want), atol=2e-6)


def test_the_temperature_is_that_of_the_configuration_where_the_weights_have_none(tmp_path: Path) -> None:
    model = tiny_tips(tmp_path)
    stated = 0.1 / model.config.temperature_init_value
    assert load_text_encoder(str(tmp_path)).temperature == pytest.approx(stated, rel=1e-5)
    state = load_file(tmp_path / "model.safetensors")  # names as the hub has them
    (tmp_path / "model.safetensors").unlink()
    torch.save({k: v for k, v in state.items() if k != "temperature"}, tmp_path / "pytorch_model.bin")
    assert load_text_encoder(str(tmp_path)).temperature == pytest.approx(stated)
    torch.save(state | {"temperature": torch.tensor(0.02)}, tmp_path / "pytorch_model.bin")
    assert load_text_encoder(str(tmp_path)).temperature == pytest.approx(5.0)
