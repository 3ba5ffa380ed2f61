"""Every kind of input file that is damaged in tests: good samples, seeded mutations of binary and of text
formats, how the files are read, and what a reader may do with a damaged one."""

import copy
import gzip
import io
import json
import logging
import re
import struct
import time
import traceback
import warnings
import zipfile
import zlib
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import cache, partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import av
import numpy as np
import pytest
from PIL import Image
from plyfile import PlyData, PlyElement

from langsplat_core.arrays import unit
from langsplat_core.cli.app import parse
from langsplat_core.cli.describe import outline_lines, outline_of
from langsplat_core.cli.query import Unit
from langsplat_core.config import DatasetConfig, check_settings
from langsplat_core.datasets.capture import Capture
from langsplat_core.datasets.colmap import load_colmap
from langsplat_core.datasets.nerfstudio import load_nerfstudio
from langsplat_core.datasets.photos import exif_facts, optics, read_photo
from langsplat_core.datasets.video import kept_frames
from langsplat_core.errors import InputError, LangSplatError, printable_line
from langsplat_core.extensions.benchmarks.raster_speed import peak_memory, restart_peak
from langsplat_core.extensions.geometry.usd import write_usd
from langsplat_core.io.cameras import read_cameras, write_cameras
from langsplat_core.io.gltf import write_gltf
from langsplat_core.io.hostile import picture_size
from langsplat_core.io.scenes import formats, load_scene
from langsplat_core.io.sidecar import Words, read_language, read_words, write_language, write_words
from langsplat_core.pipeline.stages import kept, open_array, write_array
from langsplat_core.progress import silent
from langsplat_core.query.describe import Describer
from langsplat_core.query.engine import QueryEngine
from langsplat_core.query.inventory import scene_inventory
from langsplat_core.raster.render import render
from langsplat_core.scene import Gaussians, Scene, TaughtWord
from langsplat_core.semantics.encoders import load_text_encoder
from langsplat_core.semantics.features import FeatureStore, ImageFeatures
from langsplat_core.semantics.relevancy import read_vocabulary
from tests.support.file_samples import (
    ascii_ply,
    bytes_of,
    compressed_ply,
    mixed_ply,
    plain_ply,
    random_field,
    sog_files,
    splat_bytes,
    spz_bytes,
    zipped,
)
from tests.support.photographs import write_colmap, write_nerfstudio
from tests.support.scenes import DEMO, random_camera, random_gaussians, tree_of

HEADER = 600  # bytes at the beginning in which half of the mutations fall
INTEGERS = (0, 1, -1, *(2**k + d for k in (7, 8, 15, 16, 24, 31, 32, 53, 63) for d in (-1, 0)))
FLOATS = (0.0, -0.0, 1.0, -1.0, 1e-45, 1e-38, 1e9, 1e20, 3.4e38, float("inf"), float("-inf"), float("nan"))
TOKENS = (
    *b"0 -1 1 256 65536 4294967296 18446744073709551616 0x10 1_0".split(),
    *b"1e308 1e999 -1e999 1e-320 nan NaN inf -Infinity".split(),
    *b'null true [] {} "" "a" [[[[ \\ud800 ../../x /dev/zero %s%n #'.split(),
    *(b"9" * 30, b"1" + b"0" * 400, b"9" * 5000, b"a" * 5000, b"\x00", b"\x1b[2J", b"\xff\xfe", b"\n", b"\r"),
    *("٣".encode(), "\u2028".encode()),
    *b"char uint int8 float64 list property element vertex ascii x opacity f_rest_9 end_header".split(),
)
_WORD = re.compile(rb"[^\s,:\[\]{}\"]+")
_NUMBER = re.compile(rb"-?\d+(?:\.\d+)?(?:[eE][+-]?\d+)?")


def mutant(sample: bytes, others: Sequence[bytes], rng: np.random.Generator) -> bytes:
    """`sample` with one to four mutations; `others` are files of the same kind to splice with."""
    data = sample
    for _ in range(int(rng.choice([1, 1, 1, 2, 2, 3, 4]))):
        data = MUTATIONS[int(rng.integers(len(MUTATIONS)))](data, others, rng)
    return data


Mutation = Callable[[bytes, Sequence[bytes], np.random.Generator], bytes]


def _place(data: bytes, rng: np.random.Generator) -> int:
    inside = min(len(data), HEADER) if rng.random() < 0.5 else len(data)
    return int(rng.integers(0, max(inside, 1)))


