"""A camera may ask for any number of pixels: what memory cannot hold is refused before it is allocated."""

import tracemalloc
from dataclasses import replace
from pathlib import Path

import pytest

from langsplat_core import Scene, render
from langsplat_core.errors import InputError
from langsplat_core.io.cameras import read_cameras, write_cameras
from langsplat_core.raster import protocol
from tests.support.scenes import random_camera, random_gaussians

G = random_gaussians(20, 4)


def test_a_camera_file_of_65536_x_65536(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(protocol, "memory_bytes", lambda: 64e9)
    write_cameras(tmp_path / "view.json", (replace(random_camera(2), width=65_536, height=65_536),))
    (camera,) = read_cameras(tmp_path / "view.json")
    tracemalloc.start()
    with pytest.raises(InputError, match=r"65536x65536 pixels needs 172 GB .* has 64; choose a smaller size"):
        render(Scene(G), camera)
    assert tracemalloc.get_traced_memory()[1] < 1e9  # modules that are imported meanwhile, no pictures
    tracemalloc.stop()


def test_what_memory_holds_is_drawn() -> None:
    assert render(Scene(G), random_camera(2)).alpha.max() > 0
    assert 1e8 < protocol.memory_bytes() < 1e15
