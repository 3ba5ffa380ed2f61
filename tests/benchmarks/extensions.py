"""Reports on what else is made of rooms whose truth is known.

* maps, meshes, clean: occupied and free cells, surfaces, and floaters found and removed;
* changed: two captures of one room compared, unchanged and with things moved, removed, brought and painted,
  against what was done.
"""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
from scipy.spatial import cKDTree

from assets.making.dataset import FIRST_ROOM, photographed_room, write_dataset
from assets.making.kit import Kit, Thing, random_colour
from assets.making.objects import BRIGHT, TABLE_TOP
from assets.making.objects.furniture import TABLE_HEIGHT
from assets.making.world import ENLARGED, Placed, StandingArea, assemble, footprint, furnished
from langsplat_core.arrays import Array, logit, sigmoid
from langsplat_core.extensions.benchmarks.report import markdown
from langsplat_core.extensions.compaction.clean import CleanConfig, clean, find_floaters
from langsplat_core.extensions.compaction.compact import Views, choose_views, mean_psnr
from langsplat_core.extensions.geometry.mesh import fuse
from langsplat_core.extensions.geometry.occupancy import find_occupancy, find_room, floor_map, map_axes
from langsplat_core.extensions.library.changes import Change, changes
from langsplat_core.scene import Camera, Gaussians, Scene
from langsplat_core.scene.gaussians import join_gaussians
from tests.benchmarks.oracles import surface_points
from tests.benchmarks.room import HOLD_OUT, InRooms, MaskOrigin, Room, Variant, publish
from tests.benchmarks.scoring import grouped, spread

UP = np.array([0.0, 0.0, 1.0])
DENSITY = 4_000  # true points per square metre
SAMPLES = 200_000  # points of a mesh
FOUND = 0.01  # metres: a true point as near to the mesh is there
TABLE, TOP = 0.75, -0.03  # metres from the middle, and from the table's top upwards: what photographs are of


def scene_of(room: Room) -> Scene:
    return Scene(room.gaussians, cameras=tuple(room.capture.cameras))


def true_points(room: Room) -> Array:
    """Return (P, 3) points spread evenly over the room's true surfaces, world units, which are metres."""
    world = photographed_room(room.seed, room.tier)
    return surface_points(world.vertices, world.triangles, np.random.default_rng(0), density=DENSITY)


def figures(rows: Sequence[Any], names: Sequence[str]) -> list[str]:
    """Mean and deviation of each of the fields."""
    return [spread(np.array([getattr(row, name) for row in rows], float)) for name in names]


@dataclass(frozen=True)
class MapRow:
    """One room; shares in percent."""

    seed: int
    voxels_right: float  # of the occupied ones: a true surface within one and a half cells
    low_voxels_right: float  # of those between the step and the robot's height
    surface_found: float  # of the true surface in voxels that were seen: an occupied one as near
    free_but_true: float  # of the cells of the floor in which something truly stands: said to be free
    ground_mm: float  # error of the floor's height
    up_degrees: float


@dataclass(frozen=True)
class Maps(InRooms):
    """Occupied and free cells of `langsplat map` in rooms whose surfaces are known."""

    resolution: float = 0.05  # metres
    step: float = 0.12
    robot_height: float = 0.5

    def run(self) -> None:
        rows = self.each(self._measure)
        names = list(vars(rows[0]))[1:]
        table = markdown([name.replace("_", " ") for name in names], [figures(rows, names)])
        publish(self, "maps", "Maps for robots", table, rows)

    def _measure(self, room: Room) -> Iterator[MapRow]:
        planes = find_room(scene_of(room))
        occupancy = find_occupancy(scene_of(room), map_axes(planes, 1.0), self.resolution)
        true = occupancy.to_map.points(true_points(room))
        voxels = np.floor((true - occupancy.origin) / self.resolution).astype(np.int64)
        seen = _taken(occupancy.seen, voxels)
        near = 1.5 * self.resolution
        solid = occupancy.origin + (np.argwhere(occupancy.occupied) + 0.5) * self.resolution
        low, band = ((z >= self.step) & (z <= self.robot_height) for z in (solid[:, 2], true[:, 2]))
        precision = cKDTree(true).query(solid)[0] <= near
        recall = cKDTree(solid).query(true[seen])[0] <= near
        plan = floor_map(occupancy, self.step, self.robot_height)
        cells = np.floor((true[band, :2] - plan.origin) / self.resolution).astype(int)
        stands = np.zeros(plan.free.shape, bool)
        stands[tuple(cells[_inside(stands, cells)].T)] = True
        yield MapRow(
            seed=room.seed,
            voxels_right=100 * float(precision.mean()),
            low_voxels_right=100 * float(precision[low].mean()),
            surface_found=100 * float(recall.mean()),
            free_but_true=100 * float((stands & plan.free).sum() / max(stands.sum(), 1)),
            ground_mm=1000 * float(abs(planes.ground + TABLE_HEIGHT)),
            up_degrees=float(np.degrees(np.arccos(np.clip(planes.up @ UP, -1, 1)))),
        )


