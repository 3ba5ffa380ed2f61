"""Files that are damaged, or made to harm: each ends in one FormatError or InputError, in little memory."""

import io
import json
import struct
import tracemalloc
import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from langsplat_core.arrays import Array
from langsplat_core.errors import FormatError, InputError
from langsplat_core.formats import (
    read_cameras,
    read_features,
    read_language,
    read_ply,
    read_sog,
    write_cameras,
    write_features,
    write_language,
)
from tests.core.file_samples import (
    ascii_ply,
    compressed_ply,
    plain_ply,
    random_field,
    sog_files,
    write_folder,
    zipped,
)
from tests.scenes import random_camera, random_gaussians

SCENE = random_gaussians(20, sh_degree=1)
MEMORY = 32 * 1024 * 1024  # bytes; the samples have at most 20 kB


def features(path: Path) -> object:
    """A `_f.npy` beside a good `_s.npy`."""
    maps = np.zeros((4, 2, 2), np.int32)
    write_features(path.parent, "good", np.zeros((1, 8), np.float32), maps)
    (path.parent / "bad_s.npy").write_bytes((path.parent / "good_s.npy").read_bytes())
    return read_features(path.parent, "bad")


def written(write: Callable[[Path], None]) -> Callable[[Path], bytes]:
    def make(folder: Path) -> bytes:
        write(folder / "made")
        return (folder / "made").read_bytes()

    return make


def npy(folder: Path) -> bytes:
    write_features(folder, "made", np.ones((5, 8), np.float32), np.zeros((4, 2, 2), np.int32))
    return (folder / "made_f.npy").read_bytes()


# kind -> (file name, sample, reader)
KINDS: dict[str, tuple[str, Callable[[Path], bytes], Callable[[Path], object]]] = {
    "ply": ("a.ply", lambda _: plain_ply(SCENE), read_ply),
    "ply with a list": ("a.ply", lambda _: plain_ply(SCENE, front=b"\x01" + bytes(4) + b"\x00"), read_ply),
    "ascii ply": ("a.ply", lambda _: ascii_ply(random_gaussians(5)), read_ply),
    "compressed ply": ("a.ply", lambda _: compressed_ply(SCENE), read_ply),
    "sog": ("a.sog", lambda _: zipped(sog_files(SCENE)), read_sog),
    "sidecar": (
        "a.langsplat.safetensors",
        written(lambda path: write_language(path, random_field(20), SCENE.means)),
        lambda path: read_language(path, SCENE.means),
    ),
    "cameras": (
        "a.cameras.json",
        written(lambda path: write_cameras(path, (random_camera(), random_camera(1)))),
        read_cameras,
    ),
    "features": ("bad_f.npy", npy, features),
}


class Reader:
    """Reads damaged versions of one kind of file, allowing success, FormatError and InputError only."""

    def __init__(self, kind: str, folder: Path) -> None:
        name, make, self._read = KINDS[kind]
        self.path = folder / name
        self.sample = make(folder)
        self.refused = 0

    def __call__(self, content: bytes) -> None:
        self.path.write_bytes(content)
        try:
            self._read(self.path)
        except (FormatError, InputError) as error:
            message = str(error)
        else:
            return
        self.refused += 1
        assert "\n" not in message
        assert str(self.path.parent) in message


@pytest.fixture
def bounded():
    """Fails the test when Python and NumPy together ever held more than MEMORY, or a warning was given."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        tracemalloc.start()
        yield
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    assert peak < MEMORY, f"{peak / 1e6:.0f} MB"


@pytest.mark.parametrize("kind", KINDS)
def test_the_samples_are_good(tmp_path, bounded, kind):
    reader = Reader(kind, tmp_path)
    reader(reader.sample)
    assert not reader.refused


@pytest.mark.parametrize("kind", KINDS)
def test_truncated_at_many_places(tmp_path, bounded, kind):
    reader = Reader(kind, tmp_path)
    size = len(reader.sample)
    places = {*range(0, size, max(1, size // 150)), *range(size - 12, size)}
    # The last number of an ascii file can lose digits, and the line feed behind JSON means nothing.
    harmless = {"ascii ply": reader.sample.rfind(b" ") + 2, "cameras": size - 1}.get(kind, size)
    for count, place in enumerate(sorted(places), start=1):
        reader(reader.sample[:place])
        assert place >= harmless or reader.refused == count


def damage(sample: bytes, rng: np.random.Generator) -> bytes:
    """One to four wounds: bytes changed, removed, doubled, or a number of the header made enormous."""
    data = bytearray(sample)
    for _ in range(rng.integers(1, 5)):
        # half of the wounds in the first part, where headers are
        place = int(rng.integers(0, min(len(data), 600) if rng.random() < 0.5 else len(data)))
        length = int(rng.integers(1, 9))
        match int(rng.integers(0, 5)):
            case 0:
                data[place : place + length] = rng.bytes(length)
            case 1:
                del data[place : place + length]
            case 2:
                data[place:place] = data[place : place + length]
            case 3:
                data[place : place + 1] = rng.choice([b"\x00", b"\xff", b"-", b"9", b"\n", b" ", b'"', b"]"])
            case _:
                digits = [i for i in range(min(len(data), 3000)) if 48 <= data[i] <= 57]
                if digits:
                    at = int(rng.choice(digits))
                    data[at : at + 1] = rng.choice([b"999999999999", b"-1", b"4294967295", b"0", b"1e999"])
        if not data:
            break
    return bytes(data)


def fuzz(kind: str, folder: Path, rounds: int, seed: int) -> None:
    reader = Reader(kind, folder)
    rng = np.random.default_rng(seed)
    for _ in range(rounds):
        reader(damage(reader.sample, rng))
    assert reader.refused > rounds / 20  # the wounds do hurt


@pytest.mark.parametrize("kind", KINDS)
def test_random_damage(tmp_path, bounded, kind):
    fuzz(kind, tmp_path, rounds=200, seed=0)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_much_random_damage(tmp_path, bounded, kind):
    fuzz(kind, tmp_path, rounds=10_000, seed=1)


@pytest.mark.parametrize("kind", KINDS)
def test_random_bytes(tmp_path, bounded, kind):
    reader = Reader(kind, tmp_path)
    rng = np.random.default_rng(2)
    magic = reader.sample[:8]
    for round_ in range(60):
        noise = rng.bytes(int(rng.integers(0, 3000)))
        reader(noise if round_ % 2 else magic + noise)
    assert reader.refused == 60


@pytest.mark.parametrize("kind", KINDS)
def test_one_kind_in_place_of_another(tmp_path, bounded, kind):
    reader = Reader(kind, tmp_path)
    others = [other for other in KINDS if KINDS[other][2] is not KINDS[kind][2]]
    for other in others:
        reader(Reader(other, tmp_path).sample)
    assert reader.refused == len(others)


# ---- made to exhaust memory ----


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


def test_the_damage_is_reproducible():
    sample: Array | bytes = plain_ply(SCENE)
    first, second = (damage(sample, np.random.default_rng(5)) for _ in range(2))
    assert first == second != sample
