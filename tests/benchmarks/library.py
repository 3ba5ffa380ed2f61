"""Reports on several scenes, in rooms with known truth.

* found: the first pass of a search over many scenes against the engine's own answers, and its time over many
  synthetic codebooks;
* changed: two captures of one room compared, unchanged and with things moved, removed, brought and painted,
  against what was done.
"""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory

import numpy as np

from assets.making.dataset import FIRST_ROOM, write_dataset
from assets.making.kit import Kit, Thing, random_colour
from assets.making.objects import BRIGHT, TABLE_TOP
from assets.making.world import ENLARGED, Placed, StandingArea, assemble, footprint, furnished
from langsplat_core.arrays import Array, unit
from langsplat_core.config import CountOrZero
from langsplat_core.extensions.benchmarks.report import markdown
from langsplat_core.extensions.library.changes import Change, changes
from langsplat_core.extensions.library.index import (
    KINDS,
    THUMBNAIL,
    Columns,
    Digest,
    Listed,
    digest,
    fits_in,
    rank,
    read_library,
    write_library,
)
from langsplat_core.io.scenes import save_scene
from langsplat_core.query.grammar import named
from langsplat_core.query.rule import Bar, judge, triple
from langsplat_core.raster import load_lifting_rasterizer
from tests.benchmarks.room import InRooms, MaskOrigin, Room, Variant, publish
from tests.benchmarks.scoring import grouped, seconds_of

CODEWORDS, DIM, REGIONS, MIXED = 256, 512, (120, 80, 40), 4  # of a synthetic scene; codewords of a region
PHRASES = 12  # that are timed


@dataclass(frozen=True)
class Found(InRooms):
    """Every phrase in every room by the index alone, against the engine; and the index's time at scale."""

    masks: tuple[MaskOrigin, ...] = ("truth", "graph")  # where outlines come from
    scenes: CountOrZero = 10_000  # synthetic ones, 220 KB each in the temporary folder; 0: none

    def run(self) -> None:
        rows = self.each(lambda room: [row for masks in self.masks for row in compare(room, masks)])
        text = agreement_table(rows)
        if self.scenes:
            text += "\n" + timing_line(self.scenes)
        publish(self, "library", "Search over many scenes", text, [row for row in rows if row.far])


@dataclass(frozen=True)
class Compared:
    """One phrase in one scene, by the index and by the engine."""

    seed: int
    masks: str
    text: str
    index: str  # verdict
    engine: str
    error: float  # largest difference of a fit, spreads

    @property
    def far(self) -> bool:
        """Whether the verdicts differ."""
        return self.index != self.engine


def compare(room: Room, masks: MaskOrigin) -> Iterator[Compared]:
    """All phrases that are there and that are not."""
    engine = room.engine(Variant("the method", masks))
    with TemporaryDirectory() as folder:
        path = Path(folder, "scene.ply")
        save_scene(path, replace(engine.scene, cameras=tuple(room.held_out)))
        write_library(Path(folder, "index"), [digest(path, path.name, lambda _: room.encoder)])
        group = read_library(Path(folder, "index"), Path(folder)).groups[0]
        for answer in engine.run_many([text for text in room.texts if not engine.unknown_words(text)]):
            fits = fits_in(group, engine.text_vectors([answer.phrase])[0])[0]
            scene, kind = group.scenes[0], named(answer.phrase)
            verdict = judge(triple(fits), kind, "auto", scene.bars, scene.calibration).outcome
            error = float(np.abs(fits - answer.fits).max())
            yield Compared(room.seed, masks, answer.phrase, verdict, answer.verdict, error)


def agreement_table(rows: Sequence[Compared]) -> str:
    """A row for each kind of masks."""
    lines = []
    for masks, own in grouped(rows, "masks").items():
        there = [row for row in own if row.engine != "not here"]
        missed = sum(row.index == "not here" for row in there)
        errors = [row.error for row in own]
        counts = (len(own), len(there), missed, sum(row.far for row in own))
        lines.append((masks, *counts, f"{median(errors):.4f}", f"{max(errors):.4f}"))
    names = ["masks", "asked", "found or weak", "missed", "other verdict", "median error", "largest error"]
    return markdown(names, lines)


