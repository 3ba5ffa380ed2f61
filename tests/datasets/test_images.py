"""Photographs of every kind, and broken ones: what is sound loads, the rest is left out and named."""

import struct
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageOps

from langsplat_core.datasets import load_capture
from langsplat_core.datasets.capture import read_photo, unique_names
from tests.support.small_datasets import CONFIG, refuse, write_colmap, write_picture


def test_every_kind_of_picture_becomes_rgb(tmp_path: Path) -> None:
    grey = np.linspace(0, 255, 12 * 16).reshape(12, 16).astype(np.uint8)
    picture = Image.fromarray(grey)
    deep = Image.fromarray(grey.astype(np.uint16) * 257)
    pictures = {
        "grey.png": picture,
        "deep.png": deep,
        "deep.tif": deep,
        "palette.png": picture.convert("P"),
        "ink.tif": picture.convert("CMYK"),
        "both.png": Image.merge("LA", [picture, Image.new("L", picture.size, 255)]),
        "one.webp": picture.convert("RGB"),
    }
    for name, kind in pictures.items():
        kind.save(tmp_path / name, **({"lossless": True} if name.endswith("webp") else {}))
        got = np.asarray(read_photo(tmp_path / name, upright=False))
        assert got.shape == (12, 16, 3), name
        assert np.abs(got.astype(int) - grey[..., None]).max() <= 1, name


@pytest.mark.parametrize("orientation", range(1, 9))
def test_every_exif_orientation(tmp_path: Path, orientation: int) -> None:
    picture = Image.fromarray(np.random.default_rng(0).integers(0, 256, (6, 9, 3), dtype=np.uint8))
    exif = Image.Exif()
    exif[0x0112] = orientation
    picture.save(tmp_path / "a.png", exif=exif)
    want = np.asarray(ImageOps.exif_transpose(Image.open(tmp_path / "a.png")))
    assert want.shape == ((6, 9, 3) if orientation < 5 else (9, 6, 3))
    np.testing.assert_array_equal(np.asarray(read_photo(tmp_path / "a.png", upright=True)), want)
    np.testing.assert_array_equal(np.asarray(read_photo(tmp_path / "a.png", upright=False)), picture)


def test_broken_exif_data_count_as_none(tmp_path: Path) -> None:
    write_picture(tmp_path / "a.png")
    Image.open(tmp_path / "a.png").save(tmp_path / "b.jpg", exif=b"Exif\x00\x00MM\x00*\xff\xff\xff\xff junk")
    assert read_photo(tmp_path / "b.jpg", upright=True).size == (40, 30)


def bomb(path: Path) -> None:
    """A PNG of a hundred bytes whose header claims 60 000 x 60 000 pixels."""
    write_picture(path)
    data = bytearray(path.read_bytes())
    data[16:24] = struct.pack(">II", 60_000, 60_000)
    path.write_bytes(data)


@pytest.mark.parametrize(
    "spoil",
    [
        lambda path: path.write_bytes(b""),
        lambda path: path.write_bytes(path.read_bytes()[:200]),
        lambda path: path.write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(100)),
        lambda path: path.write_bytes(b"GIF89a" + bytes(20)),
        bomb,
    ],
)
def test_a_broken_photograph_is_left_out_and_named(
    tmp_path: Path,
    spoil,  # type: ignore[no-untyped-def]
    caplog: pytest.LogCaptureFixture,
) -> None:
    write_colmap(tmp_path)
    spoil(tmp_path / "images/a.png")
    capture = load_capture(tmp_path, CONFIG, tmp_path / "work")
    assert [camera.name for camera in capture.cameras] == ["b"]
    assert "a.png" in caplog.text

    spoil(tmp_path / "images/b.png")
    assert "a.png" in refuse(tmp_path, tmp_path / "work")


def test_an_absurd_camera_size_is_refused(tmp_path: Path) -> None:
    folder = write_colmap(tmp_path, "txt")
    (folder / "cameras.txt").write_text("1 PINHOLE 40000000 30 50 50 20 15\n")
    assert "camera 1: a photograph of more than 1048576 pixels" in refuse(tmp_path, tmp_path / "work")


def test_a_very_long_photograph_keeps_a_pixel(tmp_path: Path) -> None:
    folder = write_colmap(tmp_path, "txt")
    for name in "ab":
        Image.new("RGB", (1000, 2)).save(tmp_path / f"images/{name}.png")
    (folder / "cameras.txt").write_text("1 PINHOLE 1000 2 50 50 20 1\n")
    capture = load_capture(tmp_path, CONFIG, tmp_path / "work")
    assert capture.images[0].shape == (1, 64, 3)


def test_names_stay_unique() -> None:
    assert unique_names(["a.png", "b.jpg"]) == ["a", "b"]
    assert unique_names(["l/a.png", "r/a.png"]) == ["l_a", "r_a"]
    assert unique_names(["a.png", "a.jpg"]) == ["a_png", "a_jpg"]