def _flip_bits(data: bytes, _: Sequence[bytes], rng: np.random.Generator) -> bytes:
    out = bytearray(data)
    for _ in range(int(rng.integers(1, 9)) if data else 0):
        out[_place(data, rng)] ^= 1 << int(rng.integers(8))
    return bytes(out)


def _truncate(data: bytes, _: Sequence[bytes], rng: np.random.Generator) -> bytes:
    return data[: _place(data, rng)]


def _cut_out(data: bytes, _: Sequence[bytes], rng: np.random.Generator) -> bytes:
    place = _place(data, rng)
    return data[:place] + data[place + int(2 ** rng.uniform(0, 8)) :]


def _insert(data: bytes, _: Sequence[bytes], rng: np.random.Generator) -> bytes:
    place, length = _place(data, rng), int(2 ** rng.uniform(0, 8))
    new = rng.bytes(length) if rng.random() < 0.5 else data[place : place + length]
    return data[:place] + new + data[place:]


def _fill(data: bytes, _: Sequence[bytes], rng: np.random.Generator) -> bytes:
    """A run of one byte."""
    place, length = _place(data, rng), int(2 ** rng.uniform(0, 8))
    value = bytes([int(rng.choice([0, 255, 127, 128, 32, 9]))])
    return data[:place] + value * min(length, len(data) - place) + data[place + length :]


def _extreme_number(data: bytes, _: Sequence[bytes], rng: np.random.Generator) -> bytes:
    """A binary number of any width, either byte order, at any place or an aligned one."""
    order = "<>"[int(rng.integers(2))]
    if rng.random() < 0.6:
        width = int(rng.choice([1, 2, 4, 8]))
        value = int(rng.choice(np.array(INTEGERS, object))) + int(rng.integers(-1, 2))
        new = (value % 256**width).to_bytes(width, "little" if order == "<" else "big")
    else:
        new = struct.pack(f"{order}{rng.choice(['f', 'd'])}", float(rng.choice(FLOATS)))
    place = _place(data, rng)
    place -= place % len(new) if rng.random() < 0.5 else 0
    return data[:place] + new + data[place + len(new) :]


def _other(what: re.Pattern[bytes]) -> Mutation:
    """Of text, a number or a word becomes another."""

    def replaced(data: bytes, _: Sequence[bytes], rng: np.random.Generator) -> bytes:
        start = _place(data, rng)
        match = what.search(data, start) or what.search(data)
        if match is None:
            return data
        return data[: match.start()] + TOKENS[int(rng.integers(len(TOKENS)))] + data[match.end() :]

    return replaced


_inflate, _other_word = _other(_NUMBER), _other(_WORD)


def _swap_lines(data: bytes, _: Sequence[bytes], rng: np.random.Generator) -> bytes:
    """Two lines, or blocks of 16 bytes where there are none, in each other's place; or one of them twice."""
    lines = data[:20_000].splitlines(keepends=True)
    if len(lines) < 4:
        lines = [data[i : i + 16] for i in range(0, len(data[:20_000]), 16)]
    if len(lines) < 2:
        return data
    a, b = (int(i) for i in rng.integers(0, len(lines), 2))
    if rng.random() < 0.5:
        lines[a], lines[b] = lines[b], lines[a]
    else:
        lines[a] = lines[b]
    return b"".join(lines) + data[20_000:]


def _splice(data: bytes, others: Sequence[bytes], rng: np.random.Generator) -> bytes:
    """The beginning of one file and the end of another."""
    other = others[int(rng.integers(len(others)))] if others else data
    place = _place(data, rng)
    shift = int(rng.choice([0, 0, -1, 1, 4, -8]))
    return data[:place] + other[max(place + shift, 0) :]


MUTATIONS: tuple[Mutation, ...] = (
    *(_flip_bits, _flip_bits, _truncate, _cut_out, _insert, _fill),
    *(_extreme_number, _extreme_number, _inflate, _inflate, _other_word, _swap_lines, _splice),
)


# Damage below a wrapping that would notice it: values of JSON, parts of safetensors and .glb, members of
# archives, gzip streams, chunks of PNG.

ODDS = (
    *(None, True, -1, 0, 2**31, 2**63, 10**400, 1e-320, 1e308, float("nan"), float("inf")),
    *("", "0", "\0", "\ud800", "\u2028", "a" * 5000, "../../x", "~nosuchuser/x", "someone/model"),
    *([], {}, [[]], [0.0] * 3, [1] * 99),
)
CHUNKS = (*(b"IHDR", b"PLTE", b"tRNS", b"iCCP", b"tEXt"), *(b"zTXt", b"iTXt", b"eXIf", b"acTL", b"fcTL"))