def _inside(grid: Array, cells: Array) -> Array:
    return np.asarray(((cells >= 0) & (cells < grid.shape)).all(1))


def _taken(grid: Array, cells: Array) -> Array:
    inside = _inside(grid, cells)
    found = np.zeros(len(cells), bool)
    found[inside] = grid[tuple(cells[inside].T)]
    return found


@dataclass(frozen=True)
class MeshRow:
    """One room. The table stands for it and for what stands on it."""

    seed: int
    views: int  # that must agree
    table_median_mm: float  # from the mesh to the nearest true surface
    table_ninetieth_mm: float
    table_found: float  # percent of the true surface, undersides included
    room_median_mm: float  # with floor and walls, which few photographs see and from afar
    voxel_mm: float


@dataclass(frozen=True)
class Meshes(InRooms):
    """Error of `langsplat mesh` in rooms whose surfaces are known, by how many images must agree."""

    agreeing: tuple[int, ...] = (1, 2, 4)
    resolution: float | None = None  # metres; the default of `langsplat mesh`

    def run(self) -> None:
        rows = self.each(self._measure)
        names = list(vars(rows[0]))[2:]
        cells = [(views, *figures(some, names)) for views, some in grouped(rows, "views").items()]
        head = ("views", *(name.replace("_", " ") for name in names))
        publish(self, "meshes", "Meshes", markdown(head, cells), rows)

    def _measure(self, room: Room) -> Iterator[MeshRow]:
        true, world = true_points(room), photographed_room(room.seed, room.tier)
        to_truth = distances_to(world.vertices, world.triangles)
        for views in self.agreeing:
            mesh, side = fuse(scene_of(room), self.resolution, views, progress=room.progress)
            points = surface_points(mesh.vertices, mesh.triangles, np.random.default_rng(0), count=SAMPLES)
            off = 1000 * to_truth(points)
            there = distances_to(mesh.vertices, mesh.triangles)(true[_on_table(true)]) <= FOUND
            middle, most = np.quantile(off[_on_table(points)], [0.5, 0.9])
            shares = 100 * float(there.mean()), float(np.median(off)), 1000 * side
            yield MeshRow(room.seed, views, float(middle), float(most), *shares)


def _on_table(points: Array) -> Array:
    return np.asarray((np.abs(points[:, :2]).max(1) < TABLE) & (points[:, 2] > TOP))


def distances_to(vertices: Array, triangles: Array) -> Callable[[Array], Array]:
    """Distances of (P, 3) points to the nearest place of a mesh (Open3D)."""
    from open3d import core
    from open3d.t.geometry import RaycastingScene

    scene = RaycastingScene()
    scene.add_triangles(core.Tensor(vertices.astype(np.float32)), core.Tensor(triangles.astype(np.uint32)))
    return lambda points: np.asarray(
        scene.compute_distance(core.Tensor(points.astype(np.float32))).numpy(), np.float64
    )


OPACITIES = ((0.3, 0.95), (0.3, 0.95), (0.03, 0.3))  # of the three kinds of floaters
Basis = Literal["photographs", "change", "photographs, nothing put in"]


def with_floaters(gaussians: Gaussians, cameras: list[Camera], seed: int) -> tuple[Gaussians, Array]:
    """The Gaussians of a room with floaters after them, and (M,) the kind of each: 0 of the room, 1 single
    in free space, 2 of a clump of 30, 3 a faint veil before a camera."""
    rng = np.random.default_rng(seed)
    near = cKDTree(gaussians.means[sigmoid(gaussians.opacity_logits) > 0.1])
    low, high = np.quantile(gaussians.means, [0.02, 0.98], axis=0)
    size, typical = float((high - low).max()), float(np.exp(np.median(gaussians.log_scales)))

    def free(count: int, gap: float) -> Array:
        places = rng.uniform(low, high, (200 * count, 3))
        return places[near.query(places)[0] > gap * size][:count]

    single, clump = free(300, 0.04), np.repeat(free(10, 0.08), 30, axis=0)
    clump = clump + rng.normal(scale=0.01 * size, size=clump.shape)
    seen = [cameras[i] for i in rng.integers(0, len(cameras), 40)]
    veil = np.array([c.position + size * rng.uniform(0.08, 0.2) * c.rotation[2] for c in seen])
    veil += rng.normal(scale=0.02 * size, size=veil.shape)
    places: list[Array] = [single, clump, veil]
    scales = [
        rng.uniform(0.5, 3, (len(single), 3)) * typical,
        rng.uniform(0.5, 2, (len(clump), 3)) * typical,
        rng.uniform(0.01, 0.05, (len(veil), 3)) * size,
    ]
    opacities = [rng.uniform(*limits, len(p)) for p, limits in zip(places, OPACITIES, strict=True)]
    means = np.concatenate(places)
    sh = np.zeros((len(means), *gaussians.sh.shape[1:]))
    sh[:, 0] = rng.uniform(-1.5, 1.5, (len(means), 3))
    quats = rng.normal(size=(len(means), 4))
    made = Gaussians(means, np.log(np.vstack(scales)), quats, logit(np.concatenate(opacities)), sh)
    kinds = np.repeat([0, 1, 2, 3], [len(gaussians), *(len(part) for part in places)])
    return join_gaussians([gaussians, made]), kinds


