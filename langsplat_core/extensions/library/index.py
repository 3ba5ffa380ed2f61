"""Search over all scenes of a folder: ranked by an index of their codebooks, the best ones searched exactly.

The mean relevancies of a scene's regions are mixtures of those of few codewords. So the index has, for every
scene, its codewords in 8 bits, the zero and rate of each (see `Scale`), the codewords of every region with
their shares, and the fits of everyday phrases by chance: with these `query.rule` is followed without opening
the scene, up to rounding. The scenes with the best verdicts are then searched by `QueryEngine`.

The index is a safetensors file: the scenes as JSON in its metadata, and for each group of scenes of one
encoder, `N.`, its canonical vectors, the `Columns` of all its scenes and their thumbnails.
"""

import hashlib
import logging
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from itertools import accumulate, chain, filterfalse
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import msgspec
import numpy as np
import platformdirs
import scipy
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file

from langsplat_core.arrays import Array
from langsplat_core.compiled import helper, kernel, shared_workers
from langsplat_core.errors import EncoderError, FormatError, InputError, LangSplatError, printable_line
from langsplat_core.io.files import atomic_path, is_utf8, locked, shown
from langsplat_core.io.hostile import FromFile, open_for_reading
from langsplat_core.io.scenes import companion_path, format_of, load_scene, scene_files
from langsplat_core.io.sidecar import SUFFIX, read_stored
from langsplat_core.pipeline.notebook import draw
from langsplat_core.progress import Progress, silent
from langsplat_core.query import rule
from langsplat_core.query.answers import QueryResult
from langsplat_core.query.compose import run_phrase
from langsplat_core.query.engine import LoadEncoder, QueryEngine
from langsplat_core.query.grammar import heads, named, parse
from langsplat_core.scene import LEVELS, NO_ORIGIN, Calibration, LanguageField, Scene
from langsplat_core.scene.codec import LinearCodec
from langsplat_core.scene.gaussians import join_gaussians
from langsplat_core.scene.language import phrase_key
from langsplat_core.semantics.encoders import kept_calibration, same_vectors
from langsplat_core.semantics.relevancy import fit_of

log = logging.getLogger("langsplat")
INDEX = ".langsplat-library"  # file name in the folder
SCENES = "scenes 2"  # key of the metadata; an older "scenes" has bars with common fits included
THUMBNAIL = (96, 72)  # width and height, pixels
Whole = Annotated[int, msgspec.Meta(ge=0, lt=2**62)]


class Columns(NamedTuple):
    """The arrays of scenes, one scene after the other: of K codewords, M entries of mixtures, R regions."""

    steps: Array  # (K,) float32: a codeword is its step times its 8-bit row of `codewords`
    zeros: Array  # (K,) float32, see `Scale.of`
    rates: Array  # (K,) float32
    shares: Array  # (M,) float32 of a codeword in the mean of a region
    words: Array  # (M,) uint32 codeword, from 0 in each scene
    regions: Array  # (M,) uint32 region, from 0 in each scene, those of subparts first
    parents: Array  # (R,) int32 region of the level above, from 0 in each scene; -1 for none
    solid: Array  # (R,) uint32 whether it is no crumb
    codewords: Array  # (K, D) int8


KINDS = Columns("<f4", "<f4", "<f4", "<f4", "<u4", "<u4", "<i4", "<u4", "|i1")  # type: ignore[arg-type]
ROWS = Columns(0, 0, 0, 1, 1, 1, 2, 2, 0)  # type: ignore[arg-type]  # column of `EncoderGroup.starts` that counts them


@dataclass(frozen=True)
class Indexed:
    """A scene of the folder in the index."""

    path: str  # below the folder, "/" between names
    stamp: tuple[Whole, ...]  # size and time of change, ns, of each of its files
    codewords: Whole = 0  # number; 0: only the engine can answer, as for other codecs than codebooks
    mixtures: Whole = 0  # number of entries
    regions: tuple[Whole, Whole, Whole] = (0, 0, 0)  # number at each level
    bars: rule.Bars | None = None  # of the fits of everyday phrases; None without codewords
    calibration: Calibration | None = None  # of its encoder
    taught: tuple[str, ...] = ()  # keys of taught words
    phrases: Whole = 0  # in its phrasebook
    unread: str = ""  # why it cannot be searched; one line

    def __post_init__(self) -> None:
        """Raise ValueError for a path out of the folder, or codewords without bars."""
        if Path(self.path).is_absolute() or ".." in Path(self.path).parts:
            raise ValueError("a scene outside of the folder")
        if self.codewords and (self.bars is None or not np.isfinite([bar.median for bar in self.bars]).all()):
            raise ValueError("a scene without its numbers")

    @property
    def is_indexed(self) -> bool:
        """True if the index alone gives a verdict."""
        return self.codewords > 0


