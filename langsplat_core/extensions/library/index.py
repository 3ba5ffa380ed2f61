"""Search over all scenes of a folder, by an index of their codebooks.

The answer to a phrase in a scene rests on the mean relevancies of its regions, which are mixtures of the
relevancies of few codewords. So the index keeps, of every scene, its codewords in 8 bits, how each is read
(zero and rate), the codewords of every region with their shares, and the fits of everyday phrases by chance.
From these the fits and the verdict of `answers.by_regions` are computed without opening the scene, up to the
rounding of codewords. The scenes that answer best are then opened and asked by `QueryEngine`.

The index is one file, mapped into memory: `MAGIC`, the length of a JSON header as uint64, the header, zeros
up to a multiple of 8, then for each group of scenes of one encoder its canonical vectors, the arrays of
`COLUMNS` and the thumbnails. All lengths follow from the numbers of the header, so that a file of another
length is refused.
"""

import json
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import accumulate
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.sparse import csr_matrix

from langsplat_core.arrays import Array
from langsplat_core.compiled import helper, kernel, shared_workers
from langsplat_core.config import PictureConfig
from langsplat_core.display.composing import compose
from langsplat_core.display.displays import Channels
from langsplat_core.errors import FormatError, InputError, LangSplatError
from langsplat_core.io.files import atomic_path
from langsplat_core.io.hostile import exists, open_for_reading, parse_json
from langsplat_core.io.scenes import companion_path, format_of, load_scene, scene_files
from langsplat_core.io.sidecar import SUFFIX
from langsplat_core.progress import Progress, silent
from langsplat_core.query.answers import QueryResult
from langsplat_core.query.engine import LoadEncoder, QueryEngine, same_vectors
from langsplat_core.query.rule import (
    Bar,
    Bars,
    RegionTable,
    bars_of,
    best_relevancies,
    region_fits,
    region_relevancies,
)
from langsplat_core.raster.render import render
from langsplat_core.scene import LEVELS, Calibration, Camera, Odds, Scene
from langsplat_core.semantics.relevancy import fit_of

INDEX = ".langsplat-library"  # its name in the folder
MAGIC = b"LSLIB\x00\x00\x01"
LONGEST_HEADER = 2**30  # bytes
THUMBNAIL = (96, 72)  # width and height, pixels, of the picture that the index keeps of a scene
# Name, type, and what has a row: k, d codewords, m entries of mixtures, r regions, those of subparts first.
COLUMNS: tuple[tuple[str, str, str], ...] = (
    *(("steps", "<f4", "k"), ("zeros", "<f4", "k"), ("rates", "<f4", "k")),
    *(("shares", "<f4", "m"), ("words", "<u4", "m"), ("regions", "<u4", "m")),
    *(("parents", "<i4", "r"), ("solid", "<u4", "r"), ("codewords", "<i1", "d")),
)
FLOATS = 8 + 4 * len(LEVELS)  # of a scene: median and spread of four bars; odds, or NaN


class Columns(NamedTuple):
    """The arrays of scenes, one scene after the other, in the order of `COLUMNS`."""

    steps: Array  # (K,) of the 8 bits: a codeword is step times codewords
    zeros: Array  # (K,) see `Scale.of`
    rates: Array  # (K,)
    shares: Array  # (M,) of a codeword in the mean of a region
    words: Array  # (M,) codeword, from 0 in each scene
    regions: Array  # (M,) region, from 0 in each scene
    parents: Array  # (R,) region of the level above, from 0 in each scene; -1 for none
    solid: Array  # (R,) whether it is no crumb
    codewords: Array  # (K, D)


@dataclass(frozen=True, eq=False)
class Listed:
    """A scene of the folder, as the index describes it."""

    path: str  # below the folder, "/" between names
    stamp: tuple[int, ...]  # size and time of change, ns, of each of its files
    counts: tuple[int, ...] = (0,) * 5  # codewords; regions of each level; entries of its mixtures
    numbers: tuple[float, ...] = (math.nan,) * FLOATS
    taught: tuple[str, ...] = ()  # keys of taught words
    phrases: int = 0  # in its phrasebook
    unread: str = ""  # why it has no answers; one line

    @property
    def is_indexed(self) -> bool:
        """False for a scene that only the engine can answer: of another codec than a codebook."""
        return self.counts[0] > 0

    @property
    def bars(self) -> Bars:
        """The fits of everyday phrases."""
        pairs = self.numbers[:8]
        one, two, three, four = (Bar(*pairs[at : at + 2]) for at in range(0, 8, 2))
        return one, two, three, four

    @property
    def calibration(self) -> Calibration | None:
        """The calibration of its encoder; None where that has none here. ValueError for numbers of none."""
        if math.isnan(self.numbers[8]):
            return None
        return Calibration(*(Odds(*self.numbers[at : at + 4]) for at in (8, 12, 16)))


