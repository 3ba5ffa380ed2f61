"""Folders of weights that hold something else: one line each, and nothing in them is run."""

import json
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from langsplat_core.errors import EncoderError
from langsplat_core.semantics.encoders import load_encoder, load_text_encoder
from langsplat_core.semantics.sam import load_segmenter
from tests.support.tiny_models import (
    SAM_SIDE,
    MakesFolder,
    change_json,
    tiny_clip,
    tiny_sam,
    tiny_sam2,
    tiny_siglip,
)

pytestmark = pytest.mark.long
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
    write({"text_model.embeddings": MakesFolder(tmp_path / "ran")}, folder / PLAIN)
    with pytest.raises(EncoderError, match="a pickle that holds more than tensors") as caught:
        load(str(folder))
    assert len(str(caught.value)) < 300
    assert not (tmp_path / "ran").exists()
    assert not recwarn.list


@pytest.mark.parametrize(
    "content", [b"", b"\x80", b"not weights", bytes(8) + b"{}", b"PK\x03\x04" + bytes(40)]
)
@pytest.mark.parametrize("name", [PLAIN, WEIGHTS])
def test_bytes_that_are_no_weights_are_refused(content: bytes, name: str, tmp_path: Path) -> None:
    tiny_clip(tmp_path)
    (tmp_path / WEIGHTS).unlink()
    (tmp_path / name).write_bytes(content)
    with pytest.raises(EncoderError, match=r"not .* weights"):
        load_text_encoder(str(tmp_path))


def setting(folder: Path, part: str, name: str, value: object) -> str:
    """The folder, with a number of a part of its configuration changed."""
    change_json(folder / "config.json", lambda stated: stated[part].update({name: value}))
    return str(folder)


def test_a_contradictory_configuration_is_named(tmp_path: Path) -> None:
    tiny_clip(tmp_path)
    setting(tmp_path, "vision_config", "num_attention_heads", 7)  # of a width of 32
    with pytest.raises(EncoderError, match="multiple of the number of attention heads"):
        load_encoder(str(tmp_path))


FOLDERS: dict[str, tuple[Callable[[Path], object], Callable[[str], Any]]] = {
    "CLIP": (tiny_clip, load_encoder),
    "SigLIP": (tiny_siglip, load_encoder),
    "SAM": (tiny_sam, load_segmenter),
    "SAM 2": (tiny_sam2, load_segmenter),
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
        ("hidden_size", 0),
        ("image_size", 10**6),
        ("patch_size", "x"),
        ("num_hidden_layers", 10**9),
        ("num_hidden_layers", 1),  # one fewer than the weights have
        ("blocks_per_stage", [10**9]),
    ],
)
def test_a_configuration_of_other_sizes_is_refused(
    kind: str, name: str, value: object, tmp_path: Path
) -> None:
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
