"""Photographs of every kind, their masks and lenses, broken ones, and what phones make."""

import errno
import io
import logging
import struct
import sys
import zlib
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pillow_heif
import pytest
from PIL import Image, ImageCms
from scipy.ndimage import gaussian_filter

from langsplat_core.arrays import Array
from langsplat_core.config import DatasetConfig, RadianceConfig
from langsplat_core.datasets import Capture, load_capture, load_photographs
from langsplat_core.datasets.capture import develop, in_file
from langsplat_core.datasets.intrinsics import PhotoIntrinsics
from langsplat_core.datasets.photos import (
    Photo,
    count_photographs,
    mask_beside,
    optics,
    photo_folder,
    read_photo,
    say_unread,
    unique_names,
)
from langsplat_core.datasets.video import kept_frames
from langsplat_core.errors import InputError
from langsplat_core.io.hostile import PictureError, is_video, picture_size
from langsplat_core.progress import WorkCancelledError, silent
from langsplat_core.raster.render import render
from langsplat_core.scene import Scene, look_at
from langsplat_core.training.radiance.differentiable import evaluate_views
from langsplat_core.training.radiance.trainer import train_radiance
from tests.support.photographs import CONFIG, mask_file, poses, refuse, write_colmap, write_photos
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


def test_a_broken_photograph_is_left_out_and_named(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    write_colmap(tmp_path)
    (tmp_path / "images/a.png").write_bytes(b"")
    assert [camera.name for camera in load_capture(tmp_path, CONFIG, tmp_path / "work").cameras] == ["b"]
    assert "a.png" in caplog.text

    whole = (tmp_path / "images/b.png").read_bytes()
    (tmp_path / "images/b.png").write_bytes(whole[:200])
    assert "a.png" in refuse(tmp_path, tmp_path / "work")


def test_names_stay_unique() -> None:
    assert unique_names(["l/a.png", "r\\b.jpg"]) == ["a", "b"]
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
    for name in ("images/a.jpg", "a.jpg", "b.PNG"):
        (tmp_path / name).unlink()
    for name in ("left/1.jpg", "right/1.jpg", "masks/1.png", ".hidden/1.jpg"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"")
    assert photo_folder(tmp_path) == (tmp_path, [tmp_path / "left/1.jpg", tmp_path / "right/1.jpg"])
    (tmp_path / "right").rename(tmp_path / "left/right")
    (tmp_path / "left").rename(tmp_path / "scene.work")
    assert count_photographs(tmp_path) == 0  # of its own copies
    (tmp_path / "scene.work").rename(tmp_path / "DCIM")
    assert count_photographs(tmp_path) == 2


def test_unread_files_beside_photographs_are_named(tmp_path: Path, caplog) -> None:
    for name in ("1.HEIC", "1.MOV", "2.heic", "2.mov", "w.mp4", "old/1.jpg", "p.csv", "s.cameras.json"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"")
    (tmp_path / "IMG_3.jpg").symlink_to("not fetched.jpg")
    caplog.set_level(logging.INFO, "langsplat")
    say_unread(tmp_path, *photo_folder(tmp_path))
    assert [record.getMessage().partition(":")[0] for record in caplog.records] == [
        "1 links beside the photographs lead nowhere",
        "1 files may hold cameras and are not read; cameras are found anew, in a world of their own",
        "2 videos of Live Photos are not read, their stills are",
        "1 videos are not read, train each by itself",
        "1 photographs in other folders are not read",
    ]


@pytest.mark.parametrize("name", ["large.jpg", "large.png"])
def test_photographs_larger_than_other_images_may_be_are_halved(name, tmp_path, monkeypatch):
    shade = np.linspace(0, 255, 160).astype(np.uint8)
    Image.fromarray(np.broadcast_to(shade, (120, 160)).copy()).save(tmp_path / name)
    monkeypatch.setattr("langsplat_core.io.hostile.MOST_PIXELS", 10_000)
    assert picture_size(tmp_path / name) == (160, 120)
    assert read_photo(tmp_path / name, upright=True).size == (80, 60)


# Colours: what a file says its numbers mean.

PATCHES = np.array([(200, 40, 40), (40, 170, 60), (128, 128, 128), (235, 235, 235), (20, 20, 20)])
P3 = [(0.51512, 0.2412, -0.00105), (0.29198, 0.69225, 0.04189), (0.1571, 0.06657, 0.78407)]  # XYZ, of D50
TO_P3 = np.array([[0.8225, 0.1774, 0.0], [0.0332, 0.9669, 0.0], [0.0171, 0.0724, 0.9108]])
TO_2020 = np.array([[0.6274, 0.3293, 0.0433], [0.0691, 0.9195, 0.0114], [0.0164, 0.0880, 0.8956]])


def linear(shades: Array) -> Array:
    values = shades / 255
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)