@dataclass(frozen=True, eq=False)
class Group:
    """The scenes of one encoder, and the arrays of `COLUMNS` of all of them, one after the other."""

    encoder_id: str
    canonical: Array  # (C, D) float32
    scenes: tuple[Listed, ...]
    columns: Mapping[str, Array]

    @property
    def starts(self) -> Array:
        """(S + 1, 3) int64: where the codewords, mixtures and regions of each scene begin."""
        sizes = [(c[0], c[4], sum(c[1:4])) for c in (scene.counts for scene in self.scenes)]
        return np.cumsum([(0, 0, 0), *sizes], axis=0)

    @cached_property
    def table(self) -> RegionTable:
        """The regions of all scenes, as the rule for answers reads them."""
        counts = np.array([scene.counts[1:4] for scene in self.scenes], np.int64).reshape(-1, len(LEVELS))
        firsts = np.repeat(self.starts[:-1, 2], counts.sum(1))
        parents = self.columns["parents"].astype(np.int64)
        return RegionTable(counts, np.where(parents < 0, -1, parents + firsts), self.columns["solid"] > 0)


@dataclass(frozen=True, eq=False)
class Library:
    """A folder of scenes with its index."""

    folder: Path
    groups: tuple[Group, ...]
    unread: tuple[Listed, ...] = ()  # scenes that cannot be opened
    thumbnails: Mapping[str, Array] | None = None  # by path: (H, W, 3) uint8

    @property
    def scenes(self) -> tuple[Listed, ...]:
        """Scenes that can be searched."""
        return tuple(scene for group in self.groups for scene in group.scenes)


# Scenes of a folder, and their digests.