@dataclass(frozen=True, eq=False)
class EncoderGroup:
    """The scenes of one encoder, and the arrays of all of them, one after the other."""

    encoder_id: str
    canonical: Array  # (C, D) float32
    scenes: tuple[Indexed, ...]
    columns: Columns

    @cached_property
    def starts(self) -> Array:
        """The (S + 1, 3) int64 offsets of the codewords, mixtures and regions of each scene."""
        sizes = [(each.codewords, each.mixtures, sum(each.regions)) for each in self.scenes]
        return np.cumsum([(0, 0, 0), *sizes], axis=0)

    @cached_property
    def table(self) -> rule.RegionTable:
        """The regions of all scenes, for `query.rule`."""
        counts = np.array([scene.regions for scene in self.scenes], np.int64).reshape(-1, len(LEVELS))
        firsts = np.repeat(self.starts[:-1, 2], counts.sum(1))
        parents = self.columns.parents.astype(np.int64)
        return rule.RegionTable(counts, np.where(parents < 0, -1, parents + firsts), self.columns.solid > 0)


@dataclass(frozen=True, eq=False)
class Library:
    """A folder of scenes with its index."""

    folder: Path
    groups: tuple[EncoderGroup, ...]
    unread: tuple[Indexed, ...] = ()  # scenes that cannot be opened
    thumbnails: Mapping[str, Array] = field(default_factory=dict)  # by path: (H, W, 3) uint8

    @property
    def scenes(self) -> tuple[Indexed, ...]:
        """Scenes that can be searched."""
        return tuple(scene for group in self.groups for scene in group.scenes)


# Scenes of a folder, and their entries.


