"""Damage below a wrapping that would notice it: members of archives, gzip streams, chunks of PNG."""

import gzip
import io
import struct
import zipfile
import zlib
from collections.abc import Sequence

import numpy as np

from tests.support.mutants import Wound, mutant

CHUNKS = (*(b"IHDR", b"PLTE", b"tRNS", b"iCCP", b"tEXt"), *(b"zTXt", b"iTXt", b"eXIf", b"acTL", b"fcTL"))


def _half(inner: Wound) -> Wound:
    return lambda data, others, rng: (inner if rng.random() < 0.6 else mutant)(data, others, rng)


@_half
def in_zip(data: bytes, others: Sequence[bytes], rng: np.random.Generator) -> bytes:
    """One member is damaged, missing, or packed by another method; the checksums are right."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    name = str(rng.choice(list(members)))
    same = [member for member in members.values() if len(member) > 100]
    buffer = io.BytesIO()
    methods = [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA]
    method = methods[int(rng.choice([0, 0, 1, 1, 1, 1, 1, 2, 3]))]
    with zipfile.ZipFile(buffer, "w", method) as archive:
        for other, content in members.items():
            if other == name:
                content = (
                    in_png(content, same, rng) if content[:4] == b"\x89PNG" else mutant(content, same, rng)
                )
            archive.writestr(other, content)
    packed = buffer.getvalue()
    return mutant(packed, others, rng) if rng.random() < 0.2 else packed


@_half
def in_gzip(data: bytes, others: Sequence[bytes], rng: np.random.Generator) -> bytes:
    if data[:2] != b"\x1f\x8b":
        return mutant(data, others, rng)
    plain = [gzip.decompress(other) for other in others if other[:2] == b"\x1f\x8b"]
    return gzip.compress(mutant(gzip.decompress(data), plain, rng), 1)


def _unfolded(content: bytes) -> bytes:
    try:
        return zlib.decompress(content)
    except zlib.error:  # damaged already
        return content


@_half
def in_png(data: bytes, others: Sequence[bytes], rng: np.random.Generator) -> bytes:
    """Chunks whose content, order or number is damaged, with right lengths and checksums."""
    chunks, place = [], 8
    while place + 8 <= len(data):
        (length,) = struct.unpack(">I", data[place : place + 4])
        chunks.append((data[place + 4 : place + 8], data[place + 8 : place + 8 + length]))
        place += 12 + length
    for _ in range(int(rng.integers(1, 3))):
        index = int(rng.integers(len(chunks)))
        name, content = chunks[index]
        match int(rng.integers(6)):
            case 0:
                chunks.insert(int(rng.integers(len(chunks) + 1)), chunks[index])
            case 1 if len(chunks) > 1:
                del chunks[index]
            case 2:
                chunks[index] = (CHUNKS[int(rng.integers(len(CHUNKS)))], content)
            case 3 if name == b"IDAT":
                chunks[index] = (name, zlib.compress(mutant(_unfolded(content), [], rng)))
            case _:
                chunks[index] = (name, mutant(content, [], rng))
    body = b"".join(
        struct.pack(">I", len(content)) + name + content + struct.pack(">I", zlib.crc32(name + content))
        for name, content in chunks
    )
    return data[:8] + body
