"""Files of other methods on a full disk: one line, and what was there stays."""

from pathlib import Path

import numpy as np
import pytest

from langsplat_core.extensions.checkpoints.langsplat_files import (
    write_autoencoder,
    write_checkpoint,
    write_features,
)
from langsplat_core.scene import AutoencoderCodec
from tests.support.file_samples import random_codec
from tests.support.scenes import random_gaussians
from tests.support.writing import Captured, Write, check_full_disk, check_small_disk


def checkpoint(count: int) -> Write:
    gaussians = random_gaussians(count, 1, sh_degree=1)
    return lambda folder: write_checkpoint(folder / "c.pth", gaussians, np.ones((count, 3), np.float32))


def features(count: int, side: int) -> Write:
    vectors, labels = np.ones((count, 512), np.float32), np.zeros((4, side, side), np.int32)
    return lambda folder: write_features(folder, "a", vectors, labels)


def autoencoder(folder: Path) -> object:
    codec = random_codec("autoencoder")
    assert isinstance(codec, AutoencoderCodec)
    return write_autoencoder(folder / "a.pth", codec.encoder, codec.decoder)


WRITERS: dict[str, Write] = {
    "checkpoint": checkpoint(40),
    "autoencoder": autoencoder,
    "features": features(2, 8),
}
FILLED: dict[str, Write] = {
    **WRITERS,
    "large checkpoint": checkpoint(6_000),
    "large features": features(300, 350),
}


@pytest.mark.parametrize("name", WRITERS)
def test_a_full_disk_is_one_line(name: str, tmp_path: Path, capsys: Captured) -> None:
    check_full_disk(WRITERS[name], tmp_path, capsys, b"what was there before")


@pytest.mark.parametrize("name", FILLED)
def test_a_small_disk_that_fills_up_is_a_line(name: str, tmp_path: Path, capsys: Captured) -> None:
    check_small_disk(FILLED[name], tmp_path, capsys)
