"""Readers of untrusted files: arrays, JSON, archives and images.

Any fault is a single InputError or FormatError, and no memory is allocated for what only a header claims.
"""

import io
import json
import logging
import math
import re
import stat
import struct
import warnings
import zipfile
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO, TypeVar

import msgspec
import numpy as np
from PIL import Image, features

from langsplat_core.arrays import Array
from langsplat_core.errors import (
    FormatError,
    InputError,
    LangSplatError,
    malformed,
    printable_line,
    quoted,
    remedy,
    report_loss,
    unread,
)
from langsplat_core.io.files import atomic_path
from langsplat_core.scene import SH_COUNTS

T = TypeVar("T")
CONTROL = re.compile(r"[\0-\x08\x0e-\x1a\x1c-\x1f]")  # characters that are in no text
COMMA = re.compile(r"(?<![\w.,])[-+]?\d+,\d+(?![\w,])")

# ---- memory: decoded sizes are checked against the size of the file before allocation ----

FREE = 48 << 20  # bytes that any file may decode to
# Bytes in memory per byte of the file: for plain arrays (8 bits may be widened to 32), and for compressed
# formats of Gaussians, where real files have 8 to 20 and deflated zeros 1000.
PLAIN_RATIO, SMALL_RATIO = 4, 32


class Allowance:
    """Number of bytes that one file may still decode to."""

    def __init__(self, path: object, size: int, ratio: int = PLAIN_RATIO, free: int = FREE) -> None:
        """path: for messages; size: of the file on disk, bytes."""
        self._path, self._size, self.left = path, size, free + ratio * size  # left: bytes

    def take(self, size: int) -> None:
        """Count `size` bytes before they are allocated; FormatError if the file is too small for them."""
        self.left -= size
        if self.left < 0:
            what = f"its {self._size} bytes unfold to far more than files of this kind do"
            raise malformed(self._path, f"truncated, or made to exhaust memory: {what}")

    def take_gaussians(self, count: int, sh_degree: int) -> None:
        """Count the decoded rows of Gaussians."""
        self.take(4 * count * (11 + 3 * SH_COUNTS[sh_degree]))


# ---- .npy and .npz: plain numbers or texts, read without pickles, with checked headers ----


def write_npy(path: Path, array: Array, behind: bytes = b"") -> None:
    """Write an array of numbers atomically, with bytes `behind` it that NumPy does not read.

    `np.save` writes through C's library and does not report a disk that is full just before the end.
    """
    whole = np.asarray(array, order="C")
    header = np.lib.format.header_data_from_array_1_0(whole)
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        np.lib.format.write_array_header_1_0(file, header)
        file.write(whole.reshape(-1).view(np.uint8).data)
        file.write(behind)


def read_npy(path: Path) -> Array:
    """Return the array of numbers in a .npy file; InputError if it cannot be opened, else FormatError."""
    file, size = open_for_reading(path)
    with file:
        return _parse(file, size, str(path))


def read_npz(path: Path, free: int = FREE) -> dict[str, Array]:
    """Return an .npz file's arrays by name, as `read_npy`; free: bytes they may take in a small file."""
    arrays = {}
    with opened_archive(path, ".npz file", free) as archive:
        for member in archive.names:
            data = archive.read(member, 2**31)
            name = member.removesuffix(".npy")
            arrays[name] = _parse(io.BytesIO(data), len(data), f"{path}: {quoted(name, 60)}", data)
    return arrays


def _parse(file: BinaryIO, size: int, name: str, whole: bytes | None = None) -> Array:
    """Return the array in `size` bytes of `file`; name: for messages; whole: its content, if in memory."""
    form = np.lib.format
    try:
        if form.read_magic(file) != (1, 0):  # later versions are for records of thousands of columns
            raise ValueError("version")
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # NumPy repairs headers of Python 2 with a warning
            shape, in_columns, dtype = form.read_array_header_1_0(file)
        plain = (dtype.kind in "iuf" and dtype.itemsize <= 8) or (dtype.kind == "U" and dtype.itemsize > 0)
        if not plain or dtype.subdtype is not None or min(shape, default=0) < 0:
            raise ValueError(dtype)
    except Exception:  # noqa: BLE001  the header is a Python literal: tokenizer, parser and NumPy may raise any
        raise malformed(name, "not a .npy file of plain numbers", "was it made by another program?") from None
    left = size - file.tell()
    if math.prod(shape) * dtype.itemsize != left:
        raise malformed(name, f"truncated or damaged: shape {quoted(shape)} does not fit its {left} bytes")
    data = np.frombuffer(file.read() if whole is None else memoryview(whole)[file.tell() :], dtype)
    if dtype.kind == "U" and data.size:
        codes = data.view(data.dtype.byteorder.replace("|", "=") + "u4")
        if ((codes >= 0xD800) & (codes <= 0xDFFF) | (codes > 0x10FFFF)).any():  # NumPy raises SystemError
            raise malformed(name, "holds a text that is not Unicode")
    return data.reshape(shape, order="F" if in_columns else "C")