def as_hlg(shades: Array) -> Array:
    """HLG of BT.2020, with diffuse white at 75 %."""
    light = 0.26496 * (linear(shades) @ TO_2020.T)
    high = 0.17883277 * np.log(np.maximum(12 * light - 0.28466892, 1e-9)) + 0.55991073
    return np.where(light <= 1 / 12, np.sqrt(3 * light), high)


def p3_profile() -> bytes:
    """sRGB's profile with the primaries of Display P3."""
    profile = bytearray(ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes())
    for name, place in zip((b"rXYZ", b"gXYZ", b"bXYZ"), P3, strict=True):
        (at,) = struct.unpack_from(">I", profile, profile.index(name) + 4)
        struct.pack_into(">3i", profile, at + 8, *(round(65536 * part) for part in place))
    return bytes(profile)


def with_chunk(data: bytes, name: bytes, content: bytes) -> bytes:
    """A PNG with one more chunk behind its header."""
    chunk = struct.pack(">I", len(content)) + name + content
    return data[:33] + chunk + struct.pack(">I", zlib.crc32(name + content)) + data[33:]


def patches(coded: Array) -> Image.Image:
    """An image with a patch of 16 px for each row, in [0, 1]."""
    shades = np.rint(255 * np.clip(coded, 0, 1)).astype(np.uint8)
    return Image.fromarray(shades[None].repeat(16, 0).repeat(16, 1))


