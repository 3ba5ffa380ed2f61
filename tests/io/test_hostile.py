"""Files that are malformed, made to exhaust memory, or damaged at random."""

import gzip
import io
import json
import re
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import zstandard
from PIL import Image

from langsplat_core.config import DatasetConfig
from langsplat_core.datasets.nerfstudio import load_nerfstudio
from langsplat_core.io.cameras import read_cameras
from langsplat_core.io.gltf import COEFFICIENTS, EXTENSION
from langsplat_core.io.hostile import (
    MOST_PIXELS,
    PictureError,
    opened,
    opened_archive,
    picture_size,
    read_npy,
    read_npz,
)
from langsplat_core.io.ply import GREY, read_cloud
from langsplat_core.io.scenes import formats
from langsplat_core.io.spz import read_spz_scene
from langsplat_core.progress import silent
from tests.support.file_kinds import KINDS, STRICT, FileKind, few_and_many, tried
from tests.support.file_samples import (
    assert_refused,
    glb,
    load_gaussians,
    sog_files,
    spz_bytes,
    write_folder,
    zipped,
)
from tests.support.scenes import random_gaussians


def packed(path: Path, method: int, name: str = "a", content: bytes = b"content" * 100) -> Path:
    with zipfile.ZipFile(path, "w", method) as archive:
        archive.writestr(name, content)
    return path


def read(path: Path, limit: int = 10_000) -> bytes:
    with opened_archive(path, "archive") as archive:
        return archive.read("a", limit)


@pytest.mark.parametrize("method", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_other_methods_are_refused_before_they_run(tmp_path: Path, method: int) -> None:
    assert_refused(read, packed(tmp_path / "a.zip", method))


def test_members_larger_than_the_limit_are_refused(tmp_path: Path) -> None:
    path = packed(tmp_path / "a.zip", zipfile.ZIP_DEFLATED)
    assert_refused(lambda path: read(path, 699), path)
    assert len(read(path, 700)) == 700


def test_texts_that_are_not_unicode_are_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "good.npz", key=np.array("abc"))
    assert str(read_npz(tmp_path / "good.npz")["key"]) == "abc"
    buffer = io.BytesIO()
    np.save(buffer, np.array("abc"))
    for bad in (b"\xff\xff\xff\x7f", b"\x00\xd8\x00\x00"):
        content = buffer.getvalue()[:-4] + bad
        path = packed(tmp_path / "bad.npz", zipfile.ZIP_DEFLATED, "key.npy", content)
        assert_refused(read_npz, path)


# Point clouds: every type of coordinate and colour, and numbers beyond what either can hold.


def ascii_cloud(folder: Path, colour: str, *rows: str) -> Path:
    """Of double positions; `colour` is the type of the colours, none where it is empty."""
    channels = [f"property {colour} {name}" for name in ("red", "green", "blue")] if colour else []
    axes = [f"property double {axis}" for axis in "xyz"]
    header = ["ply", "format ascii 1.0", f"element vertex {len(rows)}", *axes, *channels, "end_header"]
    path = folder / "cloud.ply"
    path.write_text("\n".join([*header, *rows]) + "\n")
    return path


HUGE = f"1{'0' * 400}"  # an integer beyond any float


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    ("colour", "row", "point", "shade"),
    [
        ("uchar", "1 2 3 0 128 255", [1, 2, 3], [0, 128, 255]),
        ("float", "0 0 0 0 0.5 1", [0, 0, 0], [0, 128, 255]),
        ("", "4 5 6", [4, 5, 6], [GREY] * 3),
        ("int", "0 0 0 300 -5 7", [0, 0, 0], [255, 0, 7]),
        ("float", "0 0 0 1e308 0 0", [0, 0, 0], [255, 0, 0]),
        ("uchar", f"{HUGE} 0 nan {HUGE} 0 nan", [np.inf, 0, np.nan], [255, 0, 0]),
    ],
)
def test_colours_of_every_type_become_bytes(tmp_path, colour, row, point, shade) -> None:
    points, colours = read_cloud(ascii_cloud(tmp_path, colour, row))
    np.testing.assert_array_equal(points, [point])
    np.testing.assert_array_equal(colours, [shade])


