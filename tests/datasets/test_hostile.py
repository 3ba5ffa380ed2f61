"""Datasets that are broken, odd or meant to harm: what is sound loads, the rest is refused in one line."""

import struct
from pathlib import Path

import numpy as np
import pytest

from langsplat_core.config import DatasetConfig
from langsplat_core.datasets import load_capture
from langsplat_core.datasets.colmap import read_model
from langsplat_core.errors import FormatError, InputError
from tests.support.small_datasets import (
    CONFIG,
    refuse,
    write_colmap,
    write_nerfstudio,
    write_picture,
)

pytestmark = pytest.mark.long

# -- not a dataset ------------------------------------------------------------------------------------------


def test_what_is_no_dataset_is_told_what_is(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "scene.ply").write_bytes(b"ply")
    (tmp_path / "photo.jpg" / "inner").mkdir(parents=True)  # a folder that is called like a photograph
    for name in ("absent", "empty", "scene.ply", "photo.jpg", "."):
        message = refuse(tmp_path / name, tmp_path / "work")
        assert "transforms.json" in message
        assert "sparse/0" in message
        assert "three photographs" in message


def test_half_a_colmap_model_is_no_model(tmp_path: Path) -> None:
    (write_colmap(tmp_path) / "cameras.bin").unlink()
    assert "2 photographs" in refuse(tmp_path, tmp_path / "work")  # taken for a plain folder of photographs


@pytest.mark.parametrize("side", [0, -5, 3])
def test_a_useless_size_is_refused(tmp_path: Path, side: int) -> None:
    write_colmap(tmp_path)
    with pytest.raises(InputError, match=r"--dataset\.max-side"):
        load_capture(tmp_path, DatasetConfig(max_side=side), tmp_path / "work")


# -- COLMAP models ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "points3D.bin"])
def test_a_model_cut_anywhere_is_refused(tmp_path: Path, name: str) -> None:
    """pycolmap reads such a model without complaint, with numbers that happened to lie in memory."""
    folder = write_colmap(tmp_path)
    whole = (folder / name).read_bytes()
    for length in range(len(whole)):
        (folder / name).write_bytes(whole[:length])
        with pytest.raises(FormatError, match=name.replace(".", r"\.")):
            read_model(folder)


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "points3D.bin"])
def test_a_count_of_a_million_million_is_refused(tmp_path: Path, name: str) -> None:
    folder = write_colmap(tmp_path)
    whole = (folder / name).read_bytes()
    (folder / name).write_bytes(struct.pack("<Q", 10**12) + whole[8:])
    assert name in refuse(tmp_path, tmp_path / "work")


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "points3D.bin"])
def test_changed_bytes_never_crash(tmp_path: Path, name: str) -> None:
    folder = write_colmap(tmp_path)
    whole = (folder / name).read_bytes()
    rng = np.random.default_rng(0)
    refused = 0
    for _ in range(200):
        data = bytearray(whole)
        data[rng.integers(len(data))] = rng.integers(256)
        (folder / name).write_bytes(data)
        try:
            read_model(folder)
        except FormatError:
            refused += 1
    assert refused > 0


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("cameras.txt", "1 PINHOLE 40 30 50 50 20\n"),
        ("cameras.txt", "1 PANORAMA 40 30 50 50 20 15\n"),
        ("cameras.txt", "1 PINHOLE 0 30 50 50 20 15\n"),
        ("cameras.txt", "1 PINHOLE 40 30 nan 50 20 15\n"),
        ("cameras.txt", "1 PINHOLE 40 30 -50 50 20 15\n"),
        ("cameras.txt", "1 PINHOLE wide 30 50 50 20 15\n"),
        ("cameras.txt", "1\n"),
        ("cameras.txt", "2 PINHOLE 40 30 50 50 20 15\n"),
        ("images.txt", "1 0 0 0 0 0 0 0 1 a.png\n\n"),
        ("images.txt", "1 1 0 0 0 nan 0 0 1 a.png\n\n"),
        ("images.txt", "1 1 0 0 0 0 0 0 1\n\n"),
        ("images.txt", "1 1 0 0 0 0 0 0 9 a.png\n\n"),
        ("images.txt", f"1 1 0 0 0 0 0 0 {'9' * 400} a.png\n\n"),
        ("cameras.txt", f"{'9' * 400} PINHOLE 40 30 50 50 20 15\n"),
        ("points3D.txt", f"1 0 0 0 1 2 {'9' * 400} 0.5\n"),
        ("images.txt", "\x00\x01\x02"),
        ("points3D.txt", "1 0 0 zero 1 2 3 0.5\n"),
        ("points3D.txt", "1 0 0 0 1 2 300 0.5\n"),
        ("points3D.txt", "1 0 0\n"),
    ],
)
def test_a_broken_line_of_a_text_model_is_refused(tmp_path: Path, name: str, text: str) -> None:
    (write_colmap(tmp_path, "txt") / name).write_text(text)
    message = refuse(tmp_path, tmp_path / "work")
    assert "sparse" in message
    assert len(message) < 400


