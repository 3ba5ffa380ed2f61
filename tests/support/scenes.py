"""Small seeded scenes, answers and views with masks that many tests share."""

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal

import numpy as np
from scipy.spatial.transform import Rotation

from langsplat_core.arrays import Array, logit, rotation_matrices, unit
from langsplat_core.config import INRIA, RadianceConfig, RasterSettings
from langsplat_core.datasets.capture import Capture
from langsplat_core.query.answers import Regions, build_regions
from langsplat_core.raster.protocol import LiftingRasterizer
from langsplat_core.raster.reference import ReferenceRasterizer, colours
from langsplat_core.scene import SH_COUNTS, Camera, Gaussians, LanguageField, LinearCodec, Scene, look_at
from langsplat_core.scene.language import NO_NODE, Tree
from langsplat_core.scene.surface import Surface, build_surface, build_tree, surface_weights
from langsplat_core.scene.transform import C0
from langsplat_core.semantics.features import ImageFeatures
from langsplat_core.training.language.lift import MaskWeights, view_pairs

DEMO = Path(str(files("langsplat_assets"))) / "demo" / "scene.ply"  # the bundled scene


def random_gaussians(
    n: int,
    seed: int = 0,
    sh_degree: int = 0,
    *,
    radius: float = 1.0,
    scale_range: tuple[float, float] = (0.02, 0.25),
) -> Gaussians:
    """`n` Gaussians in a ball of `radius` world units around the origin, of quaternions of any length."""
    rng = np.random.default_rng(seed)
    directions = rng.normal(size=(n, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    means = directions * radius * rng.uniform(size=(n, 1)) ** (1 / 3)
    sh = rng.normal(scale=0.25, size=(n, SH_COUNTS[sh_degree], 3))
    sh[:, 0] = rng.uniform(-1.7, 1.7, size=(n, 3))
    return Gaussians(
        means=means,
        log_scales=np.log(rng.uniform(*scale_range, size=(n, 3)) * radius),
        quats_wxyz=rng.normal(size=(n, 4)) * rng.uniform(0.5, 2.0, size=(n, 1)),
        opacity_logits=logit(rng.uniform(0.05, 0.99, size=n)),
        sh=sh,
    )


def unturned_gaussians(
    means: Array, log_scales: Array | float, opacity_logits: Array | float, sh: Array | float = 0.0
) -> Gaussians:
    """Gaussians along the world's axes, of SH degree 0; a number is the same for all of them."""
    n = len(means)
    scales, opacities, colours = (
        np.broadcast_to(values, shape).copy()
        for values, shape in ((log_scales, (n, 3)), (opacity_logits, n), (sh, (n, 1, 3)))
    )
    return Gaussians(means, scales, np.tile([1.0, 0, 0, 0], (n, 1)), opacities, colours)


def random_camera(
    seed: int = 0, width: int = 70, height: int = 45, *, distance: float = 3.0, off_centre: bool = True
) -> Camera:
    """A camera that looks roughly at the origin; off_centre: the principal point, and fx differs from fy."""
    rng = np.random.default_rng(seed)
    eye = rng.normal(size=3)
    eye *= distance / np.linalg.norm(eye)
    camera = look_at(eye, rng.uniform(-0.2, 0.2, size=3), rng.normal(size=3), (width, height))
    if not off_centre:
        return camera
    cx, cy = width * rng.uniform(0.35, 0.65), height * rng.uniform(0.35, 0.65)
    return Camera(width, height, camera.fx * 1.1, camera.fy * 0.95, cx, cy, camera.world_to_camera)


def ring(
    count: int, size: tuple[int, int] = (64, 48), radius: float = 3.0, centre: Array | float = 0.0
) -> list[Camera]:
    """Cameras on a circle about z, a third of its radius above the centre, at which they look."""
    around = 2 * np.pi * np.arange(count) / count
    eyes = radius * np.stack([np.cos(around), np.sin(around), np.full(count, 1 / 3)], 1)
    middle = np.zeros(3) + centre
    return [look_at(middle + eye, middle, np.array([0.0, 0.0, 1.0]), size) for eye in eyes]


def transforms(cameras: Sequence[Camera], files: Sequence[str], **more: object) -> str:
    """nerfstudio's transforms.json of cameras of one lens and their photographs; more: at its top."""
    one = cameras[0]
    lens = {"fl_x": one.fx, "fl_y": one.fy, "cx": one.cx, "cy": one.cy, "w": one.width, "h": one.height}
    poses = [np.linalg.inv(camera.world_to_camera) @ np.diag([1.0, -1, -1, 1]) for camera in cameras]
    named = zip(files, poses, strict=True)
    frames = [{"file_path": file, "transform_matrix": pose.tolist()} for file, pose in named]
    return json.dumps({**lens, **more, "frames": frames})


def without_perspective(camera: Camera, distance: float = 3.0) -> Camera:
    """The orthographic camera that sees what is `distance` world units away as large."""
    return replace(camera, fx=camera.fx / distance, fy=camera.fy / distance, orthographic=True)


def covariances(g: Gaussians) -> Array:
    """Return (N, 3, 3) in world units, float64."""
    axes = rotation_matrices(g.quats_wxyz.astype(float)) * np.exp(g.log_scales.astype(float))[:, None]
    return axes @ axes.transpose(0, 2, 1)


def random_values(n: int, channels: int, seed: int = 0) -> Array:
    """(n, channels) float32 values in [0, 1)."""
    return np.random.default_rng(seed).uniform(size=(n, channels)).astype(np.float32)


def shifted(gaussians: Gaussians, camera: Camera, offset: Array) -> tuple[Gaussians, Camera]:
    """The same picture with the world's origin moved by `offset` (3,), up to rounding of the means."""
    moved = replace(gaussians, means=gaussians.means.astype(np.float64) + offset)
    matrix = camera.world_to_camera.copy()
    matrix[:3, 3] -= camera.rotation @ np.asarray(offset, np.float64)
    return moved, replace(camera, world_to_camera=matrix)


PLY_TYPES = ("i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8")


def random_extras(count: int = 40) -> dict[str, Array]:
    """One property of every PLY type, each with its extremes in the first rows."""
    rng = np.random.default_rng(3)
    extras = {}
    for code in PLY_TYPES:
        dtype = np.dtype(code)
        values = rng.integers(0, 100, size=count).astype(dtype)
        limits = np.finfo(dtype) if dtype.kind == "f" else np.iinfo(dtype)
        values[:2] = limits.min, limits.max
        extras[f"extra_{code}"] = values
    extras["extra_f4"][2:4] = np.nan, np.inf
    return extras


@dataclass(frozen=True, eq=False)
class Answer:
    """The part of a query's result that displays show."""

    relevancy: Array  # (3, N)
    members: Array  # (N,) bool
    level: int = 2
    verdict: Literal["found", "weak match", "not here"] = "found"
    heat_range: tuple[float, float] = (0.5, 0.9)

    @property
    def smooth(self) -> Array:
        return (self.relevancy[self.level] + self.even) / 2

    @property
    def even(self) -> Array:
        return np.where(self.members, np.float32(0.75), np.float32(0.3))


def tree_of(scene: Scene, surface: Surface | None = None) -> Tree:
    """The tree that is built of a scene with a field; wholes of one that it has stay wholes, voted for."""
    field = scene.language
    assert field is not None
    built = surface or build_surface(scene.gaussians), field.codec, field.latents, field.known
    if field.tree is None:
        return build_tree(*built)
    wholes = field.tree.leaves
    tree = build_tree(*built, np.stack([*2 * [np.full(len(wholes), NO_NODE)], wholes]))
    votes, at = tree.votes.copy(), tree.at(2)
    votes[np.unique(at[(wholes != NO_NODE) & (at != NO_NODE)]), 0] = 1
    return replace(tree, votes=votes)


def regions_of(scene: Scene, surface: Surface | None = None) -> Regions:
    """The regions of the tree that is built of a scene."""
    return build_regions(tree_of(scene, surface), surface_weights(scene.gaussians))


def with_tree(scene: Scene) -> Scene:
    """`scene` with its tree in its field."""
    assert scene.language is not None
    return replace(scene, language=replace(scene.language, tree=tree_of(scene)))


def tree_of_wholes(things: Array) -> Tree:
    """(N,) number, from 0, of each Gaussian's thing, NO_NODE for none -> a tree of these alone, voted for."""
    count = int(things.max(initial=NO_NODE)) + 1
    votes = np.tile(np.array([1, 0], np.uint16), (count, 1))
    parents, levels = np.full(count, NO_NODE, np.int32), np.full(count, 2, np.uint8)
    return Tree(things.astype(np.int32), parents, levels, votes)


def chain_of_levels(leaves: Array) -> Tree:
    """Map (N,) int32 numbers from 0, NO_NODE for none to a tree of these sets, the same at all levels."""
    count = int(leaves.max(initial=-1)) + 1
    parents = np.concatenate([np.arange(count, 3 * count), np.full(count, -1)]).astype(np.int32)
    levels = np.repeat(np.arange(3, dtype=np.uint8), count)
    return Tree(leaves, parents, levels, np.zeros((3 * count, 2), np.uint16))


def random_answer(count: int, seed: int, **changed: Any) -> Answer:
    relevancy = np.stack([random_values(count, 1, seed + level)[:, 0] for level in range(3)])
    return Answer(relevancy, relevancy[2] > 0.5, **changed)


def random_scene(count: int = 150, sh_degree: int = 3) -> Scene:
    """Random Gaussians, each with random latents of 3 numbers."""
    latents = np.random.default_rng(count).normal(size=(3, count, 3)).astype(np.float32)
    axes = np.eye(12, dtype=np.float32)
    field = LanguageField(latents, np.ones((3, count), np.float32), LinearCodec(axes[:3]), axes[:4], "none")
    return Scene(random_gaussians(count, sh_degree=sh_degree), field)


LIFTED_DIM = 12


def make_views(count: int = 3) -> list[tuple[Camera, ImageFeatures]]:
    """Cameras with random labels at three levels; the subpart level has no masks at all."""
    views = []
    for seed in range(count):
        rng = np.random.default_rng(seed)
        camera = random_camera(seed, 24, 18)
        labels = np.full((3, 18, 24), -1, np.int32)
        labels[1] = rng.integers(-1, 4, (18, 24))
        labels[2] = rng.integers(4, 7, (18, 24))
        vectors = unit(rng.normal(size=(7, LIFTED_DIM))).astype(np.float32)
        views.append((camera, ImageFeatures(labels, vectors)))
    return views


def dense_weights(gaussians: Gaussians, camera: Camera) -> np.ndarray:
    """Return (H, W, N): column i is the splat of the i-th unit vector."""
    return ReferenceRasterizer().view(gaussians, camera).splat(np.eye(len(gaussians)))[0]


# A room of flat Gaussians whose planes are known: a floor, four walls, a table and blocks on it.

FLOOR, WALL = -0.7, 2.0  # height of the floor; distance of the walls from the middle
STEP = 0.1


def _sheet(centre: Array, first: Array, second: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    """Points over the rectangle centre +- first +- second, jittered in it, and their normals."""
    counts = [max(round(2 * float(np.linalg.norm(side)) / STEP), 1) for side in (first, second)]
    u, v = np.meshgrid(*(np.linspace(-1, 1, count) for count in counts))
    uv = np.stack([u.ravel(), v.ravel()], 1) + rng.uniform(-0.3, 0.3, (u.size, 2)) / counts
    normal = np.cross(first, second) / np.linalg.norm(np.cross(first, second))
    return centre + uv @ np.stack([first, second]), np.tile(normal, (u.size, 1))


def box_room(seed: int = 0) -> Scene:
    """The room of a seed, which decides what stands on the table; z is up."""
    rng = np.random.default_rng(seed)
    x, y, z = np.eye(3)
    parts = [_sheet(FLOOR * z, WALL * x, WALL * y, rng)]
    for side in (x, -x, y, -y):
        across = np.cross(z, side)
        parts.append(_sheet(WALL * side + (FLOOR + 0.7) * z, WALL * across, 0.7 * z, rng))
    blocks = [(np.zeros(3), np.array([0.8, 0.5, 0.03]))]
    for _ in range(7):
        half = rng.uniform(0.06, 0.25, 3)
        blocks.append((np.array([*rng.uniform(-0.6, 0.6, 1), *rng.uniform(-0.35, 0.35, 1), half[2]]), half))
    blocks += [(np.array([1.5, rng.uniform(-1, 1), FLOOR + 0.3]), np.array([0.3, 0.4, 0.3]))]
    for centre, half in blocks:
        for axis in range(3):
            first, second = np.diag(half)[[(axis + 1) % 3, (axis + 2) % 3]]
            for sign in (-1, 1):
                offset = np.zeros(3)
                offset[axis] = sign * half[axis]
                parts.append(_sheet(centre + offset, first, second, rng))
    points, normals = (np.concatenate(column) for column in zip(*parts, strict=True))
    ways, which = np.unique(normals, axis=0, return_inverse=True)
    turns = [Rotation.align_vectors([way], [[0, 0, 1]])[0].as_quat() for way in ways]
    gaussians = Gaussians(
        means=points,
        log_scales=np.tile(np.log([STEP, STEP, 0.003]), (len(points), 1)),
        quats_wxyz=np.array(turns)[which.reshape(-1)][:, [3, 0, 1, 2]],
        opacity_logits=np.full(len(points), 4.0),
        sh=rng.normal(size=(len(points), 1, 3)),
    )
    angles = np.linspace(0, 2 * np.pi, 8, endpoint=False)
    eyes = [np.array([1.4 * np.cos(a), 1.4 * np.sin(a), 0.5]) for a in angles]
    return Scene(gaussians, cameras=tuple(look_at(eye, FLOOR / 2 * z, z, (96, 72), 70) for eye in eyes))


# A tiny scene drawn by the reference rasterizer, and settings of a short training on it.


SIZE = (48, 48)


SHORT = RadianceConfig(  # its own reference, so that nothing is rescaled: 40 steps with all that happens
    steps=40,
    reference_steps=40,
    backend="cpu",
    sh_degree=1,
    sh_degree_every=15,
    densify_from=4,
    densify_until=30,
    densify_every=10,
    opacity_reset_every=25,
    coarse_fraction=0.25,
    max_gaussians=1_300,
)


def picture(gaussians: Gaussians, camera: Camera, settings: RasterSettings = INRIA) -> Array:
    """Return (H, W, 3) float64 colours on black, by the reference."""
    values = colours(gaussians.sh, gaussians.means, camera.position)
    return ReferenceRasterizer().view(gaussians, camera, settings).splat(values)[0]


@cache
def truth() -> Gaussians:
    rng = np.random.default_rng(3)
    count = 40
    sh = np.zeros((count, 1, 3))
    sh[:, 0] = (rng.random((count, 3)) - 0.5) / C0
    return Gaussians(
        rng.uniform(-1, 1, (count, 3)),
        np.log(rng.uniform(0.08, 0.3, (count, 3))),
        rng.normal(size=(count, 4)),
        np.full(count, 2.0),
        sh,
    )


@cache
def capture() -> Capture:
    """Six views around the scene, the last for testing; points near the true means, colours unknown."""
    angles = np.linspace(0, 1.6, 6)[[0, 1, 2, 4, 5, 3]]
    eyes = [np.array([4 * np.sin(a), -0.5 - 0.3 * np.cos(5 * a), -4 * np.cos(a)]) for a in angles]
    cameras = [look_at(eye, np.zeros(3), np.array([0.0, -1.0, 0.0]), SIZE, 40.0) for eye in eyes]
    images = [np.round(255 * picture(truth(), c).clip(0, 1)).astype(np.uint8) for c in cameras]
    rng = np.random.default_rng(4)
    points = np.repeat(truth().means.astype(np.float64), 8, axis=0)
    points += 0.08 * rng.normal(size=points.shape)
    return Capture(tuple(cameras), tuple(images), points, np.full(points.shape, 128, np.uint8))


def find_mask_weights(
    rasterizer: LiftingRasterizer,
    gaussians: Gaussians,
    views: Sequence[tuple[Camera, ImageFeatures]],
    settings: RasterSettings = INRIA,
) -> MaskWeights:
    """The mask weights of all views, in memory."""
    pairs = [view_pairs(rasterizer, gaussians, *view, settings) for view in views]
    return MaskWeights(pairs, [len(features.vectors) for _, features in views], len(gaussians))


def repeated(scene: Scene, count: int) -> Scene:
    """`count` Gaussians: the scene's over and over, each moved by a random step of its own size."""
    larger = scene.take(np.resize(np.arange(len(scene.gaussians)), count))
    gaussians = larger.gaussians
    steps = np.random.default_rng(0).normal(size=(count, 3)) * np.exp(gaussians.log_scales)
    return replace(larger, gaussians=replace(gaussians, means=gaussians.means + steps))
