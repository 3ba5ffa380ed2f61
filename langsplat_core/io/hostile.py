"""Files that nobody vouches for: arrays, JSON, archives and images.

Whatever is wrong with one is a single InputError or FormatError, and no memory is taken on the word of a
header.
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
CONTROL = re.compile(r"[\0-\x08\x0e-\x1a\x1c-\x1f]")  # characters that no text has
COMMA = re.compile(r"(?<![\w.,])[-+]?\d+,\d+(?![\w,])")

# ---- memory: what a file decodes to is counted against the bytes that it has, before it is held ----

FREE = 48 << 20  # bytes that any file may decode to
# Bytes in memory for each of the file: arrays as they are, or of 8 bits widened to 32; and rows of Gaussians
# whose formats are made to be small. Honest files of these have 8 to 20; a deflated hole has 1000.
PLAIN_RATIO, SMALL_RATIO = 4, 32


class Allowance:
    """Budget of what one file may still decode to; it becomes less as its parts are read."""

    def __init__(self, path: object, size: int, ratio: int = PLAIN_RATIO, free: int = FREE) -> None:
        """path: for messages; size: of the file, bytes as they lie on the disk."""
        self._path, self._size, self.left = path, size, free + ratio * size  # left: bytes

    def take(self, size: int) -> None:
        """Count `size` bytes before they are held; FormatError where the file is too small for them."""
        self.left -= size
        if self.left < 0:
            what = f"its {self._size} bytes unfold to far more than files of this kind do"
            raise malformed(self._path, f"truncated, or made to exhaust memory: {what}")

    def take_gaussians(self, count: int, sh_degree: int) -> None:
        """Count whole rows of Gaussians, as they are once decoded."""
        self.take(4 * count * (11 + 3 * SH_COUNTS[sh_degree]))


# ---- .npy and .npz: plain numbers or texts, read without pickles and without belief in their headers ----


def write_npy(path: Path, array: Array, behind: bytes = b"") -> None:
    """Write an array of numbers, and what NumPy passes over `behind` it, whole or not at all.

    `np.save` hands the numbers to C's library, and where the disk takes all but the end nobody is told.
    """
    whole = np.asarray(array, order="C")
    header = np.lib.format.header_data_from_array_1_0(whole)
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        np.lib.format.write_array_header_1_0(file, header)
        file.write(whole.reshape(-1).view(np.uint8).data)
        file.write(behind)


def read_npy(path: Path) -> Array:
    """Return the array of numbers in a .npy file; InputError where it cannot be opened, else FormatError."""
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
    """`numpy.load` of at most `size` bytes of `file`; name: for messages; whole: its content in memory."""
    form = np.lib.format
    try:
        if form.read_magic(file) != (1, 0):  # as NumPy writes all but records of thousands of columns
            raise ValueError("version")
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # a header of Python 2, which NumPy mends with a warning
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


# ---- opening a file and JSON, with every way it can fail as one line for the user ----


def open_for_reading(path: Path) -> tuple[BinaryIO, int]:
    """Return an ordinary file opened in binary mode, and its size in bytes.

    Raises InputError for a path that does not exist, is a folder, a device or a pipe (which could block
    or never end), or may not be read.
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
    """A text that a file states: it may name what is here, and starts no request and expands no `~`."""


def is_plain_name(name: object) -> bool:
    """Return whether a name in a file is one of a file beside it: a path could lead out of its folder."""
    fits = isinstance(name, str) and 0 < len(name) < 256  # what file systems have room for
    return fits and name not in (".", "..") and not set(str(name)) & set("/\\:\0")


def read_file(path: Path, limit: int) -> bytes:
    """Return the content of a file of at most `limit` bytes. Raises InputError and FormatError."""
    file, size = open_for_reading(path)
    with file:
        if size > limit:
            raise malformed(path, f"{size} bytes, but a file of this kind never exceeds {limit}")
        return file.read(size)


def read_text(path: Path, limit: int = 64 * 1024 * 1024) -> str:
    """Return the text in a file of at most `limit` bytes. Raises InputError, and as `decode_text` does."""
    return decode_text(read_file(path, limit), path)