def timing_line(count: int) -> str:
    """Time of a phrase over so many synthetic scenes, median and longest, with a warm file."""
    rng = np.random.default_rng(0)
    vectors = unit(rng.normal(size=(PHRASES, DIM))).astype(np.float32)
    with TemporaryDirectory() as folder:
        index = Path(folder, "index")
        write_library(index, [synthetic(k) for k in range(count)])
        start = time.perf_counter()
        group = read_library(index, Path(folder)).groups[0]
        opened, size = time.perf_counter() - start, index.stat().st_size
        seconds = [seconds_of(partial(rank, group, {"mug": vector})) for vector in vectors]
    middle, longest = median(seconds[2:]), max(seconds[2:])
    return (
        f"{count} codebooks of {CODEWORDS} x {DIM} in 8 bits, {size / 1e9:.2f} GB: opened in {opened:.2f} s, "
        f"a phrase in {middle:.2f} s (longest {longest:.2f} s)\n"
    )


def synthetic(seed: int) -> Digest:
    """A scene of random codewords and regions, as the index keeps it."""
    rng, regions = np.random.default_rng(seed), sum(REGIONS)
    one, two, three = REGIONS
    parents = np.concatenate([
        one + rng.integers(two, size=one), one + two + rng.integers(three, size=two), np.full(three, -1)
    ])  # fmt: skip
    columns = Columns(
        steps=np.full(CODEWORDS, DIM**-0.5 / 30),
        zeros=np.full(CODEWORDS, 0.1),
        rates=np.full(CODEWORDS, 25.0),
        shares=np.full(regions * MIXED, 1 / MIXED),
        words=rng.integers(CODEWORDS, size=regions * MIXED),
        regions=np.repeat(np.arange(regions), MIXED),
        parents=parents,
        solid=np.ones(regions),
        codewords=rng.integers(-60, 61, (CODEWORDS, DIM)),
    )
    made = Columns(*(values.astype(kind) for values, kind in zip(columns, KINDS, strict=True)))
    bars = (Bar(0.0, 1.0),) * 4
    listed = Listed(f"{seed}.ply", (seed,), CODEWORDS, regions * MIXED, REGIONS, bars)
    width, height = THUMBNAIL
    picture = np.zeros((height, width, 3), np.uint8)
    return Digest(listed, "synthetic", np.eye(4, DIM, dtype=np.float32), made, picture)


# What changed between two captures of a room.

HALF_TABLE = np.array([0.72, 0.545])  # metres
EACH = 2  # things that are removed, moved, painted, brought, of each room
FAR = 0.2  # metres: the least move
ANOTHER = 5_000  # added to a room's seed: cameras and points of its second capture


@dataclass(frozen=True)
class Done:
    """What was done to one thing."""

    kind: str  # as of `changes.Kind`
    word: str
    centre: tuple[float, float, float]  # metres, of its box, where it is or was
    moved: tuple[float, float, float] = (0, 0, 0)  # metres


def middle(placed: Placed) -> Array:
    """(3,) of the upright box around a placed thing, metres."""
    points = np.concatenate([piece.mesh.vertices for piece in placed.thing.pieces])
    points = (points * placed.scale) @ placed.turn.T + placed.offset
    return np.asarray((points.min(0) + points.max(0)) / 2)


