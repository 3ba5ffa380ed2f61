"""Folders of weights that hold something else: one line each, and nothing in them is run."""

import json
import os
import pickle
from pathlib import Path

import pytest
import torch

from langsplat_core.errors import EncoderError
from langsplat_core.semantics.encoders import load_encoder, load_text_encoder
from langsplat_core.semantics.sam import load_segmenter
from tests.support.tiny_clip import tiny_clip
from tests.support.tiny_sam import tiny_sam

pytestmark = pytest.mark.long
PLAIN, WEIGHTS = "pytorch_model.bin", "model.safetensors"


class Runs:
    """Unpickling it makes a folder."""

    def __init__(self, mark: Path) -> None:
        self.mark = mark

    def __reduce__(self) -> tuple[object, tuple[str]]:
        return os.mkdir, (str(self.mark),)


def as_pickle(path: Path, content: object) -> None:
    path.write_bytes(pickle.dumps(content))


def as_torch_file(path: Path, content: object) -> None:
    torch.save(content, path)


@pytest.mark.parametrize("write", [as_pickle, as_torch_file])
@pytest.mark.parametrize(
    ("make", "load"), [(tiny_clip, load_encoder), (tiny_clip, load_text_encoder), (tiny_sam, load_segmenter)]
)
def test_a_pickle_is_refused_in_a_line_and_not_run(write, make, load, tmp_path: Path, recwarn) -> None:  # type: ignore[no-untyped-def]
    folder = tmp_path / "model"
    folder.mkdir()
    make(folder)
    (folder / WEIGHTS).unlink()
    write(folder / PLAIN, {"text_model.embeddings": Runs(tmp_path / "ran")})
    with pytest.raises(EncoderError, match="a pickle that holds more than tensors") as caught:
        load(str(folder))
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 300
    assert not (tmp_path / "ran").exists()
    assert not recwarn.list


@pytest.mark.parametrize(
    "content", [b"", b"\x80", b"not weights", bytes(8) + b"{}", b"PK\x03\x04" + bytes(40)]
)
@pytest.mark.parametrize("name", [PLAIN, WEIGHTS])
def test_bytes_that_are_no_weights(content: bytes, name: str, tmp_path: Path) -> None:
    tiny_clip(tmp_path)
    (tmp_path / WEIGHTS).unlink()
    (tmp_path / name).write_bytes(content)
    with pytest.raises(EncoderError, match=r"not .* weights") as caught:
        load_text_encoder(str(tmp_path))
    assert "\n" not in str(caught.value)


def test_a_configuration_that_contradicts_itself_is_one_line(tmp_path: Path) -> None:
    tiny_clip(tmp_path)
    path = tmp_path / "config.json"
    config = json.loads(path.read_text(encoding="utf-8"))
    config["vision_config"]["num_attention_heads"] = 7  # of a width of 32
    path.write_text(json.dumps(config), encoding="utf-8")
    with pytest.raises(EncoderError, match="multiple of the number of attention heads") as caught:
        load_encoder(str(tmp_path))
    assert "\n" not in str(caught.value)
