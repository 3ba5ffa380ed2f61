"""Registration and merging of two scenes of one place.

Features of surface points are matched by RANSAC and refined by ICP (Open3D); rendered depths verify the
transform.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.sparse import csr_matrix
from scipy.spatial import cKDTree

from langsplat_core.arrays import Array, rotation_matrices, unit
from langsplat_core.errors import InputError, report_losses, shortened
from langsplat_core.progress import Progress, silent
from langsplat_core.raster.render import view_of
from langsplat_core.scene import LEVELS, Camera, Gaussians, LanguageField, Scene, Tree
from langsplat_core.scene.codec import MOST_CODEWORDS, CodebookCodec, Codec, principal_colours
from langsplat_core.scene.gaussians import coarse_step, join_gaussians
from langsplat_core.scene.language import NO_NODE
from langsplat_core.scene.surface import surface_areas, surface_weights
from langsplat_core.scene.transform import Similarity, place_scene, rotating, similarity

if TYPE_CHECKING:
    import open3d

FEWEST = 100  # least opaque Gaussians of a scene with a surface
MATCHED_POINTS = 40_000  # of each surface
ROUGH, FINE = 0.06, 0.03  # spacing of points for features and for ICP, as shares of the fixed scene's radius
TRIES = 50_000  # of RANSAC
AGAIN = 2  # starts of RANSAC
SIZES = (1.0, 0.8, 1.25)  # initial scales, if unknown, as factors of the ratio of the scenes' radii
VIEWS, SIDE = 8, 120  # cameras of each scene for verification, and pixels of their longer side
ALIKE = 0.05  # largest distance of equal surfaces, as a share of the depth
TRUSTED = 0.7  # least share of equal depths, of pixels that both scenes fill, for scenes of one place
OVERLAP = 0.2  # least share of an image that both scenes fill, for a camera to count
SAME_SPOT = 0.02  # largest distance of surfaces of one instance, as a share of the first scene's radius
SAME = 0.4  # least share of the surfaces of two equal instances that are near each other

STAGE = "registering"


def sample_surface(gaussians: Gaussians, count: int) -> tuple[Array, Array]:
    """Return (count, 3) float64 points on the surface, of equal density by area, and their unit normals.

    Normals, (count, 3), are of either sign. A Gaussian is a disc across its shortest axis, with the density
    of its two longest ones. Raises InputError for fewer than `FEWEST` opaque Gaussians.
    """
    rows = np.flatnonzero(surface_weights(gaussians) > 0)
    areas = surface_areas(gaussians)[rows]
    if len(rows) < FEWEST or not areas.sum() > 0:
        raise InputError(f"{len(rows)} opaque Gaussians have no surface; at least {FEWEST} are needed")
    rng = np.random.default_rng(0)
    chosen = rows[rng.choice(len(rows), count, p=areas / areas.sum())]
    axes = rotation_matrices(gaussians.quats_wxyz[chosen].astype(np.float64))  # columns
    lengths = np.exp(gaussians.log_scales[chosen].astype(np.float64).clip(max=np.log(np.sqrt(areas.max()))))
    shortest = lengths.argmin(1)
    steps = lengths * rng.normal(size=(count, 3))
    steps[np.arange(count), shortest] = 0
    points = gaussians.means[chosen] + np.einsum("nij,nj->ni", axes, steps)
    return points, unit(axes[np.arange(count), :, shortest])


def cloud(points: Array, normals: Array | None = None) -> "open3d.geometry.PointCloud":
    """Return (P, 3) points, with (P, 3) normals if given, as a point cloud of Open3D."""
    import open3d

    made = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
    if normals is not None:
        made.normals = open3d.utility.Vector3dVector(normals)
    return made


@dataclass(frozen=True, eq=False)
class Registration:
    """The transform from a scene to another one of the same place."""

    transform: Similarity  # from the moving scene to the fixed one
    rmse: float  # of matched points, units of the fixed scene
    agreement: float  # share of equal depths of the pixels that both scenes fill, in views of both

    @property
    def trusted(self) -> bool:
        """True if the rendered depths agree, so that the scenes show one place."""
        return self.agreement >= TRUSTED


def register(moving: Scene, fixed: Scene, scaled: bool = False, progress: Progress = silent) -> Registration:
    """Return the rigid motion, and with `scaled` the scale, from one scene to another.

    Without `scaled` both have the same unit, unless their metres per unit differ. The result is only a guess
    unless it is `trusted`. InputError for a scene without a surface.
    """
    ratio = 1.0  # of a unit of the moving scene to one of the fixed scene
    if moving.metres_per_unit is not None and fixed.metres_per_unit is not None:
        ratio, scaled = moving.metres_per_unit / fixed.metres_per_unit, False
    elif scaled:
        ratio = fixed.bounds()[1] / moving.bounds()[1]
    centre, radius = fixed.bounds()
    # Rooms look similar after quarter turns.
    turns = [rotating(fixed.up(), -90.0 * quarter).about(centre).matrix for quarter in range(4)]
    mine, theirs = (sample_surface(scene.gaussians, MATCHED_POINTS)[0] for scene in (moving, fixed))
    best: Registration | None = None
    sizes = [ratio * factor for factor in SIZES] if scaled else [ratio] * AGAIN
    for start, size in enumerate(sizes):
        progress(STAGE, start / len(sizes))
        matrix, rmse = _aligned(size * mine, theirs, turns, radius, scaled, seed=start)
        there = similarity(matrix @ np.diag([size, size, size, 1.0]))
        found = Registration(there, rmse, agreement(moving, fixed, there))
        if best is None or found.agreement > best.agreement:
            best = found
        if best.trusted:
            break
    progress(STAGE, 1.0)
    assert best is not None
    return best


def _aligned(
    moving: Array, fixed: Array, turns: list[Array], radius: float, scaled: bool, seed: int
) -> tuple[Array, float]:
    """Return the (4, 4) transform from points (P, 3) to others, and its RMSE; turns: tried after RANSAC."""
    import open3d

    methods = open3d.pipelines.registration
    open3d.utility.random.seed(seed)
    voxel = ROUGH * radius
    near = open3d.geometry.KDTreeSearchParamHybrid(radius=2.5 * voxel, max_nn=30)
    wide = open3d.geometry.KDTreeSearchParamHybrid(radius=5 * voxel, max_nn=100)
    clouds = [cloud(points).voxel_down_sample(voxel) for points in (moving, fixed)]
    for one in clouds:
        one.estimate_normals(near)
    features = [methods.compute_fpfh_feature(one, wide) for one in clouds]
    estimate = methods.TransformationEstimationPointToPoint()
    checks = [
        methods.CorrespondenceCheckerBasedOnEdgeLength(0.9),
        methods.CorrespondenceCheckerBasedOnDistance(1.5 * voxel),
    ]
    until = methods.RANSACConvergenceCriteria(TRIES, 0.999)
    rough = methods.registration_ransac_based_on_feature_matching(
        *clouds, *features, True, 1.5 * voxel, estimate, 3, checks, until
    )
    voxel = FINE * radius
    clouds = [cloud(points).voxel_down_sample(voxel) for points in (moving, fixed)]
    estimate = methods.TransformationEstimationPointToPoint(True)
    if not scaled:
        estimate = methods.TransformationEstimationPointToPlane()
        clouds[1].estimate_normals(near)
    found = []
    for turn in turns:
        matrix = turn @ rough.transformation
        for reach in (3.0, 1.0):
            result = methods.registration_icp(*clouds, reach * voxel, matrix, estimate)
            matrix = result.transformation
        found.append((float(result.inlier_rmse) / max(float(result.fitness), 1e-9), result))
    best = min(found, key=lambda one: one[0])[1]
    return np.asarray(best.transformation, np.float64), float(best.inlier_rmse)


def agreement(moving: Scene, fixed: Scene, there: Similarity) -> float:
    """Return the share of equal depths of pixels that both scenes fill, in views of both; 0: no overlap."""
    mine, theirs = (
        some_cameras(scene.cameras or (scene.framing_camera((SIDE, SIDE)),), VIEWS, SIDE)
        for scene in (moving, fixed)
    )
    views = [(camera, there.inverse().camera(camera)) for camera in theirs]
    views += [(there.camera(camera), camera) for camera in mine]
    same = both = 0
    for in_fixed, in_moving in views:
        near, far = (
            view_of(scene, camera).median_depth().astype(np.float64)  # 0 without a surface
            for scene, camera in ((fixed, in_fixed), (moving, in_moving))
        )
        filled = (near > 0) & (far > 0)
        if filled.mean() >= OVERLAP:
            both += int(filled.sum())
            same += int((np.abs(there.scale * far - near) <= ALIKE * near)[filled].sum())
    return same / both if both else 0.0


def some_cameras(cameras: Sequence[Camera], most: int, side: int) -> list[Camera]:
    """Return at most `most` of the cameras, evenly chosen, with images of at most `side` px per side."""
    chosen = np.unique(np.linspace(0, len(cameras) - 1, min(most, len(cameras))).astype(int))
    return [cameras[row].within(side) for row in chosen]


# Merging of two scenes in the same axes, with language field, cameras, tree and taught words.


def merge(first: Scene, second: Scene) -> Scene:
    """Return the Gaussians of both scenes, those of `first` first, with all their data, at its origin.

    Settings of the whole scene and equal words are those of `first`. Reports what only one has. InputError if
    only one is antialiased, if the language fields cannot be merged, and for scenes so far apart that float32
    would round the positions of `second` by more than the size of most of its Gaussians.
    """
    if first.antialiased != second.antialiased:
        raise InputError(
            "one scene was trained with antialiasing (Mip-Splatting) and the other without, so that no image "
            "is right for both; train one of them again"
        )
    far = np.abs(second.in_world(second.bounds()[0]) - first.origin).max()
    if len(second.gaussians) and coarse_step(second.gaussians.log_scales, far):
        hint = "`langsplat register` finds what moves one to the other"
        raise InputError(f"the scenes lie {far:.2g} units apart, too far for float32 positions; {hint}")
    second = place_scene(second, origin=first.origin)
    shared = [
        name for name, values in first.extras.items()
        if name in second.extras and second.extras[name].dtype == values.dtype
    ]  # fmt: skip
    report_losses("merged", _losses(first, second, shared))
    return Scene(
        join_gaussians([first.gaussians, second.gaussians]),
        _language(first, second),
        first.cameras + second.cameras,
        antialiased=first.antialiased,
        extras={name: np.concatenate([first.extras[name], second.extras[name]]) for name in shared},
        metres_per_unit=first.metres_per_unit or second.metres_per_unit,
        unread=first.unread + second.unread,
        origin=first.origin,
    )


def _losses(first: Scene, second: Scene, shared: Sequence[str]) -> Iterator[str]:
    """Yield what only one of two scenes has, and units that are not equal."""
    if others := {*first.extras, *second.extras}.difference(shared):
        yield f"properties that only one has are left out: {shortened(others)}"
    fields = [scene.language for scene in (first, second) if len(scene.gaussians)]
    if len({field is None for field in fields}) > 1:
        yield "only one of the scenes has a language field, and the other cannot be searched"
    elif len({field is None or field.tree is None for field in fields}) > 1:
        yield "the tree of instances that only one has is left out"
    metres = first.metres_per_unit or second.metres_per_unit or 1.0
    if abs((second.metres_per_unit or metres) / metres - 1) > 0.01:
        yield f"units of {metres:g} and {second.metres_per_unit:g} m count as equal, of {metres:g} m"


def once(both: Scene, first: Scene) -> tuple[Scene, int]:
    """Return a merged scene with instances of both scenes kept once, and the number of those with votes.

    first: whose Gaussians come first. Wholes are equal if `SAME` of the surface of each is within `SAME_SPOT`
    of the other. That of more photographs, else of more Gaussians, is kept, with what lies farther from it.
    """
    count, near = len(first.gaussians), SAME_SPOT * first.bounds()[1]
    tree = None if both.language is None else both.language.tree
    if both.language is None or tree is None:
        return both, 0
    nodes = np.where(both.gaussians.valid(), tree.at(len(LEVELS) - 1), NO_NODE)
    means, areas = both.gaussians.means, surface_areas(both.gaussians)
    solid = (nodes != NO_NODE) & (areas > 0)
    sides = [np.flatnonzero(solid[:count]), count + np.flatnonzero(solid[count:])]
    shares = []  # of each node's surface that is near one of the other scene, by pairs of nodes
    for mine, theirs in (sides, sides[::-1]):
        gaps, nearest = cKDTree(means[theirs]).query(means[mine], distance_upper_bound=near, workers=-1)
        there, of_whole = np.isfinite(gaps), areas[mine] / np.bincount(nodes[mine], areas[mine])[nodes[mine]]
        pairs = nodes[mine[there]], nodes[theirs[nearest[there]]]
        shares.append(csr_matrix((of_whole[there], pairs), (tree.count, tree.count)))
    alike = shares[0].minimum(shares[1].T).tocoo()
    leaves, keep, paired, things = tree.leaves.copy(), np.ones(len(nodes), bool), set[int](), 0
    for row in np.argsort(-alike.data):
        pair = int(alike.row[row]), int(alike.col[row])
        if alike.data[row] >= SAME and not paired & {*pair}:
            paired |= {*pair}
            sizes = [np.count_nonzero(nodes == node) for node in pair]
            lesser, better = sorted(pair, key=lambda node: (tree.votes[node].sum(), sizes[pair.index(node)]))
            other, kept = np.flatnonzero(nodes == lesser), np.flatnonzero(nodes == better)
            gaps, nearest = cKDTree(means[kept]).query(means[other], workers=-1)
            keep[other], leaves[other] = gaps > near, tree.leaves[kept[nearest]]
            things += bool(tree.votes[better, 0])
    language = replace(both.language, tree=replace(tree, leaves=leaves))
    return replace(both, language=language).take(keep), things


def _language(first: Scene, second: Scene) -> LanguageField | None:
    a, b, count, more = first.language, second.language, len(first.gaussians), len(second.gaussians)
    if b is None:
        return None if a is None else a.matched(np.pad(np.arange(count), (0, more), constant_values=-1))
    if a is None:
        return b.matched(np.pad(np.arange(more), (count, 0), constant_values=-1))
    if a.encoder_id != b.encoder_id or a.codec.vector_dim != b.codec.vector_dim:
        raise InputError(
            f"their language fields are of two text encoders, {a.encoder_id} and {b.encoder_id}, and no "
            "phrase can be asked in both; train the field of one again with the other's encoder"
        )
    codec, latents = _one_codec(a, b)
    words = {word.key for word in a.taught}
    return replace(
        a,
        latents=latents,
        confidence=np.concatenate([a.confidence, b.confidence], axis=1),
        codec=codec,
        phrasebook={**b.phrasebook, **a.phrasebook},
        tree=None if a.tree is None or b.tree is None else _one_tree(a.tree, b.tree),
        everyday=a.everyday if a.everyday is not None else b.everyday,
        taught=a.taught + tuple(word for word in b.taught if word.key not in words),
    )


def _one_codec(a: LanguageField, b: LanguageField) -> tuple[Codec, Array]:
    """Return a codec of both fields, and the (3, N, d) latents of both in it."""
    mine, theirs, both = a.codec, b.codec, np.concatenate
    one, other = mine.tensors(), theirs.tensors()
    if one.keys() == other.keys() and all(np.array_equal(one[name], other[name]) for name in one):
        return mine, both([a.latents, b.latents], axis=1)
    if not (isinstance(mine, CodebookCodec) and isinstance(theirs, CodebookCodec)):
        raise InputError(
            f"their language fields have two codecs, {mine.kind} and {theirs.kind}, fitted apart, and only "
            "codebooks can be joined; train both with --codec.kind codebook"
        )
    count = len(mine.vectors)
    if count + len(theirs.vectors) > MOST_CODEWORDS:
        raise InputError(
            f"codebooks of {count} and {len(theirs.vectors)} words are more than {MOST_CODEWORDS} together; "
            "train one of the scenes with a smaller --codec.size"
        )
    latents = both([a.latents, b.latents + np.uint16(count)], axis=1)
    vectors = both([mine.vectors, theirs.vectors])
    usage = np.bincount(latents[both([a.confidence, b.confidence], axis=1) > 0, 0], minlength=len(vectors))
    return CodebookCodec(vectors, principal_colours(vectors, usage)), latents


def _one_tree(a: Tree, b: Tree) -> Tree:
    """Return the nodes of `a`, then those of `b`."""
    leaves, parents = (
        np.where(rows == NO_NODE, rows, rows + np.int32(a.count)) for rows in (b.leaves, b.parents)
    )
    shifted = {"leaves": leaves, "parents": parents, "levels": b.levels, "votes": b.votes}
    return Tree(**{name: np.concatenate([getattr(a, name), rows]) for name, rows in shifted.items()})