def alter(seed: int, placed: list[Placed]) -> tuple[list[Placed], list[Done]]:
    """A room with two things each removed, painted another colour, moved and brought; and what was done."""
    rng = np.random.default_rng((seed, 23))
    room, done = list(placed), list[Done]()
    on_table = [item for item in room if _is_alone(item, room)]
    order = [on_table[k] for k in rng.permutation(len(on_table))]

    def note(kind: str, item: Placed, moved: Array | None = None) -> None:
        shift = np.zeros(3) if moved is None else moved
        x, y, z = middle(item).tolist()
        done.append(Done(kind, item.thing.word, (x, y, z), tuple(shift.tolist())))

    for item in order[:EACH]:
        room = [other for other in room if other is not item]
        note("gone", item)
    painted = [item for item in order[EACH:] if _coloured(item)][:EACH]
    for item in painted:
        new = str(rng.choice([word for word in BRIGHT if word != item.thing.colour]))
        room = [_painted(item, new, rng) if other is item else other for other in room]
        note("recoloured", item)
    for item in order[EACH:]:
        if item in painted or sum(one.kind == "moved" for one in done) == EACH:
            continue
        there = _stand(item.thing, [other for other in room if other is not item], rng)
        if there is not None and np.linalg.norm(middle(there) - middle(item)) >= FAR:
            room = [there if other is item else other for other in room]
            note("moved", item, middle(there) - middle(item))
    for item in _brought(room, {item.thing.word for item in placed}, rng):
        room.append(item)
        note("appeared", item)
    return room, done


def _stand(thing: Thing, room: list[Placed], rng: np.random.Generator) -> Placed | None:
    """A thing at a free place on the table; None where there is no room."""
    others = [footprint(item) for item in room if item.offset[2] > -0.1]
    return StandingArea(np.zeros(3), HALF_TABLE, 0.012, ENLARGED, taken=others).stand(thing, rng)


def _brought(room: list[Placed], here: set[str], rng: np.random.Generator) -> list[Placed]:
    """Things of kinds that are not `here`, on free places of the table."""
    new, kit = list[Placed](), Kit(rng)
    for word in map(str, rng.permutation(list(TABLE_TOP))):
        if len(new) < EACH and word not in here:
            builder, colours = TABLE_TOP[word]
            item = _stand(builder(kit, kit.pick(*colours)), [*room, *new], rng)
            new += [] if item is None else [item]
    return new


def _is_alone(item: Placed, room: list[Placed]) -> bool:
    """Whether a thing stands on the table, and neither in a bowl nor with something in it."""
    hosts = [other for other in room if other.thing.word in ("bowl", "plate")]
    on_table = item.thing.word in TABLE_TOP and abs(item.offset[2]) < 0.05 and item not in hosts
    inside = bool((np.abs(footprint(item).mean(0)) < HALF_TABLE).all())
    return on_table and inside and not any(_on(item, host) for host in hosts)


def _on(item: Placed, host: Placed) -> bool:
    return item is not host and bool(np.linalg.norm((item.offset - host.offset)[:2]) < 0.12)


def _coloured(item: Placed) -> bool:
    """Whether most of a thing's surface has the colour that it is called by."""
    sizes = [np.ptp(piece.mesh.vertices, 0).prod() ** (2 / 3) for piece in item.thing.pieces]
    own = [piece.material.word == item.thing.colour != "" for piece in item.thing.pieces]
    return float(np.dot(sizes, own)) > 0.6 * sum(sizes)


def _painted(item: Placed, word: str, rng: np.random.Generator) -> Placed:
    colour, old = random_colour(word, rng), item.thing.colour
    pieces = list(item.thing.pieces)
    for row, piece in enumerate(pieces):
        if piece.material.word == old:
            material = replace(piece.material, word=word, colour=colour, second=colour)
            pieces[row] = replace(piece, material=material)
    return replace(item, thing=replace(item.thing, colour=word, pieces=tuple(pieces)))