def test_names_that_no_file_system_holds_count_as_missing(tmp_path: Path) -> None:
    text = (write_colmap(tmp_path, "txt") / "images.txt").read_text()
    (tmp_path / "sparse/0/images.txt").write_text(text.replace("a.png", "a" * 5000 + ".png"))
    assert len(load_capture(tmp_path, CONFIG, tmp_path / "work")) == 1


def test_an_image_listed_twice_counts_once(tmp_path: Path) -> None:
    text = (write_colmap(tmp_path, "txt") / "images.txt").read_text()
    (tmp_path / "sparse/0/images.txt").write_text(text.replace("a.png", "b.png"))
    capture = load_capture(tmp_path, CONFIG, tmp_path / "work")
    assert [camera.name for camera in capture.cameras] == ["b"]


def test_names_with_spaces_and_accents(tmp_path: Path) -> None:
    text = (write_colmap(tmp_path, "txt") / "images.txt").read_text()
    (tmp_path / "images/a.png").rename(tmp_path / "images/mon été 1.png")
    (tmp_path / "sparse/0/images.txt").write_text(text.replace("a.png", "mon été 1.png"), encoding="utf-8")
    capture = load_capture(tmp_path, CONFIG, tmp_path / "work")
    assert [camera.name for camera in capture.cameras] == ["b", "mon été 1"]


# -- transforms.json ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"{",
        b"\xff\xfe\x00\x80",
        b"[]",
        b"null",
        b"{}",
        b'{"frames": []}',
        b'{"frames": {}}',
        b'{"frames": [3]}',
        b'{"frames": [{}]}',
        b'{"frames": ' + b"[" * 100_000,
        b'{"frames": [{"file_path": "", "transform_matrix": []}]}',
        b'{"frames": [{"file_path": "/", "transform_matrix": []}]}',
        b'{"frames": [{"file_path": "a\\u0000b", "transform_matrix": []}]}',
        b'{"fl_x": 1' + b"0" * 5000 + b', "frames": [{"file_path": "a.png"}]}',
        b'{"fl_x": 1' + b"0" * 400 + b', "frames": [{"file_path": "a.png"}]}',
    ],
)
def test_a_broken_json_is_refused(tmp_path: Path, content: bytes) -> None:
    write_picture(tmp_path / "a.png")
    (tmp_path / "transforms.json").write_bytes(content)
    assert "transforms.json" in refuse(tmp_path, tmp_path / "work")


AXES = b"property float x\nproperty float y\nproperty float z\n"
PLY = b"ply\nformat %s 1.0\nelement vertex %d\n" + AXES + b"end_header\n"


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"not a ply",
        PLY % (b"binary_little_endian", 10**12) + bytes(24),
        PLY % (b"binary_little_endian", 3) + bytes(35),
        PLY % (b"ascii", 2) + b"1 2 3\n",
        PLY % (b"ascii", 2) + b"1 2 3\n1 two 3\n",
        PLY % (b"ascii", 10**12) + b"1 2 3\n",
        b"ply\nformat ascii 1.0\nelement face 0\nproperty float x\nend_header\n",
        b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n1\n",
        b"ply\nformat ascii 1.0\nelement vertex 1\nproperty list uchar float x\n"
        b"property float y\nproperty float z\nend_header\n1 5 2 3\n",
        (PLY % (b"ascii", 1)).replace(b"vertex 1", b"vertex -4"),
    ],
)
def test_a_broken_cloud_is_refused(tmp_path: Path, content: bytes) -> None:
    write_nerfstudio(tmp_path, ply_file_path="cloud.ply")
    (tmp_path / "cloud.ply").write_bytes(content)
    assert "cloud.ply" in refuse(tmp_path, tmp_path / "work")


@pytest.mark.parametrize("name", [None, 3, "", "absent.ply", "."])
def test_a_cloud_that_is_not_there_is_done_without(tmp_path: Path, name: object) -> None:
    write_nerfstudio(tmp_path, ply_file_path=name)
    capture = load_capture(tmp_path, CONFIG, tmp_path / "work")
    assert len(capture.points) > 100  # random ones: a single view triangulates nothing
