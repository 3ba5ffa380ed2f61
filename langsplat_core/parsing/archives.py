"""Zip archives without belief in their directories.

`zipfile` lets through what its decompressors and its own parsing meet in damaged archives (LZMAError,
IndexError, struct.error, NotImplementedError, zlib.error ...), so every exception here means an unreadable
archive. Only stored and deflated members are unpacked: no format that is read here uses other methods.
"""

import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from langsplat_core.errors import FormatError, LangSplatError, quoted
from langsplat_core.parsing.opening import open_for_reading

METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)


class Archive:
    """The members of an open archive."""

    def __init__(self, archive: zipfile.ZipFile, path: Path, size: int) -> None:
        self._archive, self.path, self.size = archive, path, size  # size of the file, bytes

    @property
    def names(self) -> list[str]:
        """Of all members, in the directory's order."""
        return self._archive.namelist()

    def read(self, name: str, limit: int) -> bytes:
        """The content of a member; FormatError where there is none, or where it unfolds to more than `limit`
        bytes, which is noticed before more are held."""
        try:
            info = self._archive.getinfo(name)
        except KeyError:
            raise FormatError(f"{self.path}: has no {quoted(name, 60)} inside") from None
        if info.compress_type not in METHODS:
            raise FormatError(
                f"{self.path}: {quoted(name, 60)} inside is packed by method {info.compress_type}; "
                "pack the archive again with deflate"
            )
        with self._archive.open(info) as member:
            content = member.read(limit + 1)
        if len(content) > limit:
            raise FormatError(f"{self.path}: {quoted(name, 60)} inside has more than {limit} bytes")
        return content


@contextmanager
def opened_archive(path: Path, kind: str) -> Iterator[Archive]:
    """The archive in a file; `kind` is for messages ("SOG archive"). Raises InputError where the file cannot
    be opened, and FormatError for whatever zipfile raises inside the block."""
    file, size = open_for_reading(path)
    with file:
        try:
            with zipfile.ZipFile(file) as archive:
                yield Archive(archive, path, size)
        except LangSplatError:
            raise
        except Exception as error:  # noqa: BLE001  any at all, see the top of this file
            what = str(error)[:80] or type(error).__name__
            raise FormatError(f"{path}: not a readable {kind} ({what})") from None