def _half(inner: Mutation) -> Mutation:
    return lambda data, others, rng: (inner if rng.random() < 0.6 else mutant)(data, others, rng)


def _in(value: object) -> Iterator[tuple[Any, Any]]:
    """Yield every container in a JSON value with each of its keys."""
    keys = range(len(value)) if isinstance(value, list) else value if isinstance(value, dict) else ()
    for key in list(keys):
        yield value, key
        yield from _in(value[key])


@_half
def in_json(data: bytes, _: Sequence[bytes], rng: np.random.Generator) -> bytes:
    """One to three values, at any depth, are removed, doubled, or become others, some of the same file."""
    top = json.loads(data)
    for _ in range(int(rng.integers(1, 4))):
        places = list(_in(top))
        if not places:
            break
        (owner, key), (other, there) = (places[i] for i in rng.integers(len(places), size=2))
        match int(rng.integers(5)):
            case 0:
                del owner[key]
            case 1 if isinstance(owner, list):
                owner.insert(key, owner[key])
            case 2:
                owner[key] = copy.deepcopy(other[there])
            case _:
                owner[key] = copy.deepcopy(ODDS[int(rng.integers(len(ODDS)))])
    return json.dumps(top).encode()


def _of_text(text: bytes, rng: np.random.Generator) -> bytes:
    return (in_json if text[:1] in (b"[", b"{") else mutant)(text, [], rng)


@_half
def in_safetensors(data: bytes, _: Sequence[bytes], rng: np.random.Generator) -> bytes:
    """A text of the metadata, what is stated of a tensor, or numbers are damaged, in a whole file."""
    start = 8 + int.from_bytes(data[:8], "little")
    header, body = json.loads(data[8:start]), data[start:]
    about, which = header["__metadata__"], rng.random()
    if which < 0.5:
        name = str(rng.choice(list(about)))
        about[name] = _of_text(about[name].encode(), rng).decode(errors="replace")
    elif which < 0.9:
        body = mutant(body, [], rng)[: len(body)].ljust(len(body), b"\0")
    text = json.dumps(header).encode()
    if which >= 0.9:
        text = in_json(text, [], rng)
    return len(text).to_bytes(8, "little") + text + body


@_half
def in_glb(data: bytes, _: Sequence[bytes], rng: np.random.Generator) -> bytes:
    """Return what is stated of the arrays, or their numbers, in a whole file."""
    size = int.from_bytes(data[12:16], "little")
    content, binary = data[20 : 20 + size], data[28 + size :]
    if rng.random() < 0.7:
        content = in_json(content, [], rng)
    else:
        binary = mutant(binary, [], rng)
    content += b" " * (-len(content) % 4)
    chunks = struct.pack("<I4s", len(content), b"JSON") + content
    chunks += struct.pack("<I4s", len(binary), b"BIN\0") + binary
    return data[:8] + struct.pack("<I", 12 + len(chunks)) + chunks


