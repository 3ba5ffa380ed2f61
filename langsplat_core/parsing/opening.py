"""Opening a file for reading, with every way it can fail as one line for the user."""

import json
import stat
from pathlib import Path
from typing import Any, BinaryIO

from langsplat_core.errors import FormatError, InputError


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


def exists(path: Path) -> bool:
    """`Path.exists`, where a name too long or a folder that may not be searched means no."""
    try:
        return path.exists()
    except OSError:
        return False


def read_json_file(path: Path, limit: int) -> Any:
    """The value in a JSON file of at most `limit` bytes. Raises InputError and FormatError."""
    file, size = open_for_reading(path)
    with file:
        if size > limit:
            raise FormatError(f"{path}: {size} bytes; a file of this kind never exceeds {limit}")
        return parse_json(file.read(size), path)


def parse_json(text: bytes, path: Path) -> Any:
    """`json.loads` with its failures as FormatError: bad syntax, bad UTF-8, endless nesting or digits."""
    try:
        return json.loads(text)
    except RecursionError:
        raise FormatError(f"{path}: not readable as JSON (nested too deeply)") from None
    except ValueError as error:
        raise FormatError(f"{path}: not readable as JSON ({str(error)[:80]})") from None