def decode_text(data: bytes, path: Path) -> str:
    r"""Return the text of a file of any maker, with "\n" at the ends of its lines.

    It is UTF-8, UTF-16 or UTF-32, with a byte order mark or without. What is none of these is read in the
    code page of Western Windows, which is a guess and reported as one; FormatError for what is no text.
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
    """Return a text in UTF-8, or else in the code page of Western Windows."""
    try:
        return data.decode()
    except UnicodeDecodeError:
        return data.decode("cp1252", "replace")


def decimal_comma(text: object) -> str:
    """Return what to say behind a complaint about a number that is written with a comma; "" for others."""
    return "; numbers need a decimal point, not a comma" if COMMA.search(str(text)) else ""


def read_json_file(path: Path, limit: int) -> Any:
    """Return the value in a JSON file of at most `limit` bytes. Raises InputError and FormatError."""
    data = read_file(path, limit)
    with _as_json(path):
        _check_values(data, path)
        text = decode_text(data, path)
        # an integer of 400 digits has no float, and half a character no window can show
        value = json.loads(text, parse_int=lambda digits: int(digits) if len(digits) < 20 else float(digits))
        if re.search(r"\\u[dD][89a-fA-F]", text):
            json.dumps(value, ensure_ascii=False).encode()
        return value


def decode_json(text: bytes, kind: type[T], path: Path) -> T:
    """Return the value of a JSON text, which has to fit the msgspec structure `kind`; FormatError."""
    with _as_json(path):
        _check_values(text, path)
        return msgspec.json.decode(text.decode(json.detect_encoding(text)), type=kind)


def other_entries(text: bytes, known: Collection[str], path: Path) -> str:
    """Return, for `report_losses`, which entries of a JSON object are none of `known`; FormatError."""
    entries = decode_json(text, dict[str, msgspec.Raw], path)
    return unread("entries", (quoted(name, 40) for name in entries if name not in known))


def _check_values(text: bytes, path: Path) -> None:
    """Count the values of a JSON text: a dictionary of three letters takes 240 bytes, a list 64."""
    Allowance(path, len(text)).take(40 * text.count(b",") + 240 * text.count(b"{") + 64 * text.count(b"["))


@contextmanager
def _as_json(path: Path) -> Iterator[None]:
    """Turn what bad syntax, endless nesting and digits, and unfitting values raise into FormatError."""
    try:
        yield
    except LangSplatError:
        raise
    except (RecursionError, ValueError) as error:
        raise malformed(path, f"not readable as JSON ({printable_line(error, 100)})") from None


# ---- zip archives, without belief in their directories ----
#
# `zipfile` lets through what its decompressors and its own parsing meet in damaged archives (LZMAError,
# IndexError, struct.error, NotImplementedError, zlib.error ...), so every exception here means an unreadable
# archive. Only stored and deflated members are unpacked: no format that is read here uses other methods.


MOST_DIRECTORY = 4 << 20  # bytes, in 40 000 names; zipfile makes objects of ten times the size


class Archive:
    """The members of an open archive."""

    def __init__(self, archive: zipfile.ZipFile, path: Path, size: int, free: int) -> None:
        self._archive, self.path, self.size = archive, path, size  # size of the file, bytes
        self.names = archive.namelist()
        self.deflated = any(info.compress_type for info in archive.infolist())  # some, or packed otherwise
        self._room = Allowance(path, size, free=free)

    def read(self, name: str, limit: int) -> bytes:
        """Return the content of a member.

        FormatError where there is none, or where it unfolds to more than `limit` bytes or all that are read
        together to more than the archive has room for, which is noticed before more are held.
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
    """Open an archive; `kind`: for messages, `free`: as of `read_npz`; InputError, inside FormatError."""
    file, size = open_for_reading(path)
    with file:
        try:
            _check_directory(file, size)
            with zipfile.ZipFile(file) as archive:
                yield Archive(archive, path, size, free)
        except LangSplatError:
            raise
        except Exception as error:  # noqa: BLE001  any at all, see the top of this file
            what = str(error)[:80] or type(error).__name__
            raise malformed(path, f"not a readable {kind} ({what})") from None


def _check_directory(file: BinaryIO, size: int) -> None:
    """Raise ValueError for a directory of so many members that their objects would fill the memory."""
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


# ---- images: the one place of the project that hands a file to Pillow ----
#
# The kind is told by the content, and only the kinds below are tried: others (EPS, WMF, FITS ...) make
# Pillow start other programs or allocate what a header of a few bytes asks for. The size that the header
# declares is judged before a pixel is decoded. Pillow lets through whatever its decoders meet in damaged
# data (IndexError, AssertionError, TypeError, NotImplementedError ...), so here every exception means an
# unreadable image, and what it says of damaged metadata is silenced: an image is either read or refused.

warnings.filterwarnings("ignore", module=r"PIL\.")
logging.getLogger("PIL").setLevel(logging.CRITICAL)

KINDS = ("JPEG", "PNG", "WEBP", "TIFF", "BMP")  # always; AVIF where Pillow has a codec, HEIF with pillow_heif
# HEIF is named where it cannot be read, too: the message then says why such photographs are left out
PHOTO_SUFFIXES = (".jpg", ".jpeg", ".png", ".webp", ".tif", ".tiff", ".bmp", ".avif", ".heic", ".heif")
VIDEO_SUFFIXES = (".mp4", ".mov", ".m4v", ".mkv", ".webm", ".avi")
HEIF_BRANDS = (b"heic", b"heix", b"mif1", b"hevc", b"heim", b"heis")
MOST_PIXELS = 178_000_000  # of any image: 0.7 GB once decoded. The largest cameras make 151 million
MOST_PIXELS_REDUCED = 268_000_000  # of photographs, which are halved as they are read; some phones make 200
Image.MAX_IMAGE_PIXELS = MOST_PIXELS_REDUCED  # of which Pillow allows twice as many
# Declared pixels beyond these need a file of a fitting size: photographs keep 2 to 100 pixels a byte, what is
# made to exhaust memory a million. The decoders of WebP and AVIF hold two more copies of the image.
FREE_PIXELS, FREE_PIXELS_COPIED, PIXELS_PER_BYTE = 16_000_000, 8_000_000, 128
# What these say is wrong with the file; what others say, such as IndexError, with Pillow's handling of it
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
    """Open the image in a file or in bytes, not decoded yet; inside the block it may be.

    `name` is for messages, by default the path. Raises PictureError for what cannot be opened, is of none of
    the `kinds` (default: all that are read) or declares more than `most` pixels, and for whatever Pillow
    raises inside the block.
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
            # Image.open looks at the first bytes only to choose the kind; the name's ending plays no part
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
        except Exception as error:  # noqa: BLE001  any at all, see the top of this file
            text = printable_line(error, 80)
            telling = text and isinstance(error, TELLING)
            reason = text if telling else f"damaged: {text or type(error).__name__}"
            raise PictureError(name, reason) from None


def is_video(path: Path) -> bool:
    """Return whether a file's name ends as a video's."""
    return path.suffix.lower() in VIDEO_SUFFIXES and not path.is_dir()


def _lacks_heif(file: BinaryIO) -> bool:
    """Register the codec of HEIF for a file of that kind; True where there is none."""
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
