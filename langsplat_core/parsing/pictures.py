"""Opening picture files: the one place of the project that hands a file to Pillow.

The kind is told by the content, and only the kinds below are tried: others (EPS, WMF, FITS ...) make Pillow
start other programs or allocate what a header of a few bytes asks for. The size that the header declares is
judged before a pixel is decoded. Pillow lets through whatever its decoders meet in damaged data (IndexError,
AssertionError, TypeError, NotImplementedError ...), so here every exception means an unreadable picture, and
its warnings about damaged metadata are silenced: a picture is either read or refused.
"""

import ctypes
import io
import logging
import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from PIL import Image, _imaging, features

from langsplat_core.errors import FormatError, InputError, LangSplatError, printable_line
from langsplat_core.parsing.opening import open_for_reading

KINDS = ("JPEG", "PNG", "WEBP", "TIFF", "BMP")  # always; AVIF and HEIF where Pillow has a codec
# HEIF is named where it cannot be read, too: the message then says why such photographs are left out
PHOTO_SUFFIXES = (
    *(".jpg", ".jpeg", ".png", ".webp", ".tif", ".tiff", ".bmp", ".avif"),
    *(".heic", ".heif"),
)
MOST_PIXELS = 178_000_000  # of any picture: 0.7 GB once decoded. The largest cameras make 151 million
# Declared pixels beyond these need a file of a fitting size: photographs keep 2 to 100 pixels a byte, what is
# made to exhaust memory a million. The decoders of WebP and AVIF hold two more copies of the picture.
FREE_PIXELS, FREE_PIXELS_COPIED, PIXELS_PER_BYTE = 16_000_000, 8_000_000, 128


class PictureError(FormatError):
    """A picture that cannot be read; `reason` is the message without the file's name."""

    def __init__(self, name: object, reason: str) -> None:
        self.reason = reason
        super().__init__(f"{name}: not a readable picture ({reason})")


@contextmanager
def opened(
    source: Path | bytes, name: str | None = None, kinds: tuple[str, ...] | None = None
) -> Iterator[Image.Image]:
    """The picture in a file or in bytes, not decoded yet; inside the block it may be.

    `name` is for messages, by default the path. Raises PictureError for what cannot be opened, is of none of
    the `kinds` (default: all that are read) or declares too many pixels, and for whatever Pillow raises
    inside the block.
    """
    name = name or (str(source) if isinstance(source, Path) else "a picture in memory")
    try:
        file, size = _file(source)
    except InputError as error:
        raise PictureError(name, str(error).removeprefix(f"{name}: ")) from None
    with file, _quiet:
        try:
            # Image.open looks at the first bytes only to choose the kind; the name's ending plays no part
            with Image.open(file, formats=kinds or readable_kinds()) as picture:
                _check_size(name, picture, size)
                yield picture
        except LangSplatError:
            raise
        except Image.UnidentifiedImageError:
            read = ", ".join(kinds or readable_kinds())
            raise PictureError(name, f"the content is none of {read}, or damaged") from None
        except Exception as error:  # noqa: BLE001  any at all, see the top of this file
            raise PictureError(name, _reason(error)) from None


def readable_kinds() -> tuple[str, ...]:
    """Pillow's names of the kinds that are read on this machine."""
    # pillow_heif, where somebody has registered it, adds HEIF
    return KINDS + ("AVIF",) * bool(features.check("avif")) + ("HEIF",) * ("HEIF" in Image.OPEN)


def picture_size(path: Path) -> tuple[int, int]:
    """(width, height) in pixels as the header declares them. Raises PictureError."""
    with opened(path) as picture:
        return picture.size


def _file(source: Path | bytes) -> tuple[BinaryIO, int]:
    if isinstance(source, bytes):
        return io.BytesIO(source), len(source)
    return open_for_reading(source)


def _check_size(name: str, picture: Image.Image, file_size: int) -> None:
    free = FREE_PIXELS_COPIED if picture.format in ("WEBP", "AVIF", "HEIF") else FREE_PIXELS
    most = min(MOST_PIXELS, free + PIXELS_PER_BYTE * file_size)
    if picture.width * picture.height > most:
        raise PictureError(
            name,
            f"declares {picture.width}x{picture.height} pixels; at most {most // 10**6} million are read "
            f"from a file of {file_size} bytes",
        )


def _reason(error: Exception) -> str:
    if isinstance(error, Image.DecompressionBombError):
        return f"declares more than {MOST_PIXELS // 10**6} million pixels"
    text = printable_line(error, 80)
    # these say what is wrong with the file; others, such as IndexError, with Pillow's handling of it
    telling = isinstance(error, OSError | SyntaxError | ValueError) and text
    return text if telling else f"damaged: {text or type(error).__name__}"


class _Quiet:
    """No Python warnings while any thread is inside.

    `warnings.catch_warnings` alone is not safe where threads overlap: the one that leaves last would restore
    what another had set.
    """

    def __init__(self) -> None:
        self._lock, self._inside = threading.Lock(), 0
        self._filters = warnings.catch_warnings()

    def __enter__(self) -> None:
        with self._lock:
            self._inside += 1
            if self._inside == 1:
                self._filters = warnings.catch_warnings()
                self._filters.__enter__()
                warnings.simplefilter("ignore")

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._inside -= 1
            if self._inside == 0:
                self._filters.__exit__(None, None, None)


_quiet = _Quiet()


def _silence() -> None:
    """Pillow's loggers and libtiff itself write to the standard error what they then raise as well."""
    logging.getLogger("PIL").setLevel(logging.CRITICAL)
    library = ctypes.CDLL(_imaging.__file__)  # the copy that Pillow is linked to
    for kind in ("Error", "Warning"):
        # absent where libtiff is linked in without names
        set_handler = getattr(library, f"TIFFSet{kind}Handler", None)
        if set_handler is not None:
            set_handler.argtypes, set_handler.restype = (ctypes.c_void_p,), ctypes.c_void_p
            set_handler(None)


_silence()
