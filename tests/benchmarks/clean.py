"""`python -m tests.benchmarks clean`: floaters put into rooms, how many `langsplat clean` finds and at what
cost."""

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from scipy.spatial import cKDTree

from langsplat_core.arrays import Array, logit, sigmoid
from langsplat_core.compaction.clean import clean, find_floaters
from langsplat_core.compaction.compact import Views, choose_views, mean_psnr, measuring_views
from langsplat_core.config import CleanConfig
from langsplat_core.progress import TerminalProgress
from langsplat_core.scene import Camera, Gaussians, Scene
from langsplat_core.scene.gaussians import join_gaussians
from tests.benchmarks.room import HOLD_OUT, InRooms, Room, publish

RANGES = ((0.3, 0.95), (0.3, 0.95), (0.03, 0.3))  # opacities of the three kinds
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
    opacities = [rng.uniform(*limits, len(p)) for p, limits in zip(places, RANGES, strict=True)]
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
        with TerminalProgress() as progress:
            rows = [row for room in self.rooms(progress) for row in _clean_room(room)]
        head = (
            "room | measured on | single | clump | veil | room's own lost | suspected | PSNR before | after"
        )
        lines = [f"| {head} | without floaters |", "|---|---|" + "---:|" * 8]
        for row in rows:
            shares = " | ".join(f"{100 * share:.1f} %" for share in (*row.found, row.lost, row.suspected))
            scores = f"{row.psnr_before:.2f} | {row.psnr_after:.2f} | {row.psnr_room:.2f}"
            lines.append(f"| {row.room} | {row.measured_on} | {shares} | {scores} |")
        publish(self, "clean", "Floaters found and removed", "\n".join(lines) + "\n", rows)


def _clean_room(room: Room) -> list[Cleaned]:
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
    rows = []
    for scene, views, basis in runs:
        keep, report = clean(scene, views, config, room.progress)
        of = kinds[: len(keep)]
        suspected = find_floaters(scene, views.ranking, config.region).suspicion[of == 0] > 0
        before, after = (_judged(one, judging) for one in (scene, scene.take(keep)))
        found = tuple(float((~keep[of == kind]).mean()) if (of == kind).any() else 0.0 for kind in (1, 2, 3))
        lost, seen = float((~keep[of == 0]).mean()), float(suspected.mean())
        name = f"{room.tier} {room.seed}"
        rows.append(
            Cleaned(name, basis, found, lost, seen, _judged(own, judging), before, after, report.loss)
        )
    return rows


def _judged(scene: Scene, judging: list[tuple[Any, ...]]) -> float:
    """Mean PSNR against photographs that had no say, dB."""
    found = mean_psnr(scene, measuring_views(scene, *judging))
    assert found is not None
    return found
