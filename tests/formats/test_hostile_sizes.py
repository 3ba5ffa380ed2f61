"""Files made to exhaust memory: what they claim or unfold to is refused before it is held."""

import gzip
import io
import json
import struct
import zipfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import zstandard
from PIL import Image

from langsplat_core.errors import FormatError
from langsplat_core.io import (
    load_gaussians,
    read_cameras,
    read_ksplat,
    read_language,
    read_ply,
    read_sog,
    read_spz_scene,
    write_language,
)
from tests.support.file_samples import (
    plain_ply,
    random_field,
    sog_files,
    write_folder,
)
from tests.support.scenes import random_gaussians
from tests.support.splat_samples import ksplat_bytes, spz_bytes

SCENE = random_gaussians(20, sh_degree=1)


def black_webp(width: int, height: int) -> bytes:
    buffer = io.BytesIO()
    Image.new("RGBA", (width, height), (0, 0, 0, 255)).save(buffer, "WEBP", lossless=True, method=0)
    return buffer.getvalue()


def webp_that_claims(width: int, height: int) -> bytes:
    """A lossless WebP whose header gives another size; the pixels behind it are those of a small one."""
    data = bytearray(black_webp(4, 4))
    at = data.index(b"VP8L") + 9  # 4-byte name, 4-byte length, signature; then two 14-bit sizes less one
    flags = struct.unpack("<I", data[at : at + 4])[0] & ~((1 << 28) - 1)
    data[at : at + 4] = struct.pack("<I", flags | (width - 1) | (height - 1) << 14)
    return bytes(data)


@pytest.mark.parametrize("width", [200, 16384])
@pytest.mark.parametrize("name", ["means_l.webp", "quats.webp", "shN_centroids.webp", "shN_labels.webp"])
def test_images_that_unfold_to_gigabytes(tmp_path, bounded, name, width):
    files = sog_files(SCENE)
    files[name] = webp_that_claims(width, 16384)
    with pytest.raises(FormatError, match=name):
        read_sog(write_folder(tmp_path / "a", files))


def test_a_count_that_the_images_would_have_to_be_bombs_for(tmp_path, bounded):
    files = sog_files(SCENE)
    meta = json.loads(files["meta.json"])
    meta["count"] = 16384 * 16384
    for name in list(files):
        files[name] = webp_that_claims(16384, 16384)
    files["meta.json"] = json.dumps(meta).encode()
    with pytest.raises(FormatError, match="too few for 268435456 Gaussians"):
        read_sog(write_folder(tmp_path / "a", files))


@pytest.mark.long
def test_an_archive_that_unfolds_to_gigabytes(tmp_path, bounded):
    files = sog_files(SCENE)
    path = tmp_path / "a.sog"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files.items():
            if name != "quats.webp":
                archive.writestr(name, content)
        with archive.open("quats.webp", "w") as member:
            for _ in range(300):
                member.write(bytes(1 << 20))
    assert path.stat().st_size < 1 << 20
    with pytest.raises(FormatError, match=r"'quats\.webp' inside has more than"):
        read_sog(path)


def test_a_meta_of_gigabytes(tmp_path, bounded):
    files = sog_files(SCENE)
    folder = write_folder(tmp_path / "a", files)
    with (folder / "meta.json").open("wb") as file:
        file.truncate(3 << 30)  # a hole: takes no room on the disk
    with pytest.raises(FormatError, match=r"meta\.json: 3221225472 bytes; expected at most"):
        read_sog(folder)
    with pytest.raises(FormatError, match="never exceeds"):
        read_cameras(folder / "meta.json")


def zeros(size: int) -> Iterator[bytes]:
    for _ in range(size >> 20):
        yield bytes(1 << 20)


@pytest.mark.long
def test_spz_streams_that_unfold_to_gigabytes(tmp_path, bounded):
    """Zeros are legal Gaussians, and compress a thousand times or more."""
    path = tmp_path / "a.spz"
    count = (128 << 20) // 20
    for claimed, message in ((count, "the file can hold"), (5, "too many bytes behind")):
        with gzip.open(path, "wb", compresslevel=1) as file:
            file.write(b"NGSP" + struct.pack("<IIBBBB", 3, claimed, 0, 12, 0, 0))
            for part in zeros(129 << 20):
                file.write(part)
        assert path.stat().st_size < 1 << 20
        with pytest.raises(FormatError, match=message):
            read_spz_scene(path)


def spz_4_of_zeros(count: int, claimed: int, path: Path) -> None:
    """Streams for `count` Gaussians in a file that says `claimed`."""
    frames, sizes = [], [9, 1, 3, 3, 4]
    for width in sizes:
        packer = zstandard.ZstdCompressor().compressobj()  # without the size in its header
        frames.append(
            b"".join(packer.compress(part) for part in zeros(count * width + 1048575)) + packer.flush()
        )
    table = [struct.pack("<QQ", len(f), claimed * w) for f, w in zip(frames, sizes, strict=True)]
    header = b"NGSP" + struct.pack("<IIBBBBI12x", 4, claimed, 0, 12, 0, 5, 32)
    path.write_bytes(header + b"".join(table) + b"".join(frames))