class SecondCapture(Room):
    """The room of a seed photographed again, from other places, and trained with another seed."""

    def __init__(
        self, first: Room, change: Callable[[int, list[Placed]], tuple[list[Placed], list[Done]]] | None
    ):
        room = (first.config, first.tier, first.seed, first.folder.parent, (first.encoder, first.weights))
        super().__init__(*room, first.progress)
        self.change = change
        name = "again" if change is None else "changed"
        self.folder = first.folder.with_name(f"{first.folder.name}-{name}")
        radiance = replace(self.settings.radiance, seed=1)
        self.settings = replace(self.settings, radiance=radiance)

    @cached_property
    def photographs(self) -> Path:
        folder, config = self.folder / "photographs", self.config
        if not (folder / "transforms.json").exists():
            world = assemble(self._altered[0])
            seed = self.seed + ANOTHER * (1 if self.change is None else 2)
            write_dataset(folder, seed, config.views, config.size, self.progress, self.tier, world=world)
        return folder

    @cached_property
    def _altered(self) -> tuple[list[Placed], list[Done]]:
        placed = furnished(FIRST_ROOM + self.seed, self.tier)
        return (placed, []) if self.change is None else self.change(self.seed, placed)

    @property
    def done(self) -> list[Done]:
        """What was done to the room since the first capture."""
        return self._altered[1]


NEAR = 0.12  # metres between where a change was and where it is said


@dataclass(frozen=True)
class Changed(InRooms):
    """Rooms captured twice, unchanged and with two things each removed, painted, moved and brought: which of
    these are said, and what is said besides. A room takes three trainings."""

    masks: MaskOrigin = "truth"  # where outlines come from

    def run(self) -> None:
        rows = self.each(lambda room: measure_changes(room, self.masks))
        publish(self, "changed", "What changed between two captures", change_table(rows), rows)


@dataclass(frozen=True)
class Said:
    """Two captures of a room compared."""

    seed: int
    what: str  # "unchanged" or "changed"
    done: int
    found: tuple[str, ...]  # things whose change was said, as what it was
    missed: tuple[str, ...]
    false: tuple[str, ...]  # what was said and was not done
    errors: tuple[float, ...]  # of the moves that were found, metres
    seconds: float


def measure_changes(room: Room, masks: MaskOrigin) -> Iterator[Said]:
    """The first capture against an unchanged and a changed second one."""
    captures = {"unchanged": SecondCapture(room, None), "changed": SecondCapture(room, alter)}
    variant, rasterizer = Variant("the method", masks), load_lifting_rasterizer("cpu")
    first = room.engine(variant, room.capture.cameras)
    for what, second in captures.items():
        other, start = second.engine(variant, second.capture.cameras), time.perf_counter()
        said = changes(first, other, rasterizer)
        yield matched(room.seed, what, second.done, said, time.perf_counter() - start)


def matched(seed: int, what: str, done: Sequence[Done], said: Sequence[Change], seconds: float) -> Said:
    """What was said beside what was done: of one kind, and near."""
    left, found, missed, errors = list(said), list[str](), list[str](), list[float]()
    for one in done:
        place = np.add(one.centre, one.moved)
        near = [c for c in left if c.kind == one.kind and np.linalg.norm(c.centre - place) < NEAR]
        (found if near else missed).append(f"{one.kind} {one.word}")
        if near:
            best = min(near, key=lambda change: float(np.linalg.norm(change.centre - place)))
            left = [change for change in left if change is not best]
            if best.moved is not None:
                errors.append(float(np.linalg.norm(best.moved - one.moved)))
    false = tuple(f"{change.kind}, {change.pixels:.0f} pixels" for change in left)
    return Said(seed, what, len(done), tuple(found), tuple(missed), false, tuple(errors), seconds)


def change_table(rows: Sequence[Said]) -> str:
    """A row for each comparison."""
    names = ["room", "second capture", "done", "found", "missed", "false", "error of moves, cm", "seconds"]
    lines = (
        (row.seed, row.what, row.done, len(row.found), ", ".join(row.missed) or "0")
        + ("; ".join(row.false) or "0", ", ".join(f"{100 * error:.1f}" for error in row.errors) or "-")
        + (f"{row.seconds:.0f}",)
        for row in rows
    )
    return markdown(names, lines)
