"""Opening a file for reading, with every way it can fail as one line for the user."""

import stat
from pathlib import Path
from typing import BinaryIO

from langsplat_core.errors import InputError


def open_for_reading(path: Path) -> tuple[BinaryIO, int]:
    """An ordinary file opened in binary mode, and its size in bytes.

    Raises InputError for a path that does not exist, is a folder, a device or a pipe (which could block
    or never end), or may not be read.
    """
    try:
        status = path.stat()
        if stat.S_ISDIR(status.st_mode):
            raise InputError(f"{path}: is a folder; name a file in it")
        if not stat.S_ISREG(status.st_mode):
            raise InputError(f"{path}: is not an ordinary file")
        return path.open("rb"), status.st_size
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; check the spelling and the folder") from None
    except PermissionError:
        raise InputError(f"{path}: may not be read; change its permissions") from None
    except (OSError, ValueError) as error:  # ValueError: a NUL in the name
        raise InputError(f"{path}: cannot be opened ({error})") from None


def read_small_file(path: Path, limit: int) -> bytes:
    """The whole of a file that must not exceed `limit` bytes (text and JSON never come near it)."""
    file, size = open_for_reading(path)
    with file:
        if size > limit:
            raise InputError(f"{path}: {size} bytes; a file of this kind never exceeds {limit}")
        return file.read(limit)
