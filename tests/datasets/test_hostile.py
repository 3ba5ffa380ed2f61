"""Datasets that are broken, odd or meant to harm: what is sound loads, the rest is refused in one line."""

import json
import struct
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from PIL import Image, ImageOps

from langsplat_core.config import DatasetConfig
from langsplat_core.datasets import load_capture
from langsplat_core.datasets.colmap_model import read_model
from langsplat_core.datasets.images import read_photo, unique_names
from langsplat_core.errors import FormatError, InputError
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
    with pytest.raises(InputError, match="max_side"):
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


def test_text_that_is_not_text(tmp_path: Path) -> None:
    (write_colmap(tmp_path, "txt") / "cameras.txt").write_bytes(b"\xff\xfe\x80")
    assert "cameras.txt" in refuse(tmp_path, tmp_path / "work")


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


def write_nerfstudio(folder: Path, **top: object) -> None:
    write_picture(folder / "a.png")
    frame = {"file_path": "a.png", "transform_matrix": IDENTITY}
    text = json.dumps({"fl_x": 50.0, "frames": [frame], **top})
    (folder / "transforms.json").write_text(text, encoding="utf-8-sig")  # some editors add the mark


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


# -- photographs --------------------------------------------------------------------------------------------


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


def test_a_black_and_white_bitmap(tmp_path: Path) -> None:
    Image.new("1", (4, 4), 1).save(tmp_path / "bits.png")
    assert (np.asarray(read_photo(tmp_path / "bits.png", upright=False)) == 255).all()


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
    (folder / "cameras.txt").write_text(f"1 PINHOLE 4{'0' * 400} 30 50 50 20 15\n")
    assert "a.png" in refuse(tmp_path, tmp_path / "work")


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