def scenes_in(folder: Path) -> list[Path]:
    """Every scene below a folder with a language field beside it, by name; hidden folders are left out.

    Of several scenes beside one field the first. InputError where there is no such folder.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; name one with scenes in it")
    found: list[Path] = []
    for root, folders, files in os.walk(folder):
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        fields = {name.removesuffix(SUFFIX) for name in files if name.endswith(SUFFIX)}
        if not fields:
            continue
        taken = set[str]()
        for name in sorted([*files, *folders]):
            stem = name if name in fields else Path(name).stem
            path = Path(root, name)
            own = stem in fields - taken and format_of(path) is not None
            if own and companion_path(path, SUFFIX).name == stem + SUFFIX:
                taken.add(stem)
                found.append(path)
    return found


def stamp_of(scene: Path) -> tuple[int, ...]:
    """Size and time of change, ns, of each file of a scene; zeros for one that is not there."""
    numbers: list[int] = []
    for file in scene_files(scene):
        try:
            status = file.stat()
            numbers += [status.st_size, status.st_mtime_ns]
        except OSError:
            numbers += [0, 0]
    return tuple(numbers)


@dataclass(frozen=True, eq=False)
class Digest:
    """The entry of one scene in the index."""

    listed: Listed
    encoder_id: str = ""
    canonical: Array | None = None
    columns: Mapping[str, Array] | None = None
    thumbnail: Array | None = None  # (H, W, 3) uint8


def digest(path: Path, name: str, load_encoder: LoadEncoder | None) -> Digest:
    """Read a scene for the index; one that cannot be read, or has no field, is listed with the reason."""
    listed = Listed(name, stamp_of(path))
    try:
        scene = load_scene(path)
        engine = QueryEngine(scene, load_encoder)
        field, picture = engine.field, draw(scene, THUMBNAIL)
    except LangSplatError as error:
        return Digest(replace(listed, unread=str(error)))
    taught = tuple(word.key for word in field.taught)
    listed = replace(listed, taught=taught, phrases=len(field.phrasebook))
    made = Digest(listed, field.encoder_id, field.canonical, None, picture)
    if field.codec.blends or engine.chance is None or not field.known.any():
        return made
    calibration = engine.calibration
    odds = () if calibration is None else (calibration.thing, calibration.part, calibration.inside)
    numbers = [number for bar in bars_of(engine.chance) for number in (bar.median, bar.spread)]
    numbers += [n for odd in odds for n in (odd.constant, odd.whole, odd.finer, odd.found)]
    if not np.isfinite(numbers).all():
        return made
    numbers += [math.nan] * (FLOATS - len(numbers))
    columns, counts = _columns(engine)
    return replace(made, listed=replace(listed, counts=counts, numbers=tuple(numbers)), columns=columns)


def _columns(engine: QueryEngine) -> tuple[dict[str, Array], tuple[int, ...]]:
    """Return the arrays of a scene, and their `Listed.counts`."""
    field, regions, scale = engine.field, engine.regions, engine.scale
    latents, of = field.codec.unique(field.latents[field.known])
    number = np.full(field.known.shape, -1, np.int64)
    number[field.known] = of
    zeros, rates = scale.of(field.codec.cosines(latents, scale.texts))
    vectors = field.codec.decode(latents)
    steps = np.maximum(np.abs(vectors).max(1), 1e-12) / 127
    sizes = [len(totals) for totals in regions.totals]
    firsts = [0, *accumulate(sizes)]
    mixtures = []
    for level, (totals, first) in enumerate(zip(regions.totals, firsts, strict=False)):
        rows = np.flatnonzero((number[level] >= 0) & (regions.weights > 0))
        where = regions.everywhere[level, rows], number[level, rows]
        shares = csr_matrix((regions.weights[rows], where), shape=(len(totals), len(latents))).tocoo()
        mixtures.append((shares.data / totals[shares.row], shares.col, shares.row + first))
    above = [regions.parents[0] + firsts[1], regions.parents[1] + firsts[2], np.full(sizes[2], -1)]
    columns = {
        "steps": steps,
        "zeros": zeros,
        "rates": rates,
        "shares": np.concatenate([part[0] for part in mixtures]),
        "words": np.concatenate([part[1] for part in mixtures]),
        "regions": np.concatenate([part[2] for part in mixtures]),
        "parents": np.concatenate(above),
        "solid": regions.table.solid,
        "codewords": np.rint(vectors / steps[:, None]),
    }
    made = {name: columns[name].astype(kind) for name, kind, _ in COLUMNS}
    return made, (len(latents), *sizes, len(made["shares"]))


# The index file.


def update_library(
    folder: Path,
    index: Path | None = None,
    load_encoder: LoadEncoder | None = None,
    progress: Progress = silent,
    rebuild: bool = False,
) -> Library:
    """Return the library of a folder, with new and changed scenes read again.

    The index is written where anything is different; an interrupted call keeps what it had read. rebuild:
    every scene is read, whatever the index says. Raises InputError without scenes and FormatError for an
    index that is none.
    """
    index = folder / INDEX if index is None else index
    paths = {path.relative_to(folder).as_posix(): path for path in scenes_in(folder)}
    if not paths:
        raise InputError(f"{folder}: no scene with a language field in it; `langsplat train` makes them")
    old = read_library(index, folder) if exists(index) and not rebuild else Library(folder, ())
    stamps = {name: stamp_of(path) for name, path in paths.items()}
    kept = {
        each.listed.path: each for each in _digests(old) if stamps.get(each.listed.path) == each.listed.stamp
    }
    listed = len(old.scenes) + len(old.unread)
    fresh = [name for name in paths if name not in kept]
    try:
        for done, name in enumerate(fresh):
            progress("reading scenes", done / len(fresh), name)
            kept[name] = digest(paths[name], name, load_encoder)
    finally:
        if fresh or len(kept) != listed:
            write_library(index, [kept[name] for name in paths if name in kept])
    progress("reading scenes", 1.0)
    return read_library(index, folder)


def _digests(library: Library) -> Iterator[Digest]:
    """Yield the entry of every scene of a library, as views of its arrays."""
    pictures = library.thumbnails or {}
    for group in library.groups:
        starts = group.starts
        for row, scene in enumerate(group.scenes):
            place = {"k": 0, "d": 0, "m": 1, "r": 2}
            columns = {
                name: group.columns[name][starts[row, place[of]] : starts[row + 1, place[of]]]
                for name, _, of in COLUMNS
            }
            yield Digest(scene, group.encoder_id, group.canonical, columns, pictures[scene.path])
    yield from map(Digest, library.unread)


def write_library(index: Path, digests: Sequence[Digest]) -> None:
    """Write an index, whole or not at all."""
    groups: list[list[Digest]] = []
    for each in digests:
        if each.canonical is not None:
            alike = [members for members in groups if _same_encoder(members[0], each)]
            groups += [] if alike else [[]]
            (alike or groups)[-1].append(each)
    header = {
        "groups": [
            [members[0].encoder_id, *_canonical(members).shape, [_stated(each.listed) for each in members]]
            for members in groups
        ],
        "unread": [_stated(each.listed) for each in digests if each.canonical is None],
    }
    text = json.dumps(header).encode()
    with atomic_path(index) as temporary, temporary.open("wb") as file:
        file.write(MAGIC + len(text).to_bytes(8, "little") + text + bytes(-len(text) % 8))
        for members in groups:
            file.write(_canonical(members).astype("<f4").tobytes())
            for name, _, _ in COLUMNS:
                for each in members:
                    file.write(b"" if each.columns is None else each.columns[name].tobytes())
            for each in members:
                assert each.thumbnail is not None
                file.write(each.thumbnail.tobytes())
            file.write(bytes(-file.tell() % 8))


def _same_encoder(one: Digest, other: Digest) -> bool:
    assert one.canonical is not None
    assert other.canonical is not None
    return one.encoder_id == other.encoder_id and same_vectors(one.canonical, other.canonical)


def _canonical(members: Sequence[Digest]) -> Array:
    assert members[0].canonical is not None
    return members[0].canonical


def _stated(listed: Listed) -> list[Any]:
    numbers = [None if math.isnan(number) else number for number in listed.numbers]
    return [
        *(listed.path, listed.stamp, listed.counts, numbers if listed.is_indexed else []),
        *(listed.taught, listed.phrases, listed.unread),
    ]


def read_library(index: Path, folder: Path) -> Library:
    """Map an index into memory.

    Raises InputError where it cannot be opened, and FormatError for what breaks a rule of its layout; nothing
    is allocated on the word of its header.
    """
    file, size = open_for_reading(index)
    with file:
        start = file.read(16)
        length = int.from_bytes(start[8:], "little")
        if start[:8] != MAGIC or not 0 < length <= min(size, LONGEST_HEADER):
            raise _refused(index, "it begins otherwise")
        header = parse_json(file.read(length), index)
    try:
        return _mapped(header, index, folder, 16 + length + (-length) % 8, size)
    except (ValueError, TypeError, KeyError, AttributeError, OverflowError) as error:
        raise _refused(index, str(error)[:80]) from None


def _refused(index: Path, why: str) -> FormatError:
    return FormatError(f"{index}: no index of scenes ({why}); remove it, and it is made again")


def _mapped(header: Any, index: Path, folder: Path, at: int, size: int) -> Library:
    data = np.memmap(index, np.uint8, "r")
    groups, pictures, width, height = [], dict[str, Array](), *THUMBNAIL

    def taken(kind: str, count: int) -> Array:
        nonlocal at
        end = at + count * np.dtype(kind).itemsize
        if end > size:
            raise ValueError("shorter than its header says")
        at, part = end, data[at:end]
        return part.view(kind)

    for encoder, phrases, dim, rows in header["groups"]:
        scenes = tuple(map(_listed, rows))
        if not (isinstance(encoder, str) and min(_whole(phrases), _whole(dim)) > 0):
            raise ValueError("a group without an encoder")
        k, m = sum(scene.counts[0] for scene in scenes), sum(scene.counts[4] for scene in scenes)
        lengths = {"k": k, "d": k * dim, "m": m, "r": sum(sum(scene.counts[1:4]) for scene in scenes)}
        canonical = taken("<f4", phrases * dim).reshape(phrases, dim)
        columns = {name: taken(kind, lengths[of]) for name, kind, of in COLUMNS}
        columns["codewords"] = columns["codewords"].reshape(k, dim)
        shown = taken("|u1", len(scenes) * width * height * 3).reshape(len(scenes), height, width, 3)
        at += -at % 8
        pictures |= {scene.path: picture for scene, picture in zip(scenes, shown, strict=True)}
        groups.append(Group(encoder, np.array(canonical), scenes, columns))
    if at != size:
        raise ValueError("longer than its header says")
    return Library(folder, tuple(groups), tuple(map(_listed, header["unread"])), pictures)


def _whole(value: Any) -> int:
    if type(value) is not int or not 0 <= value < 2**62:
        raise ValueError("a count that is none")
    return value


def _listed(row: Any) -> Listed:
    path, stamp, counts, numbers, taught, phrases, unread = row
    if not (isinstance(path, str) and isinstance(unread, str) and all(isinstance(t, str) for t in taught)):
        raise ValueError("a scene without a name")
    if Path(path).is_absolute() or ".." in Path(path).parts:
        raise ValueError("a scene outside of the folder")
    counts = tuple(map(_whole, counts))
    floats = tuple(math.nan if n is None else float(n) for n in numbers) or (math.nan,) * FLOATS
    if len(counts) != 5 or len(floats) != FLOATS or (counts[0] and not np.isfinite(floats[:8]).all()):
        raise ValueError("a scene without its numbers")
    found = Listed(path, tuple(map(_whole, stamp)), counts, floats, tuple(taught), _whole(phrases), unread)
    found.calibration  # noqa: B018  which checks it
    return found


# The first pass: fits of a phrase in all scenes of a group.


def fits_in(group: Group, vector: Array) -> Array:
    """Return the (S, 3) float64 fits of a phrase's (D,) unit vector in every scene, see `QueryResult.fits`.

    They are -inf in scenes that are not indexed. Raises FormatError for an index whose numbers do not fit
    each other.
    """
    arrays, phrase = Columns(**group.columns), np.require(vector, np.float32, "C")
    means, sound = np.zeros(len(arrays.parents)), np.ones(len(group.scenes), bool)
    shared_workers().run(_region_means, len(sound), phrase, arrays, group.starts, means, sound)
    if not sound.all():
        raise FormatError("the index of scenes is damaged; remove it, and it is made again")
    fits = region_fits(group.table, fit_of(means))
    best = fit_of(best_relevancies(group.table, region_relevancies(fits)))
    indexed = np.array([scene.is_indexed for scene in group.scenes], bool)
    return np.where(indexed[:, None], best, -np.inf)


@partial(helper, fastmath={"reassoc", "contract", "nsz"})
def _dot(row: Array, vector: Array) -> np.float32:
    total = np.float32(0)
    for i in range(len(vector)):
        total += np.float32(row[i]) * vector[i]
    return total


@kernel
def _region_means(
    first: int, last: int, vector: Array, columns: Columns, starts: Array, means: Array, sound: Array
) -> None:
    """Add to `means` (R,), of scenes [first, last), the mean relevancy of every region; of a scene with a
    number out of place set `sound` (S,) to False."""
    for scene in range(first, last):
        k, m, r = starts[scene]
        last_k, last_m, last_r = starts[scene + 1]
        relevancy = np.empty(last_k - k, np.float64)
        for i in range(k, last_k):
            cosine = _dot(columns.codewords[i], vector) * columns.steps[i]
            relevancy[i - k] = 1 / (1 + np.exp(-columns.rates[i] * (cosine - columns.zeros[i])))
        for i in range(m, last_m):
            region, word = columns.regions[i], columns.words[i]
            if region >= last_r - r or word >= last_k - k:
                sound[scene] = False
                break
            means[r + region] += columns.shares[i] * relevancy[word]
        for i in range(r, last_r):
            if np.isnan(means[i]) or columns.parents[i] >= last_r - r:
                sound[scene] = False


# Pictures.


def draw(scene: Scene, size: tuple[int, int], answer: QueryResult | None = None) -> Array:
    """(H, W, 3) uint8 picture of a scene, of `size` (width, height).

    With an answer from the training camera nearest to its place that has it in its image, with the answer as
    a heat map.
    """
    if answer is None:
        drawn = render(scene, _camera(scene, size, None))
        return compose(Channels(drawn.colours, drawn.alpha), PictureConfig())
    drawn = render(scene, _camera(scene, size, answer), (answer.even * answer.members)[:, None])
    heat = Channels(drawn.colours, drawn.alpha, drawn.values)
    return compose(heat, PictureConfig(display="relevancy"), (answer.heat_range,))


def _camera(scene: Scene, size: tuple[int, int], answer: QueryResult | None) -> Camera:
    if not scene.cameras:
        return scene.framing_camera(size)
    fitted = [camera.with_intrinsics(camera.intrinsics.fitted(*size)) for camera in scene.cameras]
    if answer is None or answer.place is None:
        return fitted[0]

    def away(camera: Camera) -> float:
        pixels, depth = camera.project(answer.place[None])  # type: ignore[index]
        inside = (np.abs(pixels[0] / size - 0.5) < 0.4).all() and depth[0] > 0
        return float(np.linalg.norm(camera.position - answer.place)) + (0 if inside else 1e9)

    return min(fitted, key=away)
