"""Photographs of every kind, their masks and lenses, broken ones, and what phones make."""

import errno
import struct
import sys
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import av
import numpy as np
import pillow_heif
import pytest
from PIL import Image
from scipy.ndimage import gaussian_filter

from langsplat_core.arrays import Array
from langsplat_core.config import DatasetConfig, RadianceConfig
from langsplat_core.datasets import Capture, load_capture
from langsplat_core.datasets.intrinsics import PhotoIntrinsics
from langsplat_core.datasets.photos import (
    Photo,
    count_photographs,
    develop,
    in_file,
    mask_beside,
    optics,
    read_photo,
    unique_names,
)
from langsplat_core.datasets.video import extract_frames, kept_frames
from langsplat_core.errors import FormatError, InputError, LangSplatError
from langsplat_core.io.hostile import PictureError, is_video
from langsplat_core.progress import WorkCancelledError, silent
from langsplat_core.scene import look_at
from langsplat_core.training.radiance.differentiable import evaluate_views
from langsplat_core.training.radiance.trainer import train_radiance
from tests.support.photographs import (
    CONFIG,
    mask_file,
    poses,
    refuse,
    write_colmap,
    write_photos,
    write_picture,
)
from tests.support.processes import files_of_at_most, stop_at


def test_image_files_need_room_on_the_disk(tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    picture = np.zeros((60, 80, 3), np.uint8)
    for size in (0, picture.nbytes - 1):
        with files_of_at_most(size), pytest.raises(OSError, match="large") as caught:
            in_file(picture)
        assert (caught.value.errno, caught.value.filename) == (errno.EFBIG, str(tmp_path))


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


def test_names_stay_unique() -> None:
    assert unique_names(["a.png", "b.jpg"]) == ["a", "b"]
    assert unique_names(["l/a.png", "r/a.png"]) == ["l_a", "r_a"]
    assert unique_names(["a.png", "a.jpg"]) == ["a_png", "a_jpg"]


def test_photographs_are_counted_where_they_lie(tmp_path: Path) -> None:
    assert count_photographs(tmp_path / "gone") == 0
    for name in ("a.jpg", "b.PNG", "c.txt"):
        (tmp_path / name).write_bytes(b"")
    assert count_photographs(tmp_path) == 2
    (tmp_path / "images").mkdir()
    (tmp_path / "images" / "a.jpg").write_bytes(b"")
    (tmp_path / "transforms.json").write_text("{}")
    assert count_photographs(tmp_path) == count_photographs(tmp_path / "transforms.json") == 1
    assert count_photographs(tmp_path / "walk.mp4") == DatasetConfig.frames


# Masks beside photographs.

LENS = PhotoIntrinsics(120, 90, 110.0, 110.0, 60.0, 45.0)


@pytest.mark.parametrize("place", ["images/masks", "masks"])
@pytest.mark.parametrize("name", ["a.jpg.png", "a.png"])
def test_a_mask_lies_beside_its_photograph(place: str, name: str, tmp_path: Path) -> None:
    (tmp_path / place).mkdir(parents=True)
    photo, mask = tmp_path / "images/a.jpg", tmp_path / place / name
    assert mask_beside(photo) is None
    mask.write_bytes(b"")
    assert mask_beside(photo) == mask
    assert mask_beside(tmp_path / f"{'a' * 300}.jpg") is None  # no file can have the name of its mask
    assert mask_beside(mask) is None


def test_a_mask_has_the_shape_of_the_photograph_as_it_is_shown(tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[0x0112] = 6  # stored lying on its side
    Image.new("RGB", (90, 120), "white").save(tmp_path / "a.jpg", exif=exif)
    shown = np.ones((45, 60), bool)
    shown[:, :20] = False
    mask = mask_file(tmp_path / "masks/a.png", shown)
    photo = Photo(tmp_path / "a.jpg", "a.jpg", LENS, np.eye(4), upright=True, mask=mask)
    _, _, _, (found,) = develop([photo], 120, silent)
    assert found is not None
    np.testing.assert_array_equal(found, shown.repeat(2, 0).repeat(2, 1))
    mask_file(mask, shown.T)
    with pytest.raises(InputError, match=r"a\.png: is 45x60 pixels, its photograph 120x90"):
        develop([photo], 120, silent)


def test_a_photograph_of_which_nothing_counts_is_left_out(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    names = write_photos(tmp_path, LENS, poses(2))
    mask = mask_file(tmp_path / "masks/view_1.png", np.zeros((90, 120), bool))
    photos = [Photo(tmp_path / name, name, LENS, np.eye(4)) for name in names]
    photos[1] = replace(photos[1], mask=mask)
    cameras, _, _, masks = develop(photos, 120, silent)
    assert ([camera.name for camera in cameras], masks) == (["view_0"], ())
    assert "view_1.png (its mask leaves nothing of it)" in caplog.text


def test_masked_pixels_neither_train_nor_count() -> None:
    rng = np.random.default_rng(3)
    cameras = [
        look_at(np.array([x, 0, -3.0]), np.zeros(3), np.array([0, -1.0, 0]), (32, 24)) for x in (-1, 0, 1)
    ]
    named = tuple(replace(camera, name=f"{k}") for k, camera in enumerate(cameras))
    points, colours = rng.uniform(-1, 1, (200, 3)), rng.integers(0, 256, (200, 3), np.uint8)
    mask = np.ones((24, 32), bool)
    mask[:, 20:] = False
    images = [rng.integers(0, 256, (24, 32, 3), np.uint8) for _ in named]

    def capture(shade: int) -> Capture:
        shown = tuple(np.where(mask[..., None], image, np.uint8(shade)) for image in images)
        return Capture(named, shown, points, colours, masks=(mask,) * 3)

    config = RadianceConfig(steps=12, sh_degree=1, coarse_fraction=0.5)
    dark, bright = (train_radiance(capture(shade), config, [0, 1, 2]) for shade in (0, 255))
    np.testing.assert_array_equal(dark.means, bright.means)
    np.testing.assert_array_equal(dark.sh, bright.sh)
    assert evaluate_views(dark, capture(0), [1]) == evaluate_views(dark, capture(255), [1])
    unmasked = train_radiance(replace(capture(255), masks=()), config, [0, 1, 2])
    assert np.abs(unmasked.sh - bright.sh).max() > 1e-3


# The lens of a photograph, as COLMAP learns of it from our smaller copy.

FOCAL_TAG, ON_FILM, PLANE_X, PLANE_UNIT, PLANE_WIDTH = 0x920A, 0xA405, 0xA20E, 0xA210, 0xA002


def tagged(path: Path, tags: dict[int, float], size: tuple[int, int] = (2000, 1500)) -> Path:
    exif = Image.Exif()
    exif[0x010F] = "Maker"
    exif.get_ifd(0x8769).update(tags)
    exif.get_ifd(0x8825).update({1: "N", 2: (47.0, 22.0, 0.0), 3: "E", 4: (8.0, 32.0, 0.0)})  # a place
    Image.linear_gradient("L").resize(size).convert("RGB").save(path, exif=exif)
    return path


def on_film(path: Path) -> float | None:
    return optics(path).get_ifd(0x8769).get(ON_FILM)


@pytest.mark.parametrize(("unit", "millimetres"), [(2, 25.4), (3, 10.0), (4, 1.0), (None, 25.4)])
def test_focal_length_follows_from_pixels_per_inch(
    unit: int | None, millimetres: float, tmp_path: Path
) -> None:
    """A sensor 22.3 mm wide, of 4 to 3, 4000 pixels; the file was made smaller since."""
    tags: dict[int, float] = {FOCAL_TAG: 18.0, PLANE_X: 4000 / 22.3 * millimetres, PLANE_WIDTH: 4000}
    if unit is not None:
        tags[PLANE_UNIT] = unit
    expected = 18 / (22.3 * 1.25) * np.hypot(36, 24)
    assert on_film(tagged(tmp_path / "a.jpg", tags)) == round(expected)


@pytest.mark.parametrize(
    "tags",
    [
        {},
        {FOCAL_TAG: 18.0, PLANE_X: 4500.0, PLANE_UNIT: 77},
        {FOCAL_TAG: 1e6, PLANE_X: 1e9},
    ],
)
def test_implausible_exif_lenses_are_left_out(tags: dict[int, float], tmp_path: Path) -> None:
    assert on_film(tagged(tmp_path / "a.jpg", tags)) is None


# What phones make: HEIC photographs and videos.

WIDTH, HEIGHT = 96, 64


def scene(step: int, blur: float = 0.0) -> Array:
    """(H, W, 3) uint8: plain stripes that wander, red above and blue below."""
    image = np.zeros((HEIGHT, WIDTH, 3))
    image[: HEIGHT // 2, :, 0] = image[HEIGHT // 2 :, :, 2] = 200
    image[:, (np.arange(WIDTH) + step) % 12 < 4] += 50
    return gaussian_filter(image, (blur, blur, 0)).astype(np.uint8)


def write_video(path: Path, images: list[Array], rate: int = 10) -> Path:
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg4", rate=rate)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        stream.bit_rate = 4_000_000
        for image in images:
            for packet in stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")):
                container.mux(packet)
        for packet in stream.encode():
            container.mux(packet)
    return path


@pytest.fixture
def clip(tmp_path: Path) -> Path:
    """Four seconds; every fifth image is sharp, the others are blurred."""
    return write_video(tmp_path / "clip.mp4", [scene(k, 0.0 if k % 5 == 2 else 2.0) for k in range(40)])


def test_the_sharpest_image_of_every_part_is_taken(clip: Path, tmp_path: Path) -> None:
    written = extract_frames(clip, tmp_path / "out", 8)
    assert [path.name for path in written] == [f"frame_{k:04d}.jpg" for k in range(1, 9)]
    for path, step in zip(written, range(2, 40, 5), strict=True):
        image = np.asarray(Image.open(path)).astype(int)
        errors = [abs(image - scene(k, 0.0 if k % 5 == 2 else 2.0)).mean() for k in range(40)]
        assert errors[step] < 8
        assert errors[step] < min(error for k, error in enumerate(errors) if k % 5 != 2)


def test_work_folder_keeps_whole_sets_of_frames_alone(clip: Path, tmp_path: Path) -> None:
    work = tmp_path / "work"
    with pytest.raises(WorkCancelledError):
        kept_frames(clip, 6, work, stop_at("taking photographs out of the video"))
    assert not list(work.iterdir())
    folder = kept_frames(clip, 6, work)
    stamps = {path: path.stat().st_mtime_ns for path in folder.iterdir()}
    assert kept_frames(clip.rename(tmp_path / "renamed.MP4"), 6, work) == folder
    assert {path: path.stat().st_mtime_ns for path in folder.iterdir()} == stamps
    assert is_video(tmp_path / "renamed.MP4")
    assert not is_video(tmp_path)


def test_damaged_videos_end_in_a_line_or_give_what_can_be_read(clip: Path, tmp_path: Path) -> None:
    content, read = clip.read_bytes(), 0
    rng = np.random.default_rng(5)
    for case in range(40):
        data = bytearray(content)
        for _ in range(1 + case % 20):
            data[rng.integers(len(data))] = rng.integers(256)
        video = tmp_path / "damaged.mp4"
        video.write_bytes(data[: int(len(data) * rng.uniform(0.2, 1))] if case % 3 == 0 else data)
        with suppress(LangSplatError):  # and nothing else
            extract_frames(video, tmp_path / f"out{case}", 5)
            read += 1
        assert not list(tmp_path.glob("*.part"))
    assert len(list(tmp_path.glob("out*"))) == read
    assert read > 0


@pytest.mark.parametrize("suffix", [".mov", ".mkv", ".avi", ".ts"])
def test_containers_of_videos_are_read(suffix: str, tmp_path: Path) -> None:
    video = write_video(tmp_path / f"a{suffix}", [scene(k) for k in range(12)])
    assert len(extract_frames(video, tmp_path / "out", 4)) == 4


STREAM = b"v=0\no=- 0 0 IN IP4 127.0.0.1\ns=x\nc=IN IP4 127.0.0.1\nt=0 0\nm=video 5004 RTP/AVP 96\n"
STREAM += b"a=rtpmap:96 H264/90000\n"
PLAYLIST = b"#EXTM3U\n#EXT-X-TARGETDURATION:1\n#EXTINF:1,\nclip.mp4\n#EXT-X-ENDLIST\n"
TEXTS = [
    STREAM,
    PLAYLIST,
    b"ffconcat version 1.0\nfile clip.mp4\n",
    b"YUV4MPEG2 W8 H8 F25:1\n" + b"FRAME\n" * 9,
]


@pytest.mark.parametrize("content", [b"", b"no video at all" * 50, *TEXTS])
def test_other_files_are_no_videos(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "a.mp4").write_bytes(content)
    with pytest.raises(FormatError, match=r"a\.mp4: not a readable video \([^\[:]+\); copy it again"):
        extract_frames(tmp_path / "a.mp4", tmp_path / "out", 5)
    with pytest.raises(InputError, match="no such file"):
        extract_frames(tmp_path / "b.mp4", tmp_path / "out", 5)


def test_heic_is_a_photograph(tmp_path: Path) -> None:
    pillow_heif.register_heif_opener()
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0xA405] = 28
    Image.fromarray(scene(0)).save(tmp_path / "a.heic", exif=exif, quality=95)
    assert abs(np.asarray(read_photo(tmp_path / "a.heic", True)).astype(int) - scene(0)).mean() < 6
    assert dict(optics(tmp_path / "a.heic").get_ifd(0x8769)) == {0xA405: 28}


def test_without_its_codec_heic_names_the_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pillow_heif.register_heif_opener()
    Image.fromarray(scene(0)).save(tmp_path / "a.heic")
    monkeypatch.delitem(Image.OPEN, "HEIF")
    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    with pytest.raises(PictureError, match=r"HEIC needs pillow-heif: pip install .*\[phones\]"):
        read_photo(tmp_path / "a.heic", True)