def test_spz_4_streams_that_unfold_to_gigabytes(tmp_path, bounded):
    path = tmp_path / "a.spz"
    for claimed, message in ((1 << 23, "cannot be in a file of"), (5, "fewer or more than the 45 bytes")):
        spz_4_of_zeros(1 << 23, claimed, path)
        assert path.stat().st_size < 1 << 20
        with pytest.raises(FormatError, match=message):
            read_spz_scene(path)
    frame = zstandard.ZstdCompressor().compress(bytes(100))
    frame = frame[:4] + bytes([0xE0]) + struct.pack("<Q", 10**12) + frame[6:]  # of a size of 10^12
    content = spz_bytes(random_gaussians(5), 4)
    old = struct.unpack_from("<Q", content, 32)[0]
    start = 32 + 5 * 16
    path.write_bytes(
        content[:32] + struct.pack("<Q", len(frame)) + content[40:start] + frame + content[start + old :]
    )
    with pytest.raises(FormatError, match=r"cannot be unpacked|fewer or more"):
        read_spz_scene(path)


@pytest.mark.parametrize("at", [4, 16, 4096, 4100, 4108, 4132])
@pytest.mark.parametrize("count", [10**6, 2**31, 2**32 - 1])
def test_ksplat_counts_of_what_is_not_there(tmp_path, bounded, at, count):
    content = bytearray(ksplat_bytes([SCENE], 1))
    struct.pack_into("<I", content, at, count)
    (tmp_path / "a.ksplat").write_bytes(content)
    with pytest.raises(FormatError):
        read_ksplat(tmp_path / "a.ksplat")


@pytest.mark.parametrize("name", ["a.ksplat", "a.spz"])
def test_files_of_a_terabyte_of_nothing(tmp_path, bounded, name):
    with (tmp_path / name).open("wb") as file:
        file.truncate(10**12)  # a hole: takes no room on the disk
    with pytest.raises(FormatError):
        load_gaussians(tmp_path / name)


def ply_with(line: str, body: bytes = b"") -> bytes:
    sample = plain_ply(SCENE)
    old = f"element vertex {len(SCENE)}".encode()
    assert old in sample
    return sample.replace(old, line.encode()) + body


@pytest.mark.parametrize("count", [21, 10**6, 10**12, 2**63, 2**64 - 1, 10**19])
def test_vertices_that_are_not_there(tmp_path, bounded, count):
    (tmp_path / "a.ply").write_bytes(ply_with(f"element vertex {count}"))
    with pytest.raises(FormatError, match=f"truncated: {count} rows of element vertex"):
        read_ply(tmp_path / "a.ply")


@pytest.mark.parametrize(
    "front", ["element nothing 1000000000000", "element face 9000\nproperty list uchar int i"]
)
def test_elements_in_front_that_cost_nothing_or_everything(tmp_path, bounded, front):
    """An element without properties takes no bytes, however many rows it has; empty lists take one each."""
    content = ply_with(f"{front}\nelement vertex {len(SCENE)}")
    (tmp_path / "a.ply").write_bytes(content)
    if "nothing" in front:
        assert len(read_ply(tmp_path / "a.ply")) == len(SCENE)
    else:
        with pytest.raises(FormatError, match="truncated"):
            read_ply(tmp_path / "a.ply")


def test_a_header_of_many_properties(tmp_path, bounded):
    lines = "".join(f"property char a{i}\n" for i in range(3000))
    content = plain_ply(SCENE).replace(b"property float x\n", lines.encode() + b"property float x\n")
    (tmp_path / "a.ply").write_bytes(content)
    with pytest.raises(FormatError, match="truncated"):
        read_ply(tmp_path / "a.ply")


@pytest.mark.parametrize("length", [2**63 - 1, 2**40, 100_000_001])
def test_a_sidecar_whose_header_claims_gigabytes(tmp_path, bounded, length):
    path = tmp_path / "a.langsplat.safetensors"
    path.write_bytes(struct.pack("<Q", length) + b"{" * 100)
    with pytest.raises(FormatError, match="not a whole safetensors file"):
        read_language(path, SCENE.means)


def test_a_sidecar_with_weights_that_do_not_fit_each_other(tmp_path, bounded):
    """Shapes are checked before any product is formed: nothing is broadcast, nothing blows up."""
    field = random_field(20)
    path = tmp_path / "a.langsplat.safetensors"
    write_language(path, field, SCENE.means)
    raw = path.read_bytes()
    size = struct.unpack("<Q", raw[:8])[0]
    header = json.loads(raw[8 : 8 + size])

    def attempt(name: str, shape: list[int]) -> None:
        changed = json.dumps(header | {name: header[name] | {"shape": shape}}).encode()
        path.write_bytes(struct.pack("<Q", len(changed)) + changed + raw[8 + size :])
        with pytest.raises(FormatError):
            read_language(path, SCENE.means)

    for name, entry in header.items():
        if name == "__metadata__":
            continue
        count = int(np.prod(entry["shape"]))
        for shape in ([count], [1, count], [count, 1], [1, 1, count], [count, 1, 1], []):
            if shape != entry["shape"]:
                attempt(name, shape)
