"""Datasets of one or two tiny photographs, whole ones, which a test then spoils."""

import json
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from PIL import Image

from langsplat_core.config import DatasetConfig
from langsplat_core.datasets import load_capture
from langsplat_core.errors import InputError
from tests.support.photographed import colmap_reconstruction

CONFIG = DatasetConfig(max_side=64)
IDENTITY = np.eye(4).tolist()


def refuse(path: Path, work: Path) -> str:
    """The one line with which `path` is refused."""
    with pytest.raises(InputError) as caught:
        load_capture(path, CONFIG, work)
    message = str(caught.value)
    assert message
    assert "\n" not in message
    return message


def write_picture(path: Path, size: tuple[int, int] = (40, 30), seed: int = 0) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    pixels = np.random.default_rng(seed).integers(0, 256, (size[1], size[0], 3), dtype=np.uint8)
    Image.fromarray(pixels).save(path)


def write_colmap(folder: Path, form: str = "bin") -> Path:
    """Two photographs and a model with three points; returns the model's folder."""
    names = ["a.png", "b.png"]
    for name in names:
        write_picture(folder / "images" / name)
    model = colmap_reconstruction("PINHOLE", (40, 30), [50.0, 50, 20, 15], names, [np.eye(4)] * 2)
    for x in range(3):
        model.add_point3D(np.array([x, 0, 3.0]), pycolmap.Track(), np.array([1, 2, 3], np.uint8))
    out = folder / "sparse" / "0"
    out.mkdir(parents=True)
    (model.write_binary if form == "bin" else model.write_text)(out)
    return out


def write_nerfstudio(folder: Path, **top: object) -> None:
    write_picture(folder / "a.png")
    frame = {"file_path": "a.png", "transform_matrix": IDENTITY}
    text = json.dumps({"fl_x": 50.0, "frames": [frame], **top})
    (folder / "transforms.json").write_text(text, encoding="utf-8-sig")  # some editors add the mark
