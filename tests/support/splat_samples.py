"""Encoders of .splat, .ksplat and .spz for tests: one Gaussian at a time, from the published layouts, apart
from the readers and writers, so that both would have to be wrong in the same way for a test to miss it."""

import gzip
import math
import struct

import numpy as np
import zstandard

from langsplat_core.arrays import Array
from langsplat_core.raster.reference import basis
from langsplat_core.scene import Gaussians
from tests.support.file_samples import C0

HALF_TURN = np.diag([1.0, -1.0, -1.0])  # right down front <-> right up back


def _byte(value: float) -> int:
    return max(0, min(255, math.floor(value + 0.5)))


def _opacity(g: Gaussians, i: int) -> int:
    return _byte(255 / (1 + math.exp(-float(g.opacity_logits[i]))))


def _rgba(g: Gaussians, i: int) -> bytes:
    return bytes([*(_byte(255 * (0.5 + C0 * float(c))) for c in g.sh[i, 0]), _opacity(g, i)])


def _quaternion(g: Gaussians, i: int) -> Array:
    """w x y z of length 1."""
    return g.quats_wxyz[i].astype(float) / np.linalg.norm(g.quats_wxyz[i].astype(float))


def splat_bytes(g: Gaussians) -> bytes:
    out = b""
    for i in range(len(g)):
        out += struct.pack("<3f", *g.means[i]) + struct.pack("<3f", *np.exp(g.log_scales[i])) + _rgba(g, i)
        out += bytes(_byte(128 + 128 * q) for q in _quaternion(g, i))
    return out


