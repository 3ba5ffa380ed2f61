"""Files that are damaged anywhere: each ends in one FormatError or InputError, in little memory."""

import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from langsplat_core.arrays import Array
from langsplat_core.errors import FormatError, InputError
from langsplat_core.io import (
    read_cameras,
    read_features,
    read_ksplat,
    read_language,
    read_ply,
    read_sog,
    read_splat,
    read_spz_scene,
    write_cameras,
    write_features,
    write_language,
)
from tests.support.file_samples import (
    ascii_ply,
    compressed_ply,
    plain_ply,
    random_field,
    sog_files,
    zipped,
)
from tests.support.scenes import random_camera, random_gaussians
from tests.support.splat_samples import ksplat_bytes, splat_bytes, spz_bytes

SCENE = random_gaussians(20, sh_degree=1)


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
    "splat": ("a.splat", lambda _: splat_bytes(SCENE), read_splat),
    "ksplat": ("a.ksplat", lambda _: ksplat_bytes([SCENE], 2), read_ksplat),
    "spz 3": ("a.spz", lambda _: spz_bytes(SCENE, 3), read_spz_scene),
    "spz 4": (
        "a.spz",
        lambda _: spz_bytes(SCENE, 4, flags=2, records=struct.pack("<III", 7, 4, 0)),
        read_spz_scene,
    ),
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


@pytest.mark.parametrize("kind", KINDS)
def test_the_samples_are_good(tmp_path, bounded, kind):
    reader = Reader(kind, tmp_path)
    reader(reader.sample)
    assert not reader.refused


@pytest.mark.long
@pytest.mark.parametrize("kind", KINDS)
def test_truncated_at_many_places(tmp_path, bounded, kind):
    reader = Reader(kind, tmp_path)
    size = len(reader.sample)
    places = {*range(0, size, max(1, size // 150)), *range(size - 12, size)}
    # The last number of an ascii file can lose digits, and the line feed behind JSON means nothing.
    harmless = {"ascii ply": reader.sample.rfind(b" ") + 2, "cameras": size - 1}.get(kind, size)
    for place in sorted(places):
        refused = reader.refused
        reader(reader.sample[:place])
        # nothing in a .splat tells how many Gaussians follow
        assert reader.refused > refused or place >= harmless or (kind == "splat" and place % 32 == 0 < place)


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


@pytest.mark.long
@pytest.mark.parametrize("kind", KINDS)
def test_random_damage(tmp_path, bounded, kind):
    fuzz(kind, tmp_path, rounds=200, seed=0)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_much_random_damage(tmp_path, bounded, kind):
    fuzz(kind, tmp_path, rounds=10_000, seed=1)


@pytest.mark.long
@pytest.mark.parametrize("kind", KINDS)
def test_random_bytes(tmp_path, bounded, kind):
    reader = Reader(kind, tmp_path)
    rng = np.random.default_rng(2)
    magic = reader.sample[:8]
    for round_ in range(60):
        noise = rng.bytes(int(rng.integers(0, 3000)))
        reader(noise if round_ % 2 else magic + noise)
    assert reader.refused == 60


@pytest.mark.long
@pytest.mark.parametrize("kind", KINDS)
def test_one_kind_in_place_of_another(tmp_path, bounded, kind):
    reader = Reader(kind, tmp_path)
    others = [other for other in KINDS if KINDS[other][2] is not KINDS[kind][2]]
    for other in others:
        reader(Reader(other, tmp_path).sample)
    assert reader.refused == len(others)


def test_the_damage_is_reproducible():
    sample: Array | bytes = plain_ply(SCENE)
    first, second = (damage(sample, np.random.default_rng(5)) for _ in range(2))
    assert first == second != sample
