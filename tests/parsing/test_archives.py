"""Archives that lie or use what nobody needs: one error each."""

import io
import zipfile
from pathlib import Path

import numpy as np
import pytest

from langsplat_core.errors import FormatError
from langsplat_core.io.hostile import opened_archive, read_npz


def packed(method: int, name: str = "a", content: bytes = b"content" * 100) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", method) as archive:
        archive.writestr(name, content)
    return buffer.getvalue()


def read(folder: Path, data: bytes, name: str = "a", limit: int = 10_000) -> bytes:
    (folder / "made.zip").write_bytes(data)
    with opened_archive(folder / "made.zip", "archive") as archive:
        return archive.read(name, limit)


@pytest.mark.parametrize("method", [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED])
def test_members_are_read(tmp_path: Path, method: int) -> None:
    assert read(tmp_path, packed(method)) == b"content" * 100


@pytest.mark.parametrize("method", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_other_methods_are_refused_before_they_run(tmp_path: Path, method: int) -> None:
    with pytest.raises(FormatError, match=f"packed by method {method}; pack the archive again with deflate"):
        read(tmp_path, packed(method))


def test_what_unfolds_beyond_the_limit_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="has more than 699 bytes"):
        read(tmp_path, packed(zipfile.ZIP_DEFLATED), limit=699)
    assert len(read(tmp_path, packed(zipfile.ZIP_DEFLATED), limit=700)) == 700


def test_every_changed_byte_is_one_error_or_none(tmp_path: Path) -> None:
    """zipfile raises IndexError, struct.error, zlib.error, NotImplementedError ... over these."""
    good, messages = packed(zipfile.ZIP_DEFLATED), []
    for place in range(len(good)):
        for value in (0, 255, good[place] ^ 1):
            try:
                read(tmp_path, good[:place] + bytes([value]) + good[place + 1 :])
            except FormatError as error:
                messages.append(str(error))
    assert len(messages) > len(good)
    assert all(message.isprintable() for message in messages)


def test_an_array_of_text_that_is_none(tmp_path: Path) -> None:
    np.savez(tmp_path / "good.npz", key=np.array("abc"))
    assert str(read_npz(tmp_path / "good.npz")["key"]) == "abc"
    buffer = io.BytesIO()
    np.save(buffer, np.array("abc"))
    for bad in (b"\xff\xff\xff\x7f", b"\x00\xd8\x00\x00"):
        content = buffer.getvalue()[:-4] + bad
        (tmp_path / "bad.npz").write_bytes(packed(zipfile.ZIP_DEFLATED, "key.npy", content))
        with pytest.raises(FormatError, match="not Unicode"):
            read_npz(tmp_path / "bad.npz")