@dataclass(frozen=True)
class Cleaned:
    """One room cleaned one way; shares in [0, 1], PSNR in dB over views that had no say."""

    room: str
    measured_on: Basis
    found: tuple[float, ...]  # of each kind
    lost: float  # of the room's own Gaussians
    suspected: float  # of the room's own
    psnr_room: float  # before anything was put in
    psnr_before: float
    psnr_after: float
    loss: float  # as the report states it


@dataclass(frozen=True)
class Clean(InRooms):
    """Put floaters into rooms and clean them: the share found, the share of the room lost, PSNR."""

    def run(self) -> None:
        rows = self.each(_clean_room)
        head = ("room", "measured on", "single", "clump", "veil", "room's own lost", "suspected")
        lines = [
            (row.room, row.measured_on)
            + tuple(f"{100 * share:.1f} %" for share in (*row.found, row.lost, row.suspected))
            + tuple(f"{psnr:.2f}" for psnr in (row.psnr_before, row.psnr_after, row.psnr_room))
            for row in rows
        ]
        table = markdown((*head, "PSNR before", "after", "without floaters"), lines)
        publish(self, "clean", "Floaters found and removed", table, rows)


def _clean_room(room: Room) -> Iterator[Cleaned]:
    train, held = room.capture.split(HOLD_OUT)
    cameras = [room.capture.cameras[i] for i in train]
    own = Scene(room.gaussians, cameras=tuple(cameras))
    gaussians, kinds = with_floaters(room.gaussians, cameras, room.seed)
    dirty = Scene(gaussians, cameras=tuple(cameras))
    # Every second held-out photograph judges; `clean` is given the others.
    photographs = [(room.capture.cameras[i], room.capture.images[i]) for i in held]
    judging = list(zip(*photographs[::2], strict=True))
    places, images = zip(*photographs[1::2], strict=True)
    given = Views(tuple(cameras), places, images, "photographs")
    config = CleanConfig()
    runs: list[tuple[Scene, Views, Basis]] = [
        (dirty, given, "photographs"),
        (dirty, choose_views(dirty, None, config, room.progress), "change"),
        (own, given, "photographs, nothing put in"),
    ]
    for scene, views, basis in runs:
        keep, report = clean(scene, views, config, room.progress)
        of = kinds[: len(keep)]
        suspected = find_floaters(scene, views.ranking, config.region)[0][of == 0] > 0
        found = tuple(float((~keep[of == kind]).mean()) if (of == kind).any() else 0.0 for kind in (1, 2, 3))
        shares = float((~keep[of == 0]).mean()), float(suspected.mean())
        room_psnr, before, after = (_judged(one, judging) for one in (own, scene, scene.take(keep)))
        psnrs = room_psnr, before, after
        yield Cleaned(f"{room.tier} {room.seed}", basis, found, *shares, *psnrs, report.loss)


def _judged(scene: Scene, judging: list[tuple[Any, ...]]) -> float:
    """Mean PSNR against photographs that had no say, dB."""
    cameras, photographs = judging
    found = mean_psnr(scene, Views((), cameras, photographs, "photographs").measured(scene))
    assert found is not None
    return found


# What changed between two captures of a room.

HALF_TABLE = np.array([0.72, 0.545])  # metres
EACH = 2  # things that are removed, moved, painted, brought, of each room
FAR = 0.2  # metres: the least move
ANOTHER = 5_000  # added to a room's seed: cameras and points of its second capture


@dataclass(frozen=True)
class Done:
    kind: str  # as of `changes.Kind`
    word: str
    centre: tuple[float, float, float]  # metres, of its box, where it is or was
    moved: tuple[float, float, float] = (0, 0, 0)  # metres


def middle(placed: Placed) -> Array:
    """Return (3,) of the upright box around a placed thing, metres."""
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
    seed: int
    what: str  # "unchanged" or "changed"
    done: int
    found: tuple[str, ...]  # things whose change was said, as what it was
    missed: tuple[str, ...]
    false: tuple[str, ...]  # what was said and was not done
    errors: tuple[float, ...]  # of the moves that were found, metres
    seconds: float


def measure_changes(room: Room, masks: MaskOrigin) -> Iterator[Said]:
    captures = {"unchanged": SecondCapture(room, None), "changed": SecondCapture(room, alter)}
    variant = Variant("the method", masks)
    first = room.engine(variant, room.capture.cameras)
    for what, second in captures.items():
        other, start = second.engine(variant, second.capture.cameras), time.perf_counter()
        said = changes(first, other)
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
    names = ["room", "second capture", "done", "found", "missed", "false", "error of moves, cm", "seconds"]
    lines = (
        (row.seed, row.what, row.done, len(row.found), ", ".join(row.missed) or "0")
        + ("; ".join(row.false) or "0", ", ".join(f"{100 * error:.1f}" for error in row.errors) or "-")
        + (f"{row.seconds:.0f}",)
        for row in rows
    )
    return markdown(names, lines)