def shown_patches(image: Array) -> Array:
    height, width = image.shape[:2]
    return image[height // 2, [width * (2 * k + 1) // (2 * len(PATCHES)) for k in range(len(PATCHES))]]


P3_LIGHT = linear(PATCHES) @ TO_P3.T
P3_CODED = np.where(P3_LIGHT <= 0.0031308, 12.92 * P3_LIGHT, 1.055 * P3_LIGHT ** (1 / 2.4) - 0.055)
PQ_POWER = (203 / 10_000 * (linear(PATCHES) @ TO_2020.T)) ** 0.1593017578125
PQ_CODED = ((0.8359375 + 18.8515625 * PQ_POWER) / (1 + 18.6875 * PQ_POWER)) ** 78.84375
CODED = {
    "profile": (P3_CODED, {"icc_profile": p3_profile()}, []),
    "profile before gAMA": (P3_CODED, {"icc_profile": p3_profile()}, [(b"gAMA", struct.pack(">I", 100_000))]),
    "linear": (linear(PATCHES), {}, [(b"gAMA", struct.pack(">I", 100_000))]),
    "gAMA of sRGB": (PATCHES / 255, {}, [(b"gAMA", struct.pack(">I", 45_455))]),
    "cICP of P3": (P3_CODED, {}, [(b"cICP", bytes([12, 13, 0, 1]))]),
    "cICP of HLG": (as_hlg(PATCHES), {}, [(b"cICP", bytes([9, 18, 0, 1]))]),
    "cICP of PQ": (PQ_CODED, {}, [(b"cICP", bytes([9, 16, 0, 1]))]),
    "nothing": (PATCHES / 255, {}, []),
}


@pytest.mark.parametrize("case", CODED)
def test_photographs_are_read_as_srgb(case: str, tmp_path: Path) -> None:
    coded, options, chunks = CODED[case]
    file = io.BytesIO()
    patches(coded).save(file, "png", **options)
    data = file.getvalue()
    for chunk in chunks:
        data = with_chunk(data, *chunk)
    (tmp_path / "a.png").write_bytes(data)
    told: list[str] = []
    found = shown_patches(np.asarray(read_photo(tmp_path / "a.png", True, told.append)))
    assert np.abs(found.astype(int) - PATCHES).max() <= (3 if case in ("cICP of HLG", "cICP of PQ") else 2)
    assert not told


def test_colours_that_are_not_known_are_named(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    write_colmap(tmp_path)
    want = load_photographs(tmp_path, CONFIG, tmp_path / "work").images[0]
    file = tmp_path / "images/a.png"
    plain = file.read_bytes()
    for said in (with_chunk(plain, b"cICP", bytes([22, 9, 0, 1])), None):
        caplog.clear()
        if said is None:
            Image.open(io.BytesIO(plain)).save(file, icc_profile=b"no profile")
        else:
            file.write_bytes(said)
        np.testing.assert_array_equal(load_photographs(tmp_path, CONFIG, tmp_path / "work").images[0], want)
        (line,) = caplog.messages
        assert "a.png" in line


def test_16_bits_and_12_in_them_become_8(tmp_path: Path) -> None:
    shades = np.arange(256, dtype=np.uint16).reshape(16, 16)
    for white, told_of in ((65535, 0), (4095, 1)):
        told: list[str] = []
        Image.fromarray((shades * (white / 255)).astype(np.uint16)).save(tmp_path / "a.png")
        found = np.asarray(read_photo(tmp_path / "a.png", True, told.append))[..., 0]
        assert np.abs(found.astype(int) - shades).max() <= 1
        assert len(told) == told_of


# Transparency: no part of the thing.


@pytest.mark.parametrize("alpha", ["auto", "mask", "background"])
@pytest.mark.parametrize("inside", [True, False])
def test_transparency_is_a_mask_or_an_empty_background(tmp_path, inside, alpha, caplog):
    """Photographs with one transparent part: all around the thing, or a spot inside."""
    write_colmap(tmp_path)
    for path in (tmp_path / "images").iterdir():
        shades = np.full((30, 40), 255 * inside, np.uint8)
        shades[8:22, 10:30] = 255 * (not inside)
        shades[8, 10:30] = 100
        image = Image.open(path)
        image.putalpha(Image.fromarray(shades))
        image.save(path)
    capture = load_photographs(tmp_path, replace(CONFIG, alpha=alpha), tmp_path / "work")
    assert capture.cut_out == (not inside if alpha == "auto" else alpha == "background")
    counted = capture.mask(0)
    assert bool(counted[15, 20]) != inside
    assert bool(counted[8, 20]) == capture.cut_out  # the thing's edge
    assert (capture.images[0][15 if inside else 0, 20] == 0).all()
    whole = np.asarray(Image.open(tmp_path / "images/a.png"))[8, 20]
    assert np.abs(capture.images[0][8, 20] - whole[:3] * (100 / 255)).max() <= 1  # in part, over black
    assert sum(record.levelno > logging.INFO for record in caplog.records) == (alpha == "auto")  # a guess
    again = capture.read_at([0], 30)
    assert again.cut_out == capture.cut_out
    assert again.mask(0) is not None


def test_cut_out_background_stays_empty() -> None:
    """A red ball before nothing, from points all over the space around it."""
    rng = np.random.default_rng(3)
    cameras, images, masks = [], [], []
    for angle in np.linspace(0, 2 * np.pi, 8, endpoint=False):
        eye = 4 * np.array([np.cos(angle), np.sin(angle), 0.3])
        camera = replace(look_at(eye, np.zeros(3), np.array([0, 0, 1.0]), (48, 48)), name=f"{angle:.2f}")
        y, x = np.mgrid[:48, :48]
        mask = np.hypot(x - 23.5, y - 23.5) < 10
        cameras.append(camera)
        masks.append(mask)
        images.append(np.where(mask[..., None], np.uint8([200, 40, 40]), np.uint8(0)))
    points = rng.uniform(-1.5, 1.5, (400, 3))
    colours = np.zeros((400, 3), np.uint8)
    capture = Capture(tuple(cameras), tuple(images), points, colours, masks=tuple(masks), cut_out=True)
    config = RadianceConfig(steps=150, sh_degree=0, max_gaussians=600, backend="cpu")
    gaussians = train_radiance(capture, config, range(8))
    alphas = [render(Scene(gaussians), camera).alpha for camera in cameras]
    assert np.mean([alpha[~mask].mean() for alpha, mask in zip(alphas, masks, strict=True)]) < 0.05
    assert np.mean([alpha[mask].mean() for alpha, mask in zip(alphas, masks, strict=True)]) > 0.8


# Masks beside photographs.

LENS = PhotoIntrinsics(120, 90, 110.0, 110.0, 60.0, 45.0)


@pytest.mark.parametrize("place", ["images/masks", "masks", "mask", "masks/images"])
@pytest.mark.parametrize("name", ["a.jpg.png", "a.png"])
def test_a_mask_lies_beside_its_photograph(place: str, name: str, tmp_path: Path) -> None:
    (tmp_path / place).mkdir(parents=True)
    photo, mask = tmp_path / "images/a.jpg", tmp_path / place / name
    assert mask_beside(photo) is None
    mask.write_bytes(b"")
    assert mask_beside(photo) == mask
    assert (mask_beside(tmp_path / f"photos/images/{photo.name}") is None) != (place == "masks/images")
    assert mask_beside(tmp_path / f"{'a' * 300}.jpg") is None  # no file can have the name of its mask
    assert mask_beside(mask) is None


def developed(photos: list[Photo]) -> Capture:
    return develop(photos, DatasetConfig(max_side=120), silent, np.zeros((0, 3)), np.zeros((0, 3), np.uint8))


def test_a_mask_has_the_shape_of_the_photograph_as_it_is_shown(tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[0x0112] = 6  # stored lying on its side
    Image.new("RGB", (90, 120), "white").save(tmp_path / "a.jpg", exif=exif)
    shown = np.ones((45, 60), bool)
    shown[:, :20] = False
    mask = mask_file(tmp_path / "masks/a.png", shown)
    photo = Photo(tmp_path / "a.jpg", "a.jpg", LENS, np.eye(4), upright=True, mask=mask)
    (found,) = developed([photo]).masks
    np.testing.assert_array_equal(found, shown.repeat(2, 0).repeat(2, 1))
    Image.fromarray(shown.astype(np.uint8)).save(mask)  # of 0 and 1
    np.testing.assert_array_equal(developed([photo]).masks, [found])
    mask_file(mask, shown.T)
    with pytest.raises(InputError, match=r"a\.png: is 45x60 pixels, its photograph 120x90"):
        developed([photo])


def test_masks_that_are_missing_or_stray_are_said(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    names = write_photos(tmp_path / "images", LENS, poses(3))
    white = np.ones((90, 120), bool)
    for name in ("view_0.png", "view_2.png.png", "view_9.png", "0001.png", "view_1.jpg"):
        mask_file(tmp_path / "masks" / name, white)
    paths = [tmp_path / "images" / name for name in names]
    photos = [Photo(path, path.name, LENS, np.eye(4), mask=mask_beside(path)) for path in paths]
    masks = developed(photos[:2]).masks  # of the third none is stray
    assert [mask is None for mask in masks] == [False, True]
    missing, stray = caplog.messages
    assert missing.startswith("1 of 2 photographs have a mask")
    assert stray.startswith("3 masks are of no photograph: 0001.png, view_1.jpg, view_9.png; ")


def test_a_photograph_of_which_nothing_counts_is_left_out(tmp_path, caplog):
    names = write_photos(tmp_path, LENS, poses(2))
    mask = mask_file(tmp_path / "masks/view_1.png", np.zeros((90, 120), bool))
    photos = [Photo(tmp_path / name, name, LENS, np.eye(4)) for name in names]
    photos[1] = replace(photos[1], mask=mask)
    views = developed(photos)
    assert ([camera.name for camera in views.cameras], views.masks) == (["view_0"], ())
    assert "view_1.png (its mask leaves nothing of it)" in caplog.text


def test_masked_pixels_neither_train_nor_count() -> None:
    rng = np.random.default_rng(3)
    cameras = [look_at(np.array([x, 0, -3.0]), np.zeros(3), [0, -1, 0], (32, 24)) for x in (-1, 0, 1)]
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
def test_focal_length_follows_from_pixels_per_inch(unit, millimetres, tmp_path):
    """A sensor 22.3 mm wide, of 4 to 3, 4000 pixels; the file was made smaller since."""
    tags: dict[int, float] = {FOCAL_TAG: 18.0, PLANE_X: 4000 / 22.3 * millimetres, PLANE_WIDTH: 4000}
    if unit is not None:
        tags[PLANE_UNIT] = unit
    expected = 18 / (22.3 * 1.25) * np.hypot(36, 24)
    assert on_film(tagged(tmp_path / "a.jpg", tags)) == round(expected)


@pytest.mark.parametrize(
    "tags", [{}, {FOCAL_TAG: 18.0, PLANE_X: 4500.0, PLANE_UNIT: 77}, {FOCAL_TAG: 1e6, PLANE_X: 1e9}]
)
def test_implausible_exif_lenses_are_left_out(tags: dict[int, float], tmp_path: Path) -> None:
    assert on_film(tagged(tmp_path / "a.jpg", tags)) is None


# What phones make: HEIC photographs and videos.

WIDTH, HEIGHT = 96, 64


def scene(step: int, blur: float = 0.0) -> Array:
    """Return (H, W, 3) uint8: plain stripes that wander, red above and blue below."""
    image = np.zeros((HEIGHT, WIDTH, 3))
    image[: HEIGHT // 2, :, 0] = image[HEIGHT // 2 :, :, 2] = 200
    image[:, (np.arange(WIDTH) + step) % 12 < 4] += 50
    return gaussian_filter(image, (blur, blur, 0)).astype(np.uint8)


@pytest.mark.parametrize(
    ("size", "deep", "tags", "aspect"),
    [
        ((1280, 720), False, (2, 2, 2), 1),  # HD without a word
        ((640, 320), False, (5, 6, 6), 1),  # BT.601
        ((640, 320), True, (9, 18, 9), 1),  # HLG
        ((480, 360), False, (1, 1, 1), Fraction(4, 3)),  # pixels that are wider than high
        ((480, 360), False, (1, 1, 1), Fraction(3, 4)),
    ],
)
def test_videos_are_read_as_they_are_shown(size, deep, tags, aspect, tmp_path):
    coded = (as_hlg(PATCHES) if deep else PATCHES / 255)[np.arange(size[0]) * len(PATCHES) // size[0]]
    image = np.broadcast_to(coded, (size[1], size[0], 3))
    with av.open(str(tmp_path / "a.mp4"), "w") as container:
        stream = container.add_stream("libx264", rate=10, options={"crf": "8"})
        stream.width, stream.height = size
        stream.pix_fmt = "yuv420p10le" if deep else "yuv420p"
        stream.codec_context.sample_aspect_ratio = aspect
        context = stream.codec_context
        context.colorspace, context.color_trc, context.color_primaries, context.color_range = *tags, 1
        for _ in range(3):
            whole = np.rint(image * (65535 if deep else 255)).astype("<u2" if deep else "u1")
            frame = av.VideoFrame.from_ndarray(whole, format="rgb48le" if deep else "rgb24")
            made = 1 if tags[0] == 2 else tags[0]
            shown = frame.reformat(format=stream.pix_fmt, dst_colorspace=made, dst_color_range=1)
            shown.colorspace, shown.color_trc, shown.color_primaries, shown.color_range = *tags, 1
            container.mux(stream.encode(shown))
        container.mux(stream.encode())
    first = np.asarray(Image.open(kept_frames(tmp_path / "a.mp4", 3, tmp_path) / "frame_0001.jpg"))
    assert first.shape[:2] == (round(size[1] / min(aspect, 1)), round(size[0] * max(aspect, 1)))
    assert np.abs(shown_patches(first).astype(int) - PATCHES).max() <= 5


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
    written = sorted(kept_frames(clip, 8, tmp_path).iterdir())
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


@pytest.mark.parametrize("suffix", [".mov", ".mkv", ".avi", ".ts"])
def test_containers_of_videos_are_read(suffix: str, tmp_path: Path) -> None:
    video = write_video(tmp_path / f"a{suffix}", [scene(k) for k in range(12)])
    assert len(list(kept_frames(video, 4, tmp_path).iterdir())) == 4


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