def test_faces_behind_points_play_no_part(put: Callable[..., Path], caplog: pytest.LogCaptureFixture) -> None:
    """Of a mesh of scanners, whose lists of corners may be long, and here are cut."""
    header = "ply\nformat binary_little_endian 1.0\nelement vertex 1\n"
    header += "".join(f"property float {name}\n" for name in "xyz")
    header += "".join(f"property uchar {name}\n" for name in ("red", "green", "blue"))
    header += "element face 9\nproperty list uchar int corners\nend_header\n"
    points, _ = read_cloud(put(header.encode() + bytes(15) + b"\3\0"))
    np.testing.assert_array_equal(points, [[0, 0, 0]])
    assert not caplog.messages


# Headers of .npy files: what NumPy writes is read, anything else refused, whatever it looks like.


@pytest.mark.parametrize("shape", [(), (3,), (0,), (2, 3), (1, 2, 1, 2, 1, 2, 1, 2)])
def test_arrays_that_numpy_writes_are_read(tmp_path: Path, shape: tuple[int, ...]) -> None:
    array = np.arange(np.prod(shape, dtype=int), dtype=np.float32).reshape(shape)
    np.save(tmp_path / "a.npy", array)
    np.testing.assert_array_equal(read_npy(tmp_path / "a.npy"), array)


@pytest.mark.parametrize(
    "shape", ["9" * 400 + ",", "1, " * 400, "9" * 19 + ",", "1 1,", ",", "-1,", "-1, -1,", "(" * 200, "'a',"]
)
def test_arrays_of_other_shapes_are_refused(put: Callable[..., Path], bounded: None, shape: str) -> None:
    header = f"{{'descr': '<f4', 'fortran_order': False, 'shape': ({shape}), }}".encode()
    content = b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header + bytes(4)
    assert_refused(read_npy, put(content) if shape != "1, " * 400 else put(content + bytes(4)))


@pytest.mark.parametrize("dtype", ["O", "c8", "V4", "M8", "?", [("a", "f4")]])
def test_arrays_of_other_types_are_refused(put: Callable[..., Path], dtype: object) -> None:
    buffer = io.BytesIO()
    np.save(buffer, np.zeros(3, dtype), allow_pickle=True)
    assert_refused(read_npy, put(buffer.getvalue()))


# Pictures are opened by their content, in one place, within limits, and every failure is one error.

ROOT = Path(__file__).parents[2]


def saved(kind: str, size: tuple[int, int] = (20, 15), **options: object) -> bytes:
    pixels = np.random.default_rng(0).integers(0, 256, (size[1], size[0], 3), dtype=np.uint8)
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, kind, **options)
    return buffer.getvalue()


def png_that_claims(width: int, height: int) -> bytes:
    data = bytearray(saved("PNG"))
    data[16:24] = struct.pack(">II", width, height)
    data[29:33] = struct.pack(">I", zlib.crc32(data[12:29]))
    return bytes(data)


def test_one_place_alone_opens_images() -> None:
    folders = (ROOT / name for name in ("langsplat_core", "app", "packaging"))
    sources = [path for folder in folders for path in folder.rglob("*.py")]
    openers = [path for path in sources if re.search(r"\bImage\.open\(", path.read_text())]
    assert openers == [ROOT / "langsplat_core/io/hostile.py"]


@pytest.mark.parametrize("kind", ["EPS", "GIF", "PPM", "TGA", "ICO", "DDS", "PCX"])
def test_other_kinds_of_images_are_refused(tmp_path: Path, kind: str) -> None:
    (tmp_path / "a.png").write_bytes(saved(kind))
    with pytest.raises(PictureError, match="the content is none of"):
        picture_size(tmp_path / "a.png")