def scenes_in(folder: Path) -> dict[str, Path]:
    """Return the scenes with a field below a folder by their paths in it, "/" between names.

    There is one per field; hidden folders are left out. Raises InputError without a scene.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; name one with scenes in it")
    found: dict[str, Path] = {}
    for root, folders, files in os.walk(folder):
        for name in filterfalse(is_utf8, (*folders, *files)):
            log.warning("not searched: %s: its name is not UTF-8; rename it", shown(Path(root, name)))
        files[:] = filter(is_utf8, files)
        folders[:] = sorted(name for name in folders if is_utf8(name) and not name.startswith("."))
        fields = {name for name in files if name.endswith(SUFFIX)}
        for path in sorted(Path(root, name) for name in (*files, *folders)) if fields else ():
            field = companion_path(path, SUFFIX).name if format_of(path) is not None else ""
            if field in fields:
                fields.remove(field)
                found[path.relative_to(folder).as_posix()] = path
    if not found:
        raise InputError(f"{folder}: no scene with a language field in it; `langsplat train` makes one")
    return found


def stamp_of(scene: Path) -> tuple[int, ...]:
    """Return size and time of change, ns, of each file of a scene; zeros for a missing file."""
    numbers: list[int] = []
    for file in scene_files(scene):
        try:
            status = file.stat()
            numbers += [status.st_size, status.st_mtime_ns]
        except OSError:
            numbers += [0, 0]
    return tuple(numbers)


@dataclass(frozen=True, eq=False)
class Entry:
    """The entry of one scene in the index."""

    listed: Indexed
    encoder_id: str = ""
    canonical: Array | None = None
    columns: Columns | None = None
    thumbnail: Array | None = None  # (H, W, 3) uint8


def read_entry(path: Path, name: str, load_encoder: LoadEncoder | None) -> Entry:
    """Return the entry of a scene; one that cannot be read, or has no field, has the reason in `unread`."""
    listed = Indexed(name, stamp_of(path))
    try:
        scene = load_scene(path)
        engine = QueryEngine(scene, load_encoder)
        field, picture = engine.field, np.asarray(draw(scene, THUMBNAIL))
    except LangSplatError as error:
        return Entry(replace(listed, unread=str(error)))
    taught = tuple(word.key for word in field.taught)
    listed = replace(listed, taught=taught, phrases=len(field.phrasebook))
    made = Entry(listed, field.encoder_id, field.canonical, None, picture)
    bars = engine.bars
    if field.codec.blends or bars is None or not field.known.any():
        return made
    if not np.isfinite([(bar.median, bar.spread) for bar in bars]).all():
        return made
    columns, regions = _columns(engine), engine.regions.table.counts[0]
    subparts, parts, wholes = (int(count) for count in regions)
    listed = replace(
        listed,
        codewords=len(columns.steps),
        mixtures=len(columns.shares),
        regions=(subparts, parts, wholes),
        bars=bars,
        calibration=field.calibration,
    )
    return replace(made, listed=listed, columns=columns)


def _columns(engine: QueryEngine) -> Columns:
    field, regions, scale = engine.field, engine.regions, engine.scale
    latents, of = field.codec.unique(field.latents[field.known])
    number = np.full(field.known.shape, -1, np.int64)
    number[field.known] = of
    zeros, rates = scale.of(field.codec.cosines(latents, scale.texts))
    vectors = field.codec.decode(latents)
    steps = np.maximum(np.abs(vectors).max(1), 1e-12) / 127
    firsts = accumulate([0, *map(len, regions.totals)])
    mixtures = []
    for level, (totals, first) in enumerate(zip(regions.totals, firsts, strict=False)):
        rows = np.flatnonzero((number[level] >= 0) & (regions.weights > 0))
        entries = regions.weights[rows], (regions.everywhere[level, rows], number[level, rows])
        shares = scipy.sparse.csr_matrix(entries, (len(totals), len(latents))).tocoo()
        mixtures.append((shares.data / totals[shares.row], shares.col, shares.row + first))
    shares, words, rows = (np.concatenate(part) for part in zip(*mixtures, strict=True))
    codewords = np.rint(vectors / steps[:, None])
    table = regions.table
    made = Columns(steps, zeros, rates, shares, words, rows, table.parents, table.solid, codewords)
    return Columns(*(values.astype(kind) for values, kind in zip(made, KINDS, strict=True)))


# The index file.


def update_library(
    folder: Path, load_encoder: LoadEncoder | None = None, progress: Progress = silent
) -> Library:
    """Return the library of a folder, with new and changed scenes read again.

    The index is written if anything changed; an interrupted call keeps the scenes that it has read. A damaged
    index is reported and made again. Raises InputError without scenes.
    """
    index = index_of(folder)
    paths = scenes_in(folder)
    stamps = {name: stamp_of(path) for name, path in paths.items()}
    before = index if os.path.exists(index) else folder / INDEX
    kept, listed = _kept(before, folder, stamps)
    fresh = [name for name in paths if name not in kept]
    try:
        for done, name in enumerate(fresh):
            progress("reading scenes", done / len(fresh), name)
            kept[name] = read_entry(paths[name], name, load_encoder)
    finally:
        if fresh or len(kept) != listed:
            with locked(index.parent):  # keeps entries of other processes, too
                kept = _kept(index, folder, stamps, logging.DEBUG)[0] | kept
                write_library(index, [kept[name] for name in paths if name in kept])
    progress("reading scenes", 1.0)
    return read_library(index if os.path.exists(index) else before, folder)


def index_of(folder: Path) -> Path:
    """Return the path of a folder's index: in the folder or, if that is not writable, in the user's cache."""
    if os.access(folder, os.W_OK):
        return folder / INDEX
    digest = hashlib.sha256(os.fsencode(folder.resolve())).hexdigest()[:16]
    return platformdirs.user_cache_path("langsplat-viewer", appauthor=False) / f"library-{digest}"


def _kept(
    index: Path, folder: Path, stamps: Mapping[str, tuple[int, ...]], level: int = logging.WARNING
) -> tuple[dict[str, Entry], int]:
    """Return the entries of an index whose scenes did not change, and the number of all entries."""
    try:
        old = read_library(index, folder) if os.path.exists(index) else Library(folder, ())
    except FormatError as error:
        log.log(level, "%s", error)
        return {}, 0
    found = {each.listed.path: each for each in _entries(old)}
    same = {path: each for path, each in found.items() if stamps.get(path) == each.listed.stamp}
    return same, len(old.scenes) + len(old.unread)


def _entries(library: Library) -> Iterator[Entry]:
    """Yield the entry of every scene of a library, as views of its arrays."""
    for group in library.groups:
        starts = group.starts
        for row, scene in enumerate(group.scenes):
            ends = starts[row], starts[row + 1]
            columns = Columns(*(
                values[ends[0][of] : ends[1][of]] for values, of in zip(group.columns, ROWS, strict=True)
            ))  # fmt: skip
            yield Entry(scene, group.encoder_id, group.canonical, columns, library.thumbnails[scene.path])
    yield from map(Entry, library.unread)


@dataclass(frozen=True)
class _Stated:
    """Metadata of an index about its scenes."""

    groups: tuple[tuple[str, tuple[Indexed, ...]], ...]  # encoder, and its scenes
    unread: tuple[Indexed, ...]


def _one_encoder(first: Entry, second: Entry) -> bool:
    if first.canonical is None or second.canonical is None or first.encoder_id != second.encoder_id:
        return False
    return same_vectors(first.canonical, second.canonical)


def write_library(index: Path, entries: Sequence[Entry]) -> None:
    """Write an index, atomically."""
    groups: list[list[Entry]] = []
    for each in entries:
        alike = [members for members in groups if _one_encoder(members[0], each)]
        if alike:
            alike[0].append(each)
        elif each.canonical is not None:
            groups.append([each])
    tensors = dict[str, Array]()
    for number, members in enumerate(groups):
        canonical = np.asarray(members[0].canonical, "<f4")
        empty = Columns(*(np.zeros(0, kind) for kind in KINDS))
        empty = empty._replace(codewords=np.zeros((0, canonical.shape[1]), KINDS.codewords))
        parts = [empty, *(each.columns for each in members if each.columns is not None)]
        named = {name: [getattr(part, name) for part in parts] for name in Columns._fields}
        tensors |= {f"{number}.{name}": np.concatenate(arrays) for name, arrays in named.items()}
        tensors[f"{number}.canonical"] = canonical
        tensors[f"{number}.thumbnails"] = np.stack([np.asarray(each.thumbnail) for each in members])
    stated = _Stated(
        tuple((members[0].encoder_id, tuple(each.listed for each in members)) for members in groups),
        tuple(each.listed for each in entries if each.canonical is None),
    )
    with atomic_path(index) as temporary:
        save_file(tensors, temporary, {SCENES: msgspec.json.encode(stated, enc_hook=str).decode()})


def read_library(index: Path, folder: Path) -> Library:
    """Return the library in an index; InputError or FormatError."""
    open_for_reading(index)[0].close()  # the same messages for a missing file as everywhere
    try:
        with safe_open(index, framework="numpy") as file:
            stated = msgspec.json.decode((file.metadata() or {}).get(SCENES, ""), type=_Stated)
            groups, pictures = [], dict[str, Array]()
            for number, (encoder, scenes) in enumerate(stated.groups):
                group, shown = _group(file, number, encoder, scenes)
                groups.append(group)
                pictures |= {scene.path: picture for scene, picture in zip(scenes, shown, strict=True)}
    except (SafetensorError, msgspec.MsgspecError, ValueError) as error:
        why = printable_line(error, 80)
        raise FormatError(f"{index}: no index of scenes ({why}); it is made again") from None
    return Library(folder, tuple(groups), stated.unread, pictures)


def _group(file: Any, number: int, encoder: str, scenes: tuple[Indexed, ...]) -> tuple[EncoderGroup, Array]:
    """Return a group and its (S, H, W, 3) thumbnails; ValueError for arrays that do not fit its scenes."""
    canonical, shown = file.get_tensor(f"{number}.canonical"), file.get_tensor(f"{number}.thumbnails")
    columns = Columns(*(file.get_tensor(f"{number}.{name}") for name in KINDS._fields))
    group = EncoderGroup(FromFile(encoder), canonical, scenes, columns)
    if canonical.dtype != np.float32 or canonical.ndim != 2:
        raise ValueError("a group without an encoder")
    if shown.dtype != np.uint8 or shown.shape != (len(scenes), THUMBNAIL[1], THUMBNAIL[0], 3):
        raise ValueError("scenes without pictures")
    for name, values, kind, of in zip(Columns._fields, group.columns, KINDS, ROWS, strict=True):
        wanted = (group.starts[-1, of], *(canonical.shape[1:] if name == "codewords" else ()))
        if values.dtype != np.dtype(kind) or values.shape != wanted:
            raise ValueError(f"{name} of another length than the scenes have")
        if not np.isfinite(values).all():
            raise ValueError(f"{name} that are not finite")
    codewords, mixtures, regions = np.diff(group.starts, axis=0).T
    inside = [(columns.words, codewords, mixtures), (columns.regions, regions, mixtures)]
    inside += [(columns.parents, regions, regions)]
    for values, most, count in inside:
        if (values >= np.repeat(most, count)).any():
            raise ValueError("numbers of what is not there")
    return group, shown


# Fits of a phrase in all scenes of a group, from the index.


def fits_in(group: EncoderGroup, vector: Array) -> tuple[Array, Array]:
    """Return the (S, 3) float64 fits of a phrase's (D,) unit vector in every scene, and (S,) `common_fits`.

    Fits are as in `QueryResult.fits`, -inf in scenes that are not indexed. Raises FormatError for a vector of
    another length than the index has.
    """
    columns, phrase = group.columns, np.require(vector, np.float32, "C")
    means = np.zeros(len(columns.parents))
    try:
        shared_workers().run(_region_means, len(group.scenes), phrase, columns, group.starts, means)
    except ValueError as error:
        raise FormatError(f"the index of scenes does not fit ({error}); search again") from None
    fits = rule.region_fits(group.table, fit_of(np.nan_to_num(means)))
    best = fit_of(rule.best_relevancies(group.table, rule.region_relevancies(fits)))
    indexed = np.array([scene.is_indexed for scene in group.scenes], bool)
    return np.where(indexed[:, None], best, -np.inf), rule.common_fits(group.table, fits)


@partial(helper, fastmath={"reassoc", "contract", "nsz"})
def _dot(row: Array, vector: Array) -> np.float32:
    total = np.float32(0)
    for i in range(len(vector)):
        total += np.float32(row[i]) * vector[i]
    return total


@partial(
    kernel,
    shapes="vector D, columns.codewords K D, columns.steps K, columns.zeros K, columns.rates K, "
    "columns.shares M, columns.words M, columns.regions M, columns.parents R, means R",
)
def _region_means(
    first: int, last: int, vector: Array, columns: Columns, starts: Array, means: Array
) -> None:
    """Add mean relevancies to `means` (R,)."""
    for scene in range(first, last):
        k, m, r = starts[scene]
        last_k, last_m, _ = starts[scene + 1]
        relevancy = np.empty(last_k - k, np.float64)
        for i in range(k, last_k):
            cosine = _dot(columns.codewords[i], vector) * columns.steps[i]
            relevancy[i - k] = 1 / (1 + np.exp(-columns.rates[i] * (cosine - columns.zeros[i])))
        for i in range(m, last_m):
            means[r + columns.regions[i]] += columns.shares[i] * relevancy[columns.words[i]]


# A phrase in all scenes of a library.


@dataclass(frozen=True, eq=False)
class Hit(rule.Judged):
    """The answer of one scene to a phrase."""

    path: Path
    judgement: rule.Verdict
    answer: QueryResult | None = None  # None: only the index was searched
    metres_per_unit: float | None = None
    origin: Array = field(default_factory=lambda: NO_ORIGIN)  # (3,) of positions in the answer

    @property
    def margin(self) -> float:
        """Margin of the verdict, 0 at the threshold, see `Verdict`."""
        return self.judgement.margin


@dataclass(frozen=True, eq=False)
class Answers:
    """The answers of all scenes of one encoder to a phrase."""

    phrase: str
    encoder_id: str
    hits: tuple[Hit, ...]  # found and weak ones of exact searches first, by margin; then the others
    problem: str = ""  # why nothing was searched
    unread: tuple[tuple[str, str], ...] = ()  # scenes that could not be opened, and why

    def count(self, verdict: rule.Outcome) -> int:
        """Return the number of scenes with this verdict."""
        return sum(hit.verdict == verdict for hit in self.hits)


def find(
    library: Library,
    phrase: str,
    load_encoder: LoadEncoder | None,
    at_most: int = 20,
    progress: Progress = silent,
) -> list[Answers]:
    """Return the answers to a phrase by encoder, best scene first.

    at_most: scenes of each encoder, at most, that are opened and give an answer.
    """
    return [_ask_group(library, group, phrase, load_encoder, at_most, progress) for group in library.groups]


def _ask_group(
    library: Library,
    group: EncoderGroup,
    phrase: str,
    load_encoder: LoadEncoder | None,
    at_most: int,
    progress: Progress,
) -> Answers:
    key, taught = phrase_key(phrase), {name for scene in group.scenes for name in scene.taught}
    try:
        vectors = {text: _vector(library, group, text, load_encoder) for text in heads(parse(phrase, taught))}
    except EncoderError as error:
        if key not in taught:
            return Answers(phrase, group.encoder_id, (), str(error))
        vectors = {}
    rough = zip(group.scenes, rank(group, vectors), strict=True)
    hits = {scene.path: Hit(library.folder / scene.path, verdict) for scene, verdict in rough}
    must = {scene.path for scene in group.scenes if not scene.is_indexed or key in scene.taught}
    exact: dict[str, Hit] = {}
    unread: list[tuple[str, str]] = []
    for name in sorted(hits, key=lambda name: (name not in must, -hits[name].margin)):
        answers = sum(hit.verdict != "not here" for hit in exact.values())
        if name not in must and (hits[name].verdict == "not here" or answers >= at_most):
            break
        progress(f"asking '{phrase}'", answers / max(at_most, 1), name)
        try:
            scene = load_scene(hits[name].path)
            answer = run_phrase(QueryEngine(scene, load_encoder), phrase).answer
        except LangSplatError as error:
            unread.append((name, str(error)))
            del hits[name]
            continue
        vars(answer)["engine"] = None  # else all opened scenes would stay in memory
        exact[name] = Hit(hits[name].path, answer.judgement, answer, scene.metres_per_unit, scene.origin)
    found = [hit for hit in exact.values() if hit.verdict != "not here"]
    others = [hit for hit in (hits | exact).values() if hit not in found]
    ordered = (sorted(some, key=lambda hit: -hit.margin) for some in (found, others))
    return Answers(phrase, group.encoder_id, tuple(chain(*ordered)), unread=tuple(unread))


def rank(group: EncoderGroup, vectors: Mapping[str, Array]) -> list[rule.Verdict]:
    """Return the best verdict on every scene, over some phrases, by the index alone."""
    best = [rule.Verdict(False, "chance", -math.inf)] * len(group.scenes)
    kept = kept_calibration(group.encoder_id, group.canonical)
    for text, vector in vectors.items():
        for row, (scene, fits, common) in enumerate(zip(group.scenes, *fits_in(group, vector), strict=True)):
            if scene.is_indexed:
                scaling = rule.scaling_of(scene.calibration or kept, named(text), text)
                three = rule.triple(fits)
                verdict = rule.judge(three, named(text), "auto", scene.bars, scaling, float(common))
                best[row] = max(best[row], verdict, key=lambda found: found.margin)
    return best


def _vector(library: Library, group: EncoderGroup, text: str, load_encoder: LoadEncoder | None) -> Array:
    """Return the (D,) unit vector of a phrase.

    It is the encoder's, checked against the group's canonical vectors, else that of the first phrasebook with
    the phrase. Raises EncoderError and, for an empty phrase, InputError.
    """
    dim = group.canonical.shape[1]
    codec = LinearCodec(np.eye(1, dim, dtype=np.float32))
    none = np.zeros((len(LEVELS), 0, 1), np.float32), np.zeros((len(LEVELS), 0), np.float32)
    field = LanguageField(*none, codec, group.canonical, group.encoder_id)
    try:
        return QueryEngine(Scene(join_gaussians([]), field), load_encoder).texts.of([text])[0]
    except EncoderError:
        for scene in group.scenes:
            if scene.phrases:
                book = read_stored(companion_path(library.folder / scene.path, SUFFIX)).field.phrasebook
                if phrase_key(text) in book:
                    return book[phrase_key(text)]
        raise
