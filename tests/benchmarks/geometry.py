"""Reports on what is made of a room's Gaussians, against what the room is: `maps`, `meshes`, `clean`."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from scipy.spatial import cKDTree

from assets.making.dataset import photographed_room
from assets.making.objects.furniture import TABLE_HEIGHT
from langsplat_core.arrays import Array, logit, sigmoid
from langsplat_core.extensions.benchmarks.report import markdown
from langsplat_core.extensions.compaction.clean import CleanConfig, clean, find_floaters
from langsplat_core.extensions.compaction.compact import Views, choose_views, mean_psnr
from langsplat_core.extensions.geometry.mesh import fuse
from langsplat_core.extensions.geometry.occupancy import find_occupancy, floor_map, map_axes
from langsplat_core.extensions.geometry.planes import find_room
from langsplat_core.scene import Camera, Gaussians, Scene
from langsplat_core.scene.gaussians import join_gaussians
from tests.benchmarks.oracles import surface_points
from tests.benchmarks.room import HOLD_OUT, InRooms, Room, publish
from tests.benchmarks.scoring import grouped, spread

UP = np.array([0.0, 0.0, 1.0])
DENSITY = 4_000  # true points per square metre
SAMPLES = 200_000  # points of a mesh
FOUND = 0.01  # metres: a true point as near to the mesh is there
TABLE, TOP = 0.75, -0.03  # metres from the middle, and from the table's top upwards: what photographs are of


def scene_of(room: Room) -> Scene:
    return Scene(room.gaussians, cameras=tuple(room.capture.cameras))


def true_points(room: Room) -> Array:
    """(P, 3) points spread evenly over the room's true surfaces, world units, which are metres."""
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
        points, to_map = true_points(room), occupancy.to_map
        true = points @ to_map[:3, :3].T + to_map[:3, 3]
        seen = _taken(occupancy.seen, occupancy.voxels(points))
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
        suspected = find_floaters(scene, views.ranking, config.region).suspicion[of == 0] > 0
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