@pytest.mark.parametrize("size", [(12_000, 12_000), (1, 2**31 - 1), (5000, 5000), (40_000, 40_000)])
def test_a_declared_size_is_judged_before_decoding(size: tuple[int, int]) -> None:
    """Pillow's own limit would let the first and the third through: 430 and 75 MB out of a kilobyte."""
    with pytest.raises(PictureError), opened(png_that_claims(*size)):
        pass


def test_large_photographs_are_opened() -> None:
    """Judged by the size of the file: 100 megapixels of a real camera take at least a megabyte."""
    data = png_that_claims(12_000, 8_000)
    padding = b"\0" * 1_000_000
    with opened(data + padding) as picture:
        assert picture.size == (12_000, 8_000)
    assert MOST_PIXELS >= 151_000_000  # the largest sensor that is sold


@pytest.mark.parametrize(
    "error", [IndexError, AssertionError, TypeError, NotImplementedError, RuntimeError, MemoryError]
)
def test_any_exception_of_a_decoder_is_one_error(tmp_path: Path, error: type[Exception]) -> None:
    (tmp_path / "a.png").write_bytes(saved("PNG"))
    with pytest.raises(PictureError) as caught, opened(tmp_path / "a.png"):
        raise error("inside\nPillow")
    said = f"{tmp_path / 'a.png'}: not a readable picture (damaged: inside Pillow); "
    assert str(caught.value).startswith(said)
    assert caught.value.reason == "damaged: inside Pillow"


# Files made to exhaust memory: what they claim or unfold to is refused before it is held.

SCENE = random_gaussians(20, sh_degree=1)


def webp_that_claims(width: int, height: int) -> bytes:
    """A lossless WebP whose header gives another size; the pixels behind it are those of a small one."""
    data = bytearray(saved("WEBP", lossless=True))
    at = data.index(b"VP8L") + 9  # 4-byte name, 4-byte length, signature; then two 14-bit sizes less one
    flags = struct.unpack("<I", data[at : at + 4])[0] & ~((1 << 28) - 1)
    data[at : at + 4] = struct.pack("<I", flags | (width - 1) | (height - 1) << 14)
    return bytes(data)


@pytest.mark.parametrize("width", [200, 16384])
@pytest.mark.parametrize("name", ["means_l.webp", "quats.webp", "shN_centroids.webp", "shN_labels.webp"])
def test_images_that_unfold_to_gigabytes_are_refused(tmp_path, bounded, name, width):
    folder = write_folder(tmp_path / "a", sog_files(SCENE) | {name: webp_that_claims(width, 16384)})
    assert_refused(load_gaussians, folder)


@pytest.mark.long
def test_archives_that_unfold_to_gigabytes_are_refused(tmp_path, bounded):
    path = tmp_path / "a.sog"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in sog_files(SCENE).items():
            if name != "quats.webp":
                archive.writestr(name, content)
        with archive.open("quats.webp", "w") as member:
            for part in zeros(300 << 20):
                member.write(part)
    assert path.stat().st_size < 1 << 20
    assert_refused(load_gaussians, path)


def hole(path: Path, size: int) -> Path:
    """A file of zeros that takes no room on the disk."""
    with path.open("wb") as file:
        file.truncate(size)
    return path


def test_json_of_gigabytes_is_refused(tmp_path, bounded):
    folder = write_folder(tmp_path / "a", sog_files(SCENE))
    meta = hole(folder / "meta.json", 3 << 30)
    assert_refused(load_gaussians, folder)
    assert_refused(read_cameras, meta)


def zeros(size: int) -> Iterator[bytes]:
    return (bytes(1 << 20) for _ in range(size >> 20))