# ---- opening a file and JSON, with one line for the user for every way it can fail ----


def open_for_reading(path: Path) -> tuple[BinaryIO, int]:
    """Return an ordinary file opened in binary mode, and its size in bytes.

    Raises InputError for a path that does not exist, is a folder, a device or a pipe, or may not be read.
    """
    try:
        status = path.stat()
        if stat.S_ISDIR(status.st_mode):
            raise InputError(f"{path}: is a folder; name a file in it")
        if not stat.S_ISREG(status.st_mode):
            raise InputError(f"{path}: is not an ordinary file; copy it into one")
        return path.open("rb"), status.st_size
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; check the spelling and the folder") from None
    except (OSError, ValueError) as error:  # ValueError: a NUL in the name
        reason = getattr(error, "strerror", None) or error  # without the name, which may be long
        raise InputError(f"{path}: cannot be opened ({reason}); check its name and permissions") from None


class FromFile(str):
    """A name from a file: it may be a local path, but causes no network request and no expansion of `~`."""


def is_plain_name(name: object) -> bool:
    """Return True if a name in a file is that of a file beside it: a path could leave the folder."""
    fits = isinstance(name, str) and 0 < len(name) < 256  # limit of file systems
    return fits and name not in (".", "..") and not set(str(name)) & set("/\\:\0")


def read_file(path: Path, limit: int) -> bytes:
    """Return the content of a file of at most `limit` bytes. Raises InputError and FormatError."""
    file, size = open_for_reading(path)
    with file:
        if size > limit:
            raise malformed(path, f"{size} bytes, but a file of this kind never exceeds {limit}")
        return file.read(size)


def read_text(path: Path) -> str:
    """Return the text in a file of at most 64 MiB. Raises InputError, and as `decode_text` does."""
    return decode_text(read_file(path, 1 << 26), path)


def decode_text(data: bytes, path: Path) -> str:
    r"""Return the text of a file of any program, with "\n" at the ends of lines.

    UTF-8, UTF-16 or UTF-32, else Windows-1252, which is reported as a guess; FormatError if it is no text.
    """
    try:
        text = data.decode(json.detect_encoding(data))
    except UnicodeDecodeError as error:
        text = decode_name(data)
        if CONTROL.search(text):
            raise malformed(path, "is no text", "save it as text in UTF-8") from None
        line = data.count(b"\n", 0, error.start) + 1
        guess = "%s, line %d: is not UTF-8 and is read as Windows-1252; save the file as UTF-8"
        report_loss(guess, path, line)
    return text.removeprefix("\ufeff").replace("\r\n", "\n").replace("\r", "\n")


def decode_name(data: bytes) -> str:
    """Return bytes as text, in UTF-8 or else in Windows-1252."""
    try:
        return data.decode()
    except UnicodeDecodeError:
        return data.decode("cp1252", "replace")


def decimal_comma(text: object) -> str:
    """Return the hint for a message about a number with a decimal comma; "" for other texts."""
    return "; numbers need a decimal point, not a comma" if COMMA.search(str(text)) else ""


def read_json_file(path: Path, limit: int) -> Any:
    """Return the value in a JSON file of at most `limit` bytes. Raises InputError and FormatError."""
    data = read_file(path, limit)
    with _as_json(path):
        _check_values(data, path)
        text = decode_text(data, path)
        # `int` of many digits is slow or too large for a float; half a surrogate pair cannot be shown
        value = json.loads(text, parse_int=lambda digits: int(digits) if len(digits) < 20 else float(digits))
        if re.search(r"\\u[dD][89a-fA-F]", text):
            json.dumps(value, ensure_ascii=False).encode()
        return value


def decode_json(text: bytes, kind: type[T], path: Path) -> T:
    """Return the value of a JSON text as the msgspec structure `kind`; FormatError if it does not fit."""
    with _as_json(path):
        _check_values(text, path)
        return msgspec.json.decode(text.decode(json.detect_encoding(text)), type=kind)