@_half
def in_zip(data: bytes, others: Sequence[bytes], rng: np.random.Generator) -> bytes:
    """One member is damaged, missing, or packed by another method; the checksums are right."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    name = str(rng.choice(list(members)))
    same = [member for member in members.values() if len(member) > 100]
    methods = [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA]
    method = methods[int(rng.choice([0, 0, 1, 1, 1, 1, 1, 2, 3]))]
    ways = {b"\x89": in_png, b"{": in_json}
    members[name] = ways.get(members[name][:1], mutant)(members[name], same, rng)
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", method) as archive:
        for other, content in members.items():
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


# What a reader may do with a damaged file: load it, or refuse it in one short printable line. Everything
# else is a fault, and so are memory, time and Python warnings.

MEMORY_FACTOR, MEMORY_SLACK = 4, 300_000_000  # bytes: beyond the file's size times the factor
LINE = 235  # characters of a message beside the folder of the file
SECONDS = 20.0  # of the processor: what the worst mutants need is hundredths


@dataclass
class Outcome:
    """Counts of what became of many mutants of one kind."""

    tried: int = 0
    loaded: int = 0
    warned: int = 0  # of those, with a warning of ours
    faults: Counter[str] = field(default_factory=Counter)  # description -> mutants

    @property
    def refused(self) -> int:
        return self.tried - self.loaded - self.faults.total()


@dataclass(frozen=True)
class FileKind:
    """A format whose damaged files are tried."""

    file: str  # where the mutants are written, below the folder of the test
    samples: Callable[[Path], list[bytes]]  # also writes what has to lie beside them into the folder
    read: Callable[[Path], float]  # the share of sound content, in [0, 1]; below a half a warning is due
    damage: Mutation = mutant
    share: float = 1.0  # of the mutants that others get, where each takes long
    told: int = 0  # samples with something that is passed over, and said


def fuzz(kind: FileKind, folder: Path, count: int, seed: int) -> Outcome:
    """What became of `count` mutants, after the good samples were read with no word but on what is told."""
    samples, rng = kind.samples(folder), np.random.default_rng(seed)
    good = tried(kind, folder, samples)
    assert (good.loaded, good.warned) == (len(samples), kind.told), good
    mutants = (kind.damage(samples[number % len(samples)], samples, rng) for number in range(count))
    outcome = tried(kind, folder, mutants)
    assert outcome.refused + outcome.loaded == outcome.tried
    assert outcome.refused + outcome.warned > outcome.tried / 50  # the mutations do hurt
    return outcome


def tried(kind: FileKind, folder: Path, contents: Iterable[bytes]) -> Outcome:
    """Return what became of each, as the contents of a file of the kind; no fault among them."""
    outcome, path = Outcome(), folder / kind.file
    with _listening() as said:
        for content in contents:
            said.clear()
            outcome.tried += 1
            path.write_bytes(content)
            before, began = restart_peak() or 0, time.process_time()
            what = _verdict(kind, path, said, outcome)
            took, seconds = (peak_memory() or 0) - before, time.process_time() - began
            if what is None and took > MEMORY_FACTOR * len(content) + MEMORY_SLACK:
                what = f"memory: {took / 1e6:.0f} MB for {len(content)} bytes"
            if what is None and seconds > SECONDS:
                what = f"time: {seconds:.0f} s for {len(content)} bytes"
            if what is not None:
                outcome.faults[what] += 1
    assert not outcome.faults, outcome
    return outcome


def _verdict(kind: FileKind, path: Path, said: list[str], outcome: Outcome) -> str | None:
    """The fault, if any; counts what loaded."""
    try:
        with warnings.catch_warnings(record=True) as warned:  # raised, a broad `except` would hide them
            warnings.simplefilter("always")
            try:
                sound = kind.read(path)
            finally:
                given = [
                    f"{Path(one.filename).name}:{one.lineno}: {one.message}"
                    for one in warned
                    if "/PIL/" not in one.filename  # which `io.hostile` silences
                ]
    except LangSplatError as error:
        return f"warning: {given[0]}" if given else _bad_line(str(error), path)
    except Exception as error:  # noqa: BLE001  which is what is looked for
        last = traceback.extract_tb(error.__traceback__)[-1]
        return f"{type(error).__name__} ({str(error)[:80]}) at {Path(last.filename).name}:{last.lineno}"
    bad = (
        f"warning: {given[0]}" if given else next(filter(None, (_bad_line(one, path) for one in said)), None)
    )
    if bad is None and sound < 0.5 and not said:
        bad = "mostly unsound, unsaid"
    outcome.loaded += bad is None
    outcome.warned += bad is None and bool(said)
    return bad


def _bad_line(text: str, path: Path) -> str | None:
    text = text.replace(str(path.parent), "")
    if not text or len(text) >= LINE or not text.isprintable():
        return f"message: {len(text)} characters, {text[:60]!r} ... {text[-60:]!r}"
    return None


@contextmanager
def _listening() -> Iterator[list[str]]:
    """What the logger "langsplat" says, as the command line shows it."""
    said: list[str] = []
    handler = logging.Handler()
    handler.emit = lambda record: said.append(printable_line(record.getMessage()))  # type: ignore[method-assign]
    logger = logging.getLogger("langsplat")
    logger.addHandler(handler)
    try:
        yield said
    finally:
        logger.removeHandler(handler)


# Good samples of every kind, and how they are read.

SCENE = random_gaussians(20, sh_degree=1)
PLAIN = random_gaussians(300, seed=1)


def scene_share(path: Path) -> float:
    """Also makes what a viewer makes first: the camera that frames the scene, and what it sees."""
    scene = load_scene(path)
    drawn = render(scene, scene.framing_camera((32, 24)))
    assert np.isfinite(drawn.colours).all()
    assert np.isfinite(drawn.alpha).all()
    gaussians = scene.gaussians
    assert sum(gaussians.invalid_rows().values()) == len(gaussians) - gaussians.valid().sum()
    return drawable_share(gaussians)


def drawable_share(gaussians: Gaussians) -> float:
    return float(gaussians.valid().mean()) if len(gaussians) else 1.0


def sidecars(_: Path) -> list[bytes]:
    """Of every codec, with a tree and a taught word; version 2."""
    made = []
    for kind in ("codebook", "autoencoder", "linear"):
        field = random_field(len(SCENE), kind)
        taught = (taught_word("mine", field.codec.vector_dim),)
        field = replace(field, tree=tree_of(Scene(SCENE, field)), taught=taught)
        made.append(bytes_of(write_language, field, SCENE.means))
    return made


def taught_word(name: str, dims: int) -> TaughtWord:
    vectors = unit(np.random.default_rng(3).normal(size=(2, dims))).astype(np.float32)
    return TaughtWord(name, 2, vectors, np.array([0.25, 0.5], np.float32))


def searched(path: Path) -> float:
    """Asks a field, describes it, and draws the answer and its latents: numbers may be read but useless."""
    field = read_language(path, SCENE.means)
    vector = unit(np.random.default_rng(0).normal(size=field.codec.vector_dim)).astype(np.float32)
    scene = Scene(SCENE, replace(field, phrasebook={"cup": vector}))
    engine = QueryEngine(scene, load_text_encoder)
    answer = engine.run("cup")
    engine.instances(answer)
    describer = Describer(engine, ["cup"])
    scene_inventory(describer)
    outline_lines(outline_of(describer), Unit(None, scene.origin))
    values = np.concatenate([answer.relevancy.T, *field.colours], axis=1)
    drawn = render(scene, scene.framing_camera((32, 24)), values)
    assert np.isfinite(values).all()
    assert np.isfinite(drawn.values).all()
    if field.taught:
        engine.run(field.taught[0].name)
    with suppress(LangSplatError):  # of an encoder that is not that of the vectors
        engine.run("saucer")
    return 1.0


def word_files(_: Path) -> list[bytes]:
    field = random_field(len(SCENE))
    words = tuple(taught_word(name, field.codec.vector_dim) for name in ("mine", "Tür"))
    return [bytes_of(write_words, Words("demo", field.canonical, words))]


def asked_words(path: Path) -> float:
    words = read_words(path)
    engine = QueryEngine(Scene(SCENE, random_field(len(SCENE))), words=words)
    for word in words.words:
        assert np.isfinite(engine.run(word.name).relevancy).all()
    return 1.0


def camera_list(path: Path) -> float:
    for camera in read_cameras(path):
        assert np.isfinite([*camera.position, camera.intrinsics.fov_degrees]).all()
    return 1.0


def vocabularies(_: Path) -> list[bytes]:
    return [b"# mine\ncup\nred mug\n", "Tür\r\ncafé\r\n".encode(), "cup\n".encode("utf-16")]


def encoded(path: Path) -> float:
    known, vectors = QueryEngine(_demo(), load_text_encoder).texts.of_known(read_vocabulary(path))
    assert len(known) == len(vectors)
    return 1.0


@cache
def _demo() -> Scene:
    return load_scene(DEMO)


def settings_files(_: Path) -> list[bytes]:
    return [
        b'preset = "quick"\n[radiance]\nsteps = 100\nexposure = "on"\n[masks]\nbox-nms = 0.5\n',
        b'profile = "paper"\n[codec]\nkind = "linear"\nlatent-dim = 4\n[dataset]\nallow-few-cameras = true\n',
    ]


def trained_by(path: Path) -> float:
    check_settings(parse(["train", "photographs", "--config", str(path), "--out", "s.ply"]))
    return 1.0


def origins(folder: Path) -> list[bytes]:
    (folder / "a.ply").write_bytes(plain_ply(SCENE))
    return [b'{"origin": [1e6, -2.5, 0]}', b'{"origin": [0, 0, 1e-9]}']


def beside_scene(path: Path) -> float:
    scene = load_scene(path.parent / "a.ply")
    if scene.unread:
        raise InputError(scene.unread[0])
    assert np.isfinite(scene.world_gaussians().means).all()
    return scene_share(path.parent / "a.ply")


def stages(_: Path) -> list[bytes]:
    arrays = {"values": np.ones((5, 3), np.float32), "rows": np.arange(4)}
    return [bytes_of(kept, lambda: arrays, name="made.npz")]


def kept_stage(path: Path) -> float:
    assert set(kept(path, dict)) == {"values", "rows"}
    return 1.0


def mapped_arrays(_: Path) -> list[bytes]:
    arrays = (np.ones((50, 3), np.float32), np.zeros(0, np.int32))
    return [bytes_of(write_array, array, name="made.npy") for array in arrays]


def mapped(path: Path) -> float:
    return float(np.asarray(open_array(path)).size >= 0)


def feature_files(folder: Path) -> list[bytes]:
    rng = np.random.default_rng(0)
    store = FeatureStore(folder)
    for seed, count in enumerate((5, 1)):
        vectors = unit(rng.normal(size=(count, 8))).astype(np.float32)
        labels = rng.integers(-1, count, (3, 12, 16)).astype(np.int32)
        store.save(f"made{seed}", ImageFeatures(labels, vectors), "k" * seed)
    return [store.path(f"made{seed}").read_bytes() for seed in range(2)]


def stored_features(path: Path) -> float:
    store = FeatureStore(path.parent)
    there = store.has("a")
    if not there:  # which was said, and is not an error: they are made again
        return 0.0
    store.load("a")
    return 1.0


def transforms(folder: Path) -> list[bytes]:
    coefficients = {"k1": 0.01, "k2": 0.001, "p1": 1e-4, "p2": 0.0}
    size = {"cx": 20, "cy": 15, "w": 40, "h": 30}
    fisheye = dict.fromkeys(("k2", "k3", "k4"), 0.0) | {"k1": 0.02}
    lenses: list[dict[str, Any]] = [
        {"camera_model": "OPENCV", "fl_x": 50.0, "fl_y": 51.0, **size, **coefficients},
        {"camera_angle_x": 0.8, "camera_model": "OPENCV_FISHEYE", **fisheye},
        {"fl_x": 50, "metres_per_unit": 0.5, "applied_transform": np.eye(4)[:3].tolist()},
    ]
    made = []
    for lens in lenses:
        write_nerfstudio(folder, **lens, ply_file_path="cloud.ply")
        made.append((folder / "transforms.json").read_bytes())
    (folder / "cloud.ply").write_bytes(clouds(folder)[0])
    return made


def clouds(_: Path) -> list[bytes]:
    """Colours of three types, each in binary and as text."""
    rng = np.random.default_rng(0)
    made = []
    for colour in ("u1", "f4", "i4"):
        types = [(name, "f4") for name in "xyz"] + [(name, colour) for name in ("red", "green", "blue")]
        table = np.zeros(12, types)
        for name, _ in types:
            table[name] = rng.uniform(0, 1 if colour == "f4" else 200, 12)
        for text in (False, True):
            buffer = io.BytesIO()
            PlyData([PlyElement.describe(table, "vertex")], text=text).write(buffer)
            made.append(buffer.getvalue())
    return made


def cloud_folder(folder: Path) -> list[bytes]:
    write_nerfstudio(folder, ply_file_path="cloud.ply")
    return clouds(folder)


def beside_transforms(path: Path) -> float:
    return _usable(load_nerfstudio(path.parent / "transforms.json", DatasetConfig(max_side=64), silent))


def _usable(capture: Capture) -> float:
    """All that training asks of a capture without looking at pixels; lost points were told of."""
    assert np.isfinite(capture.points).all()
    assert np.isfinite(capture.extent())
    assert all(np.isfinite(camera.position).all() for camera in capture.cameras)
    return 1.0


def colmap(part: str) -> FileKind:
    """`part`: cameras.bin, for one."""

    def samples(folder: Path) -> list[bytes]:
        return [(write_colmap(folder, part.rpartition(".")[2]) / part).read_bytes()]

    def read(path: Path) -> float:
        return _usable(load_colmap(path.parents[2], path.parent, DatasetConfig(max_side=64), silent))

    return FileKind(f"sparse/0/{part}", samples, read)


def pictures(kind: str) -> Callable[[Path], list[bytes]]:
    """Of every mode that the kind has, with EXIF data."""

    def samples(_: Path) -> list[bytes]:
        rng = np.random.default_rng(0)
        noise = Image.fromarray(rng.integers(0, 256, (15, 20, 3), dtype=np.uint8)).resize((20, 15))
        exif = Image.Exif()
        exif.update({0x0112: 6, 0x010F: "maker", 0x0110: "model"})
        exif.get_ifd(0x8769).update({0x920A: 35.0, 0xA405: 28})
        deep = Image.fromarray(np.asarray(noise.convert("L")).astype(np.uint16) * 257)
        modes: dict[str, list[tuple[Image.Image, dict[str, object]]]] = {
            "PNG": [(noise.convert(mode), {}) for mode in ("RGB", "RGBA", "P", "L", "LA", "1")]
            + [(deep, {}), (noise, {"save_all": True, "append_images": [noise.convert("RGB")]})],
            "JPEG": [(noise, {}), (noise, {"progressive": True})]
            + [(noise.convert(mode), {}) for mode in ("L", "CMYK")],
            "WEBP": [(noise, {}), (noise, {"lossless": True}), (noise.convert("RGBA"), {"lossless": True})]
            + [(noise, {"save_all": True, "append_images": [noise.rotate(90)]})],
            "TIFF": [
                (noise, {"compression": way})
                for way in (None, "tiff_lzw", "tiff_adobe_deflate", "packbits", "jpeg")
            ]
            + [(deep, {}), (noise.convert("1"), {"compression": "group4"}), (noise.convert("CMYK"), {})]
            + [(noise.convert("P"), {})],
            "BMP": [(noise.convert(mode), {}) for mode in ("RGB", "P", "L", "1", "RGBA")],
            "AVIF": [(noise, {"speed": 10}), (noise.convert("RGBA"), {"speed": 10})],
        }
        made = []
        for picture, options in modes[kind]:
            buffer = io.BytesIO()
            picture.save(buffer, kind, **({} if kind == "BMP" else {"exif": exif}), **options)
            made.append(buffer.getvalue())
        return made

    return samples


def photograph(path: Path) -> float:
    width, height = picture_size(path)
    for upright in (False, True):
        picture = read_photo(path, upright)
        assert picture.mode in ("RGB", "RGBA")
        assert {*picture.size} == {width, height}
    optics(path), exif_facts(path)
    return 1.0


# Whose first bytes choose a demuxer that asks the network or reads other files.
STREAM = b"v=0\no=- 0 0 IN IP4 127.0.0.1\ns=x\nc=IN IP4 127.0.0.1\nt=0 0\nm=video 5004 RTP/AVP 96\n"
STREAM += b"a=rtpmap:96 H264/90000\n"
PLAYLIST = b"#EXTM3U\n#EXT-X-TARGETDURATION:1\n#EXTINF:1,\nclip.mp4\n#EXT-X-ENDLIST\n"
TEXTS = [
    STREAM,
    PLAYLIST,
    b"ffconcat version 1.0\nfile clip.mp4\n",
    b"YUV4MPEG2 W8 H8 F25:1\n" + b"FRAME\n" * 9,
]


def video_files(folder: Path) -> list[bytes]:
    made = []
    for suffix, codec in ((".mp4", "mpeg4"), (".mkv", "mpeg4"), (".avi", "mjpeg"), (".ts", "mpeg4")):
        with av.open(str(folder / f"made{suffix}"), "w") as container:
            stream = container.add_stream(codec, rate=10)
            stream.width, stream.height = 48, 32
            stream.pix_fmt = "yuvj420p" if codec == "mjpeg" else "yuv420p"
            for seed in range(6):
                image = np.random.default_rng(seed).integers(0, 256, (32, 48, 3), dtype=np.uint8)
                container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
            container.mux(stream.encode())
        made.append((folder / f"made{suffix}").read_bytes())
    return made


def or_text(data: bytes, others: Sequence[bytes], rng: np.random.Generator) -> bytes:
    """Of each tenth, a text that is no video."""
    return mutant(TEXTS[int(rng.integers(len(TEXTS)))] if rng.random() < 0.1 else data, others, rng)


def filmed(path: Path) -> float:
    with TemporaryDirectory(dir=path.parent) as folder:
        frames = kept_frames(path, 4, Path(folder)).iterdir()
        return float(bool([photograph(frame) for frame in frames]))


def _photographs(kind: str, damage: Mutation = mutant) -> FileKind:
    return FileKind("a.png", pictures(kind), photograph, damage)  # the name's ending plays no part


def _scenes(file: str, *samples: bytes, damage: Mutation = mutant, told: int = 0) -> FileKind:
    return FileKind(file, lambda _: [*samples], scene_share, damage, told=told)


def as_gltf(gaussians: Gaussians, name: str) -> bytes:
    return bytes_of(write_gltf, Scene(gaussians), name=name)


def as_stage(end: str, _: Path) -> list[bytes]:
    return pytest.importorskip("pxr") and [bytes_of(write_usd, Scene(random_gaussians(5)), name=f"a{end}")]


KINDS = {
    "INRIA PLY": _scenes(
        *("a.ply", plain_ply(SCENE), plain_ply(PLAIN), mixed_ply(SCENE), ascii_ply(random_gaussians(5))),
        told=2,  # the elements beside the vertices
    ),
    "compressed PLY": _scenes("a.ply", compressed_ply(SCENE), compressed_ply(PLAIN, colours=False)),
    "SOG": _scenes("a.sog", zipped(sog_files(SCENE)), zipped(sog_files(PLAIN)), damage=in_zip),
    **{
        f"SPZ {v}": _scenes("a.spz", spz_bytes(SCENE, v), spz_bytes(PLAIN, v), damage=in_gzip)
        for v in (1, 2, 3, 4)
    },
    ".glb": _scenes("a.glb", *(as_gltf(one, "a.glb") for one in (SCENE, PLAIN)), damage=in_glb),
    ".gltf": _scenes("a.gltf", as_gltf(random_gaussians(3), "a.gltf"), damage=in_json),
    ".splat": _scenes("a.splat", splat_bytes(SCENE), splat_bytes(PLAIN)),
    **{
        end: FileKind(f"a{end}", partial(as_stage, end), scene_share, share=0.0)  # a second for each
        for end in (row.suffix for row in formats() if row.write is write_usd)
    },
    "sidecar": FileKind("a.langsplat.safetensors", sidecars, searched, in_safetensors),
    "taught words": FileKind("a.safetensors", word_files, asked_words, in_safetensors),
    "vocabulary": FileKind("a.txt", vocabularies, encoded),
    "settings": FileKind("a.toml", settings_files, trained_by),
    "origin.json": FileKind("a.origin.json", origins, beside_scene, in_json),
    "cameras.json": FileKind(
        "a.cameras.json",
        lambda _: [bytes_of(write_cameras, (random_camera(), random_camera(1)))],
        camera_list,
        in_json,
    ),
    "transforms.json": FileKind("transforms.json", transforms, beside_transforms, in_json),
    "point-cloud PLY": FileKind("cloud.ply", cloud_folder, beside_transforms),
    **{
        f"COLMAP {part}.{form}": colmap(f"{part}.{form}")
        for form in ("bin", "txt")
        for part in ("cameras", "images", "points3D")
    },
    ".features.npz": FileKind("a.features.npz", feature_files, stored_features, in_zip),
    "stage of training": FileKind("a.npz", stages, kept_stage, in_zip),
    "array of training": FileKind("a.npy", mapped_arrays, mapped),
    "video": FileKind("a.mp4", video_files, filmed, or_text),
    "PNG": _photographs("PNG", in_png),
    **{kind: _photographs(kind) for kind in ("JPEG", "WEBP", "TIFF", "BMP", "AVIF")},
}
# In which a byte that is missing cannot go unseen, nor can another format's file be taken for one.
STRICT = ["INRIA PLY", "compressed PLY", "SOG", "SPZ 3", "SPZ 4", ".splat"]
STRICT += ["sidecar", "cameras.json"]

# The two tests of a table of kinds, bound to names in the module that tests their readers.

SEEDS, MUTANTS = (1, 2), 3000  # of the slow tier; of a kind and seed


def few_and_many(kinds: dict[str, FileKind]) -> tuple[Callable[..., None], Callable[..., None]]:
    """Return the test of 60 mutants of each kind, and that of thousands."""

    @pytest.mark.long
    @pytest.mark.parametrize("name", kinds)
    def few(tmp_path: Path, name: str) -> None:
        fuzz(kinds[name], tmp_path, int(20 + 40 * kinds[name].share), seed=0)

    @pytest.mark.slow
    @pytest.mark.parametrize("name", kinds)
    def many(tmp_path: Path, name: str, request: pytest.FixtureRequest) -> None:
        seed = request.config.getoption("--seed")
        for used in SEEDS if seed is None else (seed,):
            folder = tmp_path / str(used)
            folder.mkdir()
            outcome = fuzz(kinds[name], folder, 20 + int(kinds[name].share * MUTANTS), used)
            print(f"| {name}, seed {used} | {outcome.tried} | {outcome.loaded} | {outcome.warned} |")

    return few, many