@pytest.mark.long
def test_gzip_streams_that_unfold_to_gigabytes_are_refused(tmp_path, bounded):
    """Zeros are legal Gaussians, and compress a thousand times or more."""
    path = tmp_path / "a.spz"
    count = (128 << 20) // 20
    for claimed in (count, 5):
        with gzip.open(path, "wb", compresslevel=1) as file:
            file.write(b"NGSP" + struct.pack("<IIBBBB", 3, claimed, 0, 12, 0, 0))
            for part in zeros(129 << 20):
                file.write(part)
        assert path.stat().st_size < 1 << 20
        assert_refused(read_spz_scene, path)


def spz_4_of_zeros(count: int, claimed: int, path: Path) -> None:
    """Streams for `count` Gaussians in a file that says `claimed`."""
    frames, sizes = [], [9, 1, 3, 3, 4]
    for width in sizes:
        packer = zstandard.ZstdCompressor().compressobj()  # without the size in its header
        frames.append(b"".join(map(packer.compress, zeros(count * width + 1048575))) + packer.flush())
    table = [struct.pack("<QQ", len(f), claimed * w) for f, w in zip(frames, sizes, strict=True)]
    header = b"NGSP" + struct.pack("<IIBBBBI12x", 4, claimed, 0, 12, 0, 5, 32)
    path.write_bytes(header + b"".join(table) + b"".join(frames))


def test_zstandard_frames_that_unfold_to_gigabytes_are_refused(tmp_path, bounded):
    path = tmp_path / "a.spz"
    for claimed in (1 << 23, 5):
        spz_4_of_zeros(1 << 23, claimed, path)
        assert path.stat().st_size < 1 << 20
        assert_refused(read_spz_scene, path)
    frame = zstandard.ZstdCompressor().compress(bytes(100))
    frame = frame[:4] + bytes([0xE0]) + struct.pack("<Q", 10**12) + frame[6:]  # of a size of 10^12
    content = spz_bytes(random_gaussians(5), 4)
    old, start = struct.unpack_from("<Q", content, 32)[0], 32 + 5 * 16
    size = struct.pack("<Q", len(frame))
    path.write_bytes(content[:32] + size + content[40:start] + frame + content[start + old :])
    assert_refused(read_spz_scene, path)


# Of every container one whose rows are just few enough to be read, and one that claims far more: each takes
# what is promised of memory, or less.


def flat_sog(count: int, side: int, degree: int = 0) -> bytes:
    """`count` equal Gaussians in images of side x side equal pixels, in two kilobytes."""
    files = sog_files(random_gaussians(20, sh_degree=degree))
    buffer = io.BytesIO()
    Image.new("RGBA", (side, side), (0, 0, 0, 255)).save(buffer, "WEBP", lossless=True)
    palette = {"shN_centroids.webp": files.get("shN_centroids.webp", b"")}
    meta = json.loads(files["meta.json"]) | {"count": count}
    plain = dict.fromkeys(files, buffer.getvalue())
    return zipped(plain | palette | {"meta.json": json.dumps(meta).encode()})


def flat_spz(count: int) -> bytes:
    return gzip.compress(b"NGSP" + struct.pack("<IIBBBB", 3, count, 0, 12, 0, 0) + bytes(20 * count), 1)


def flat_npz(size: int, members: int) -> bytes:
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **{f"a{k}": np.zeros(size, np.uint8) for k in range(members)})
    return buffer.getvalue()


def glb_of_one_row(count: int) -> bytes:
    """All columns of a primitive, and of others, are the same numbers."""
    names = [f"{EXTENSION}:{name}" for name in ("ROTATION", "SCALE", "OPACITY")] + COEFFICIENTS
    shapes = ["VEC3", "VEC4", "VEC3", "SCALAR"] + ["VEC3"] * len(COEFFICIENTS)
    primitive = {
        "attributes": {name: k for k, name in enumerate(["POSITION", *names])},
        "mode": 0,
        "extensions": {EXTENSION: {}},
    }
    about = {"bufferView": 0, "count": count, "componentType": 5126}
    content = {
        "asset": {"version": "2.0"},
        "accessors": [about | {"type": shape} for shape in shapes],
        "bufferViews": [{"buffer": 0, "byteLength": 16 * count, "byteStride": 16}],
        "buffers": [{"byteLength": 16 * count}],
        "meshes": [{"primitives": [primitive] * 3}],
        "nodes": [{"mesh": 0}],
    }
    return glb(content, np.ones(4 * count, "<f4").tobytes())