def other_entries(text: bytes, known: Collection[str], path: Path) -> str:
    """Return, for `report_losses`, the entries of a JSON object that are not in `known`; FormatError."""
    entries = decode_json(text, dict[str, msgspec.Raw], path)
    return unread("entries", (quoted(name, 40) for name in entries if name not in known))


def _check_values(text: bytes, path: Path) -> None:
    """Check the memory of the values of a JSON text: an empty dictionary takes 240 bytes, a list 64."""
    Allowance(path, len(text)).take(40 * text.count(b",") + 240 * text.count(b"{") + 64 * text.count(b"["))


@contextmanager
def _as_json(path: Path) -> Iterator[None]:
    """Turn errors of syntax, of deep nesting, long numbers and unfitting values into FormatError."""
    try:
        yield
    except LangSplatError:
        raise
    except (RecursionError, ValueError) as error:
        raise malformed(path, f"not readable as JSON ({printable_line(error, 100)})") from None


# ---- zip archives, with checked directories ----
#
# For damaged archives `zipfile` raises whatever its decompressors and its parser raise (LZMAError,
# IndexError, struct.error, NotImplementedError, zlib.error ...), so every exception here means an unreadable
# archive. Only stored and deflated members are unpacked: no format that is read here uses other methods.


MOST_DIRECTORY = 4 << 20  # bytes, for 40 000 names; zipfile's objects take ten times as much


class Archive:
    """The members of an open archive."""

    def __init__(self, archive: zipfile.ZipFile, path: Path, size: int, free: int) -> None:
        self._archive, self.path, self.size = archive, path, size  # size of the file, bytes
        self.names = archive.namelist()
        self.deflated = any(info.compress_type for info in archive.infolist())  # True if any is compressed
        self._room = Allowance(path, size, free=free)

    def read(self, name: str, limit: int) -> bytes:
        """Return the content of a member.

        FormatError if there is none, or beyond `limit` bytes or the archive's allowance, unpacked no further.
        """
        try:
            info = self._archive.getinfo(name)
        except KeyError:
            raise malformed(self.path, f"has no {quoted(name, 60)} inside") from None
        if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            what = f"{quoted(name, 60)} inside is packed by method {info.compress_type}"
            raise malformed(self.path, what, "pack the archive again with deflate")
        with self._archive.open(info) as member:
            content = member.read(min(limit, self._room.left) + 1)
        self._room.take(len(content))
        if len(content) > limit:
            raise malformed(self.path, f"{quoted(name, 60)} inside has more than {limit} bytes")
        return content


@contextmanager
def opened_archive(path: Path, kind: str, free: int = FREE) -> Iterator[Archive]:
    """Open an archive; kind: for messages; free: as in `read_npz`. InputError; in the block FormatError."""
    file, size = open_for_reading(path)
    with file:
        try:
            _check_directory(file, size)
            with zipfile.ZipFile(file) as archive:
                yield Archive(archive, path, size, free)
        except LangSplatError:
            raise
        except Exception as error:  # noqa: BLE001  any at all, see above
            what = str(error)[:80] or type(error).__name__
            raise malformed(path, f"not a readable {kind} ({what})") from None


def _check_directory(file: BinaryIO, size: int) -> None:
    """Raise ValueError for a directory of more than `MOST_DIRECTORY` bytes."""
    file.seek(max(0, size - (1 << 16) - 98))
    tail = file.read()
    for signature, form, at in ((b"PK\5\6", "<I", 12), (b"PK\6\6", "<Q", 40)):
        place = tail.rfind(signature) + at
        if (
            place >= at
            and len(tail) >= place + 8
            and struct.unpack_from(form, tail, place)[0] > MOST_DIRECTORY
        ):
            raise ValueError(f"a directory of more than {MOST_DIRECTORY} bytes")


# ---- images: the only place of the project that opens a file with Pillow ----
#
# The kind is recognised by the content, and only the kinds below are tried: for others (EPS, WMF, FITS ...)
# Pillow starts other programs or allocates what a short header asks for. The declared size is checked before
# a pixel is decoded. For damaged data Pillow raises whatever its decoders raise (IndexError, AssertionError,
# TypeError, NotImplementedError ...), so every exception here means an unreadable image. Its warnings about
# damaged metadata are silenced: an image is either read or refused.

warnings.filterwarnings("ignore", module=r"PIL\.")
logging.getLogger("PIL").setLevel(logging.CRITICAL)