def ksplat_bytes(parts: list[Gaussians], level: int, bucket: int = 8, sh_range: float = 1.5) -> bytes:
    """One section per part: as many full buckets of `bucket` rows as go, less one, then one of 3, one of the
    rest. The last section has two places more than Gaussians."""
    headers, bodies = b"", b""
    for part in parts:
        spare = 2 if part is parts[-1] else 0
        full = max(len(part) // bucket - 1, 0) if level else 0
        sizes = [3, len(part) - full * bucket - 3] if level else []
        ends = [bucket * (i + 1) for i in range(full)] + [full * bucket + 3, len(part)]
        starts = [0, *ends[:-1]]
        centres, bucket_of = [], []
        for number, (start, end) in enumerate(zip(starts, ends, strict=True)):
            centres.append((part.means[start:end].min(0) + part.means[start:end].max(0)) / 2)
            bucket_of += [number] * (end - start)
        side = 5.0
        body = struct.pack(f"<{len(sizes)}I", *sizes)
        if level:
            body += np.array(centres, "<f4").tobytes()
        for i in range(len(part)):
            floats = "<{}f" if level == 0 else "<{}e"
            if level == 0:
                body += struct.pack("<3f", *part.means[i])
            else:
                offset = (part.means[i] - np.float32(centres[bucket_of[i]])) / (side / 2)
                body += struct.pack("<3H", *(round(32767 + 32767 * float(x)) for x in offset))
            body += struct.pack(floats.format(3), *np.exp(part.log_scales[i]))
            body += struct.pack(floats.format(4), *_quaternion(part, i)) + _rgba(part, i)
            rest = [
                float(part.sh[i, k, channel])
                for degree in range(1, part.sh_degree + 1)
                for channel in range(3)
                for k in range(degree**2, (degree + 1) ** 2)
            ]
            if level == 2:
                body += bytes(_byte((c + sh_range) / (2 * sh_range) * 255) for c in rest)
            else:
                body += struct.pack(floats.format(len(rest)), *rest)
        record = (len(body) - (4 * len(sizes) + 12 * len(centres) if level else 0)) // len(part)
        bodies += body + bytes(spare * record)
        header = struct.pack(
            "<IIIIf", len(part), len(part) + spare, bucket, len(centres) if level else 0, side
        )
        header += struct.pack("<HxxI", 12 if level else 0, 32767 if level else 0)
        header += struct.pack("<IIIH", 0, full, len(sizes), part.sh_degree)
        headers += header.ljust(1024, b"\0")
    total = sum(map(len, parts))
    main = struct.pack("<BBxxIIIIHxx", 0, 1, len(parts), len(parts), total, total, level)
    main += struct.pack("<3fff", 0, 0, 0, -sh_range, sh_range)
    return main.ljust(4096, b"\0") + headers + bodies


def turned_coefficients(sh: Array, turn: Array) -> Array:
    """(N, K, 3) coefficients of the same colours after the world was multiplied by `turn` (3, 3), found by
    least squares over directions instead of from symmetries."""
    directions = np.random.default_rng(0).normal(size=(400, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    count = sh.shape[1]
    matrix = np.linalg.lstsq(basis(directions @ turn.T, count), basis(directions, count), rcond=None)[0]
    return np.einsum("kj,njc->nkc", matrix, sh.astype(float))


def _smallest_three(xyzw: Array) -> bytes:
    largest = int(np.argmax(np.abs(xyzw)))
    xyzw = xyzw * (1 if xyzw[largest] > 0 else -1)
    word = largest
    for i in range(4):
        if i != largest:
            word = word << 10 | (xyzw[i] < 0) << 9 | min(511, round(abs(xyzw[i]) * 2**0.5 * 511))
    return struct.pack("<I", word)


def spz_blocks(g: Gaussians, version: int, bits: int = 12, turn: Array = HALF_TURN) -> list[bytes]:
    """The attributes in the order of the file, unzipped."""
    blocks: list[list[bytes]] = [[], [], [], [], [], []]
    sh = turned_coefficients(g.sh, turn)
    for i in range(len(g)):
        mean = turn @ g.means[i]
        if version == 1:
            blocks[0].append(struct.pack("<3e", *mean))
        else:
            codes = (round(float(x) * 2**bits) for x in mean)
            blocks[0].append(b"".join(code.to_bytes(3, "little", signed=True) for code in codes))
        blocks[1].append(bytes([_opacity(g, i)]))
        blocks[2].append(bytes(_byte(255 * (0.5 + 0.15 * float(c))) for c in g.sh[i, 0]))
        blocks[3].append(bytes(_byte(16 * (float(s) + 10)) for s in g.log_scales[i]))
        w, x, y, z = _quaternion(g, i)
        x, y, z = np.linalg.det(turn) * turn @ [x, y, z]  # the axis of a rotation is a pseudovector
        if version < 3:
            sign = 1 if w >= 0 else -1
            blocks[4].append(bytes(_byte(127.5 + 127.5 * sign * float(q)) for q in (x, y, z)))
        else:
            blocks[4].append(_smallest_three(np.array([x, y, z, w])))
        blocks[5].append(bytes(_byte(128 + 128 * c) for c in sh[i, 1:].ravel()))
    return [b"".join(block) for block in blocks]


def spz_bytes(
    g: Gaussians,
    version: int = 3,
    *,
    flags: int = 0,
    records: bytes = b"",
    bits: int = 12,
    turn: Array = HALF_TURN,
) -> bytes:
    """A whole file; `records` are extensions, which need the flag 2."""
    blocks = spz_blocks(g, version, bits, turn)
    head = b"NGSP" + struct.pack("<IIBBB", version, len(g), g.sh_degree, bits, flags)
    if version < 4:
        return gzip.compress(head + b"\0" + b"".join(blocks) + records)
    blocks = [block for block in blocks if block]
    frames = [zstandard.ZstdCompressor(level=3).compress(block) for block in blocks]
    head += bytes([len(blocks)]) + struct.pack("<I12x", 32 + len(records)) + records
    sizes = [struct.pack("<QQ", len(frame), len(block)) for frame, block in zip(frames, blocks, strict=True)]
    return head + b"".join(sizes) + b"".join(frames)