BOMBS: dict[str, tuple[str, Callable[[], bytes]]] = {
    "sog": ("a.sog", lambda: flat_sog(870_000, 950)),
    "sog of degree 3": ("a.sog", lambda: flat_sog(200_000, 450, 3)),
    "spz": ("a.spz", lambda: flat_spz(850_000)),
    "npz": ("a.npz", lambda: flat_npz(25_000_000, 2)),
    "npz of too much": ("a.npz", lambda: flat_npz(20_000_000, 40)),
    "npz of many": ("a.npz", lambda: zipped({f"{number:06d}": b"" for number in range(120_000)})),
    "glb": ("a.glb", lambda: glb_of_one_row(800_000)),
    "gltf of objects": (
        "a.gltf",
        lambda: b'{"asset":{"version":"2.0"},"scenes":[{}' + b",{}" * 4_000_000 + b"]}",
    ),
    "json of objects": ("transforms.json", lambda: b'{"frames":[{}' + b',{"a":1}' * 2_000_000 + b"]}"),
}


def read_any(path: Path) -> float:
    match path.suffix:
        case ".npz":
            read_npz(path)
        case ".json":
            load_nerfstudio(path, DatasetConfig(max_side=64), silent)
        case _:
            load_gaussians(path)
    return 1.0


@pytest.mark.long
@pytest.mark.parametrize("name", BOMBS)
def test_bombs_take_no_more_memory_than_promised(tmp_path: Path, name: str) -> None:
    file, made = BOMBS[name]
    outcome = tried(FileKind(file, lambda _: [], read_any), tmp_path, [made()])
    assert outcome.loaded == (name in ("sog", "sog of degree 3", "spz", "npz"))


def test_a_file_of_a_terabyte_of_zeros_is_refused(tmp_path, bounded):
    assert_refused(load_gaussians, hole(tmp_path / "a.spz", 10**12))


# Every input format, among them every row of the table of scene formats, against thousands of damaged files:
# read, or refused in one line, and nothing else.

test_a_few_mutants_are_read_or_refused, test_many_mutants_are_read_or_refused = few_and_many(KINDS)


def test_every_scene_format_is_among_the_kinds() -> None:
    assert {row.suffix for row in formats() if row.write} <= {Path(k.file).suffix for k in KINDS.values()}


@pytest.mark.long
@pytest.mark.parametrize("name", [*STRICT, *(name for name in KINDS if name.endswith(".bin"))])
def test_truncated_files_are_refused(tmp_path: Path, name: str) -> None:
    sample = KINDS[name].samples(tmp_path)[0]
    size = len(sample) - (name == "cameras.json")  # the line feed behind JSON means nothing
    places = sorted({*range(0, size, max(1, size // 150)), *range(size - 12, size)})
    if name == ".splat":  # nothing in it tells how many Gaussians follow
        places = [place for place in places if place % 32 or place == 0]
    assert tried(KINDS[name], tmp_path, (sample[:place] for place in places)).refused == len(places)


@pytest.mark.long
@pytest.mark.parametrize("name", STRICT)
def test_random_bytes_and_other_formats_are_refused(tmp_path: Path, name: str) -> None:
    rng, kind = np.random.default_rng(2), KINDS[name]
    magic = kind.samples(tmp_path)[0][:8]
    noise = [magic[: 8 * (number % 2)] + rng.bytes(int(rng.integers(1, 3000)) | 1) for number in range(60)]
    others = [KINDS[other] for other in STRICT if KINDS[other].file != kind.file]
    noise += [other.samples(tmp_path)[0] for other in others]
    assert tried(kind, tmp_path, noise).refused == len(noise)