KINDS = ("JPEG", "PNG", "WEBP", "TIFF", "BMP")  # always; AVIF if Pillow has a codec, HEIF with pillow_heif
# HEIF is included even if it cannot be read: a message then says why such photographs are left out.
PHOTO_SUFFIXES = (".jpg", ".jpeg", ".png", ".webp", ".tif", ".tiff", ".bmp", ".avif", ".heic", ".heif")
VIDEO_SUFFIXES = (".mp4", ".mov", ".m4v", ".mkv", ".webm", ".avi")
HEIF_BRANDS = (b"heic", b"heix", b"mif1", b"hevc", b"heim", b"heis")
MOST_PIXELS = 178_000_000  # of any image: 0.7 GB decoded; the largest cameras have 151 million
MOST_PIXELS_REDUCED = 268_000_000  # of photographs, which are halved while reading; some phones have 200
Image.MAX_IMAGE_PIXELS = MOST_PIXELS_REDUCED  # Pillow itself allows twice as many
# Images with more pixels than these must have a file of a fitting size: photographs have 2 to 100 pixels per
# byte, hostile files a million. The decoders of WebP and AVIF hold two more copies of the image.
FREE_PIXELS, FREE_PIXELS_COPIED, PIXELS_PER_BYTE = 16_000_000, 8_000_000, 128
# Errors whose text is about the file; that of others, such as IndexError, is about Pillow's code.
TELLING = (OSError, SyntaxError, ValueError, Image.DecompressionBombError)


class PictureError(FormatError):
    """An image that cannot be read; `reason` is the message without the file's name."""

    def __init__(self, name: object, reason: str) -> None:
        self.reason = reason
        super().__init__(f"{name}: not a readable picture ({reason}); save it again as PNG or JPEG")


@contextmanager
def opened(
    source: Path | bytes,
    name: str | None = None,
    kinds: tuple[str, ...] | None = None,
    most: int = MOST_PIXELS,
) -> Iterator[Image.Image]:
    """Open the image in a file or in bytes, for decoding within the block.

    name: for messages, by default the path. Raises PictureError if it cannot be opened, is of none of the
    `kinds` (default: all that are read), declares more than `most` pixels, or fails within the block.
    """
    name = name or (str(source) if isinstance(source, Path) else "a picture in memory")
    try:
        if isinstance(source, Path):
            file, size = open_for_reading(source)
        else:
            file, size = io.BytesIO(source), len(source)
    except InputError as error:
        raise PictureError(name, str(error).removeprefix(f"{name}: ")) from None
    with file:
        try:
            lacking = _lacks_heif(file)
            known = KINDS + ("AVIF",) * bool(features.check("avif")) + ("HEIF",) * ("HEIF" in Image.OPEN)
            # Image.open chooses the kind by the first bytes, not by the name
            with Image.open(file, formats=kinds or known) as picture:
                free = FREE_PIXELS_COPIED if picture.format in ("WEBP", "AVIF", "HEIF") else FREE_PIXELS
                most = min(most, free + PIXELS_PER_BYTE * size)
                if picture.width * picture.height > most:
                    declared = f"declares {picture.width}x{picture.height} pixels; at most {most // 10**6}"
                    raise PictureError(name, f"{declared} million are read from a file of {size} bytes")
                yield picture
        except LangSplatError:
            raise
        except Image.UnidentifiedImageError:
            if lacking and not kinds:
                raise PictureError(name, f"HEIC needs pillow-heif: {remedy('pillow_heif')}") from None
            read = ", ".join(kinds or known)
            raise PictureError(name, f"the content is none of {read}, or damaged") from None
        except Exception as error:  # noqa: BLE001  any at all, see above
            text = printable_line(error, 80)
            telling = text and isinstance(error, TELLING)
            reason = text if telling else f"damaged: {text or type(error).__name__}"
            raise PictureError(name, reason) from None


def is_video(path: Path) -> bool:
    """Return True if a file has the suffix of a video."""
    return path.suffix.lower() in VIDEO_SUFFIXES and not path.is_dir()


def _lacks_heif(file: BinaryIO) -> bool:
    """Register the codec of HEIF for a file of that kind; True if there is none."""
    head = file.read(12)
    file.seek(0)
    if head[4:8] != b"ftyp" or head[8:] not in HEIF_BRANDS or "HEIF" in Image.OPEN:
        return False
    try:
        from pillow_heif import register_heif_opener
    except ImportError:
        return True
    register_heif_opener(thumbnails=False)
    return False


def picture_size(path: Path) -> tuple[int, int]:
    """Return (width, height) in pixels as the header declares them. Raises PictureError."""
    with opened(path, most=MOST_PIXELS_REDUCED) as picture:
        return picture.size
