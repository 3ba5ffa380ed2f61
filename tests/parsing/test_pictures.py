"""Pictures are opened by their content, in one place, within limits, and every failure is one error."""

import io
import re
import struct
import warnings
import zlib
from pathlib import Path

import numpy as np
import pytest
from PIL import EpsImagePlugin, Image

from langsplat_core.datasets.capture import find_photos, read_photo
from langsplat_core.errors import FormatError
from langsplat_core.io.hostile import MOST_PIXELS, PictureError, opened, picture_size

ROOT = Path(__file__).parents[2]
EPS = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 10 10\n%%EndComments\nshowpage\n%%EOF\n"


def saved(kind: str, size: tuple[int, int] = (20, 15), **options: object) -> bytes:
    pixels = np.random.default_rng(0).integers(0, 256, (size[1], size[0], 3), dtype=np.uint8)
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, kind, **options)
    return buffer.getvalue()


def png_that_claims(width: int, height: int) -> bytes:
    data = bytearray(saved("PNG"))
    data[16:24] = struct.pack(">II", width, height)
    data[29:33] = struct.pack(">I", zlib.crc32(data[12:29]))
    return bytes(data)


def test_nothing_else_opens_pictures() -> None:
    sources = [
        path for folder in ("langsplat_core", "app", "packaging") for path in (ROOT / folder).rglob("*.py")
    ]
    openers = [path.name for path in sources if re.search(r"\bImage\.open\(", path.read_text())]
    assert openers == ["hostile.py"]
    assert (ROOT / "langsplat_core/io/hostile.py") in sources


def test_postscript_starts_no_program(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    started: list[object] = []
    monkeypatch.setattr(EpsImagePlugin, "Ghostscript", lambda *args: started.append(args))
    (tmp_path / "a.png").write_bytes(EPS)
    with pytest.raises(PictureError, match="the content is none of JPEG, PNG"):
        read_photo(tmp_path / "a.png", upright=False)
    assert not started


@pytest.mark.parametrize("kind", ["JPEG", "PNG", "WEBP", "TIFF", "BMP"])
def test_the_content_tells_the_kind(tmp_path: Path, kind: str) -> None:
    (tmp_path / "a.jpg").write_bytes(saved(kind))
    assert picture_size(tmp_path / "a.jpg") == (20, 15)
    assert read_photo(tmp_path / "a.jpg", upright=True).size == (20, 15)


@pytest.mark.parametrize("kind", ["GIF", "PPM", "TGA", "ICO", "DDS", "PCX"])
def test_kinds_that_are_not_claimed_are_refused(tmp_path: Path, kind: str) -> None:
    (tmp_path / "a.png").write_bytes(saved(kind))
    with pytest.raises(PictureError, match="the content is none of"):
        picture_size(tmp_path / "a.png")


def test_bitmaps_and_new_kinds_are_photographs(tmp_path: Path) -> None:
    for name in ("a.bmp", "b.avif", "c.heic", "d.gif"):
        (tmp_path / name).write_bytes(b"x")
    assert [path.name for path in find_photos(tmp_path)] == ["a.bmp", "b.avif", "c.heic"]


@pytest.mark.parametrize("size", [(12_000, 12_000), (1, 2**31 - 1), (5000, 5000), (40_000, 40_000)])
def test_a_declared_size_is_judged_before_decoding(size: tuple[int, int]) -> None:
    """Pillow's own limit would let the first and the third through: 430 and 75 MB out of a kilobyte."""
    with pytest.raises(PictureError, match="declares"), opened(png_that_claims(*size)) as picture:
        pytest.fail(f"opened {picture.size}")


def test_large_photographs_are_let_through() -> None:
    """Judged by the size of the file: 100 megapixels of a real camera take at least a megabyte."""
    data = png_that_claims(12_000, 8_000)
    padding = b"\0" * 1_000_000
    with opened(data + padding) as picture:
        assert picture.size == (12_000, 8_000)
    assert MOST_PIXELS >= 151_000_000  # the largest sensor that is sold


@pytest.mark.parametrize(
    "error", [IndexError, AssertionError, TypeError, NotImplementedError, RuntimeError, MemoryError]
)
def test_whatever_a_decoder_raises_is_one_error(tmp_path: Path, error: type[Exception]) -> None:
    (tmp_path / "a.png").write_bytes(saved("PNG"))
    with pytest.raises(PictureError) as caught, opened(tmp_path / "a.png"):
        raise error("inside\nPillow")
    assert str(caught.value) == f"{tmp_path / 'a.png'}: not a readable picture (damaged: inside Pillow)"
    assert caught.value.reason == "damaged: inside Pillow"


def test_what_the_reader_itself_refuses_is_kept() -> None:
    with pytest.raises(FormatError, match="too small"), opened(saved("PNG")):
        raise FormatError("too small")


def test_damaged_tiff_says_nothing_on_the_standard_error(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], recwarn: pytest.WarningsRecorder
) -> None:
    """libtiff's own messages, Pillow's loggers and its warnings about tags."""
    good = saved("TIFF", compression="tiff_lzw")
    rng = np.random.default_rng(0)
    refused = 0
    for place in range(8, len(good), 31):
        (tmp_path / "a.tif").write_bytes(good[:place] + rng.bytes(3) + good[place + 3 :])
        try:
            read_photo(tmp_path / "a.tif", upright=True)
        except PictureError:
            refused += 1
    assert refused > 3
    assert capfd.readouterr().err == ""
    assert not recwarn.list


def test_warnings_are_back_when_the_last_picture_is_closed() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        before = list(warnings.filters)
        first, second = opened(saved("PNG")), opened(saved("BMP"))
        first.__enter__()
        second.__enter__()
        first.__exit__(None, None, None)
        warnings.warn("the second is still open", UserWarning, stacklevel=1)
        second.__exit__(None, None, None)
        assert warnings.filters == before
        with pytest.raises(UserWarning):
            warnings.warn("none is", UserWarning, stacklevel=1)
