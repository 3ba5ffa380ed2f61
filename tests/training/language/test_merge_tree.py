"""The tree of things against plain loops in float64, and on scenes whose things are known."""

from dataclasses import replace
from itertools import combinations, pairwise

import numpy as np
import pytest
from scipy import sparse

from langsplat_core.arrays import unit
from langsplat_core.pipeline.language_field import AREA, best_views, name_scores
from langsplat_core.raster.cpu.rasterizer import CpuRasterizer
from langsplat_core.raster.reference import ReferenceRasterizer
from langsplat_core.raster.render import view_of
from langsplat_core.scene import Scene
from langsplat_core.scene.surface import build_surface
from langsplat_core.scene.transform import scaling, transform_scene
from langsplat_core.semantics.features import ImageFeatures
from langsplat_core.training.language import merge_tree as module
from langsplat_core.training.language.lift import PAIR, MaskWeights
from langsplat_core.training.language.merge_tree import (
    SOLID,
    MergeTree,
    Patches,
    draw_patches,
    find_tree,
    merge,
    nested_maps,
)
from tests.support.fakes import PER_BLOB, FakeEncoder, blob_scene, cameras
from tests.support.scenes import find_mask_weights, make_views, random_camera, random_gaussians


def random_patches(seed: int, count: int = 24, views: int = 4) -> Patches:
    """Patches along a ring with chords, random masses in random masks; some are seen nowhere."""
    rng = np.random.default_rng(seed)
    masks = 5 * 3 * views
    masses = rng.uniform(0, 20, (count, masks)) * (rng.uniform(size=(count, masks)) < 0.3)
    masses[rng.integers(0, count, 2)] = 0
    first = np.concatenate([np.arange(count), rng.integers(0, count, count)])
    second = np.concatenate([np.roll(np.arange(count), 1), rng.integers(0, count, count)])
    borders = module.find_borders(
        np.arange(count), (first, second), rng.uniform(size=2 * count), rng.uniform(size=2 * count)
    )
    labelling = np.arange(masks, dtype=np.int32) // 5
    spread, middles = rng.uniform(0, 1, (count, 1, 3)), rng.normal(size=(count, 1, 3))
    points = middles + spread * rng.uniform(-1, 1, (count, 5, 3))
    moments = moments_of(points, rng.uniform(0.1, 3, count), rng.dirichlet(np.ones(3), count))
    eyes = rng.normal(size=(views, 3)) * 4
    return Patches(sparse.csr_matrix(masses.astype(np.float32)), labelling, moments, eyes, *borders)


def moments_of(points: np.ndarray, areas: np.ndarray, colours: np.ndarray) -> np.ndarray:
    """Those of patches of (P, n, 3) points, (P,) areas and (P, 3) colours."""
    ones, each = np.ones_like(points[..., :1]), np.broadcast_to(colours[:, None], points.shape)
    values = np.concatenate([points, ones, each], -1)
    return np.einsum("p,pni,pnj->pij", areas / points.shape[1], values, values[..., :4])


def merged_plainly(patches: Patches) -> tuple[list[tuple[int, int]], list[float]]:
    """Every cost anew at every step, from the patches themselves."""
    masses = patches.masses.toarray().astype(np.float64)
    nodes = {number: [number] for number in range(len(patches.moments))}
    children, costs = [], []

    def plane(nodes: list[int]) -> tuple[np.ndarray, ...]:
        total = patches.moments[nodes].sum(0)
        middle = total[:3, 3] / total[3, 3]
        axes, squares, _ = np.linalg.svd(total[:3, :3] / total[3, 3] - np.outer(middle, middle))
        to_eye = min(patches.eyes - middle, key=np.linalg.norm)
        return total, middle, np.sqrt(squares), axes[:, 2] * np.sign(to_eye @ axes[:, 2])

    def cost(a: list[int], b: list[int]) -> float | None:
        across = (np.isin(patches.borders, a) & np.isin(patches.borders[::-1], b)).any(0)
        if not across.any():
            return None
        agreed = seen = 0.0
        for k in range(patches.labelling.max() + 1):
            mine, theirs = (masses[nodes][:, patches.labelling == k].sum(0) for nodes in (a, b))
            least = min(mine.sum(), theirs.sum())
            seen += least
            if least > 0:
                agreed += least * (mine / mine.sum()) @ (theirs / theirs.sum())
        agreement = agreed / seen if seen > 0 else 1 - module.UNSEEN
        links, disagreement, concavity = patches.sums[across].sum(0)
        (x, middle, own, _), (y, base, wide, out) = sorted(map(plane, (a, b)), key=lambda one: one[0][3, 3])
        between = module.SEEN * (1 - agreement)
        between += (module.SEEN * disagreement + module.BENT * concavity) / links
        between += module.COLOUR * np.linalg.norm(x[4:, 3] / x[3, 3] - y[4:, 3] / y[3, 3])
        height, half = (middle - base) @ out, np.sqrt((own**2).sum()) / 2
        if height > 0 and half < wide[1]:
            between += module.STAND * height / (height + wide[2]) * (1 - half / wide[1])
        return between * (x[3, 3] / patches.moments[:, 3, 3].sum() / module.PLAIN) ** module.SMALL

    while True:
        pairs = [(cost(nodes[a], nodes[b]), a, b) for a in nodes for b in nodes if a < b]
        pairs = [pair for pair in pairs if pair[0] is not None]
        if not pairs:
            return children, costs
        least, a, b = min(pairs)
        nodes[len(patches.moments) + len(children)] = nodes.pop(a) + nodes.pop(b)
        children.append((a, b))
        costs.append(least)


@pytest.mark.parametrize("seed", range(6))
def test_merging_is_average_linkage(seed):
    patches = random_patches(seed)
    children, costs = merge(patches)
    want, want_costs = merged_plainly(patches)
    assert children.tolist() == [list(pair) for pair in want]
    np.testing.assert_allclose(costs, want_costs, rtol=1e-5)  # masses are summed in float32


def test_halves_of_a_thing_merge_before_the_plane_they_stand_on():
    """A table, and two halves above it, each as near to the other as to the table; no mask shows them."""
    rng, pairs = np.random.default_rng(0), np.array([[0, 0, 1], [1, 2, 2]], np.int32)
    points = np.stack([rng.uniform(-1, 1, (50, 3)) * size for size in ([1, 1, 0.01], 0.1, 0.1)])
    points[1:, :, 2] += 0.1
    moments = moments_of(points, np.array([4.0, 0.1, 0.1]), np.full((3, 3), 1 / 3))
    nothing = sparse.csr_matrix((3, 1), dtype=np.float32), np.zeros(1, np.int32)
    eyes = np.array([[0, 0, 3.0]])
    colours = np.ones((3, 3))
    above, below = (merge(Patches(*nothing, moments, side * eyes, pairs, colours)) for side in (1, -1))
    assert above[0][0].tolist() == [1, 2]
    assert above[1][1] > below[1][1] + 0.3


def test_link_disagreement_is_the_weighted_share_of_views():
    gaussians = random_gaussians(120, seed=3, scale_range=(0.1, 0.3))
    mask_weights = find_mask_weights(CpuRasterizer(), gaussians, make_views(4))
    surface = build_surface(gaussians)
    found = module.link_disagreement(surface, mask_weights)
    assert 0 < found.mean() < 1
    for link in range(0, len(found), 7):
        ends = [surface.rows[numbers[link]] for numbers in surface.ends]
        apart = seen = 0.0
        for pairs in mask_weights.pairs:
            for level in range(3):
                own = [pairs[(pairs["row"] == row) & (pairs["level"] == level)] for row in ends]
                if all(map(len, own)):
                    best = [one[one["weight"].argmax()] for one in own]
                    weight = min(*(one["weight"] for one in best), module.ENOUGH)
                    seen += weight
                    apart += weight * (best[0]["mask"] != best[1]["mask"])
        assert found[link] == pytest.approx(apart / seen if seen else module.UNSEEN, abs=1e-5)


def test_concavity_is_high_in_corners_and_low_on_ridges():
    """Two planes that meet in a right angle, seen from the open side and from behind."""
    rng = np.random.default_rng(0)
    flat = np.concatenate([rng.uniform(0, 1, (800, 2)), np.zeros((800, 1))], 1)
    means = np.concatenate([flat, flat[:, [2, 1, 0]]])
    base = random_gaussians(len(means), scale_range=(0.02, 0.03))
    gaussians = replace(base, means=means.astype(np.float32), opacity_logits=base.opacity_logits * 0 + 4)
    surface = build_surface(gaussians)
    middles = surface.positions[surface.ends[0]]
    crease = (middles[:, 0] < 0.05) & (middles[:, 2] < 0.05)
    inside = module.link_concavity(surface, np.array([[2.0, 0.5, 2.0]]))
    outside = module.link_concavity(surface, np.array([[-2.0, 0.5, -2.0]]))
    assert inside[crease].mean() > 5 * inside[~crease].mean()
    assert inside[crease].mean() > 5 * outside[crease].mean()
    assert ((inside >= 0) & (inside <= 1)).all()


@pytest.mark.parametrize("wrong", [0.0, 0.15])
def test_tree_finds_instances_despite_wrong_masks(wrong):
    """A scene of blobs, and views with a mask a blob; a share of all pixels has a random mask."""
    scene, rng, views = blob_scene(), np.random.default_rng(0), []
    blob = np.arange(len(scene.gaussians)) // PER_BLOB
    for camera in cameras():
        view = CpuRasterizer().view(scene.gaussians, camera)
        labels = draw_patches(view, scene.gaussians, blob.astype(np.int32))
        noise = rng.integers(0, blob.max() + 1, labels.shape)
        labels = np.where((rng.uniform(size=labels.shape) < wrong) & (labels >= 0), noise, labels)
        maps = np.stack([np.full_like(labels, -1), np.full_like(labels, -1), labels]).astype(np.int32)
        views.append((camera, ImageFeatures(maps, np.zeros((int(blob.max()) + 1, 0), np.float32))))
    mask_weights = find_mask_weights(CpuRasterizer(), scene.gaussians, views)
    surface = build_surface(scene.gaussians)
    eyes = np.stack([camera.position for camera, _ in views])
    tree = find_tree(scene.gaussians, surface, mask_weights, eyes)
    nodes = tree.cut(0.5)[tree.patches[surface.rows]]
    for one in np.unique(blob):
        own = blob[surface.rows] == one
        node = np.bincount(nodes[own]).argmax()
        assert (own & (nodes == node)).sum() / (own | (nodes == node)).sum() > 0.9


def test_cuts_at_rising_costs_are_nested():
    children, costs = merge(random_patches(1))
    tree = MergeTree(np.arange(24, dtype=np.int32), children, costs)
    assert tree.cut(-1.0).tolist() == list(range(24))
    assert len(np.unique(tree.cut(np.inf))) == 24 - len(children)
    for low, high in pairwise(np.quantile(costs, [0.1, 0.4, 0.7, 0.9])):
        fine, coarse = tree.cut(low), tree.cut(high)
        assert len(np.unique(np.stack([fine, coarse]), axis=1).T) == len(np.unique(fine))


def test_valued_cut_has_the_largest_sum_of_all_partitions():
    children, costs = merge(random_patches(2, count=10))
    tree = MergeTree(np.arange(10, dtype=np.int32), children, costs)
    low, high = np.quantile(tree.highest[10:], [0.3, 0.9])
    members = tree.totals(np.eye(10, dtype=bool))
    values = np.random.default_rng(3).uniform(size=len(tree.highest)) * members.sum(1) ** 0.75
    chosen = np.flatnonzero(tree.between(low, high))
    found = np.unique(tree.cut(low, high, values))
    assert set(found) <= set(chosen)
    sums = [
        values[list(some)].sum()
        for size in range(1, len(chosen) + 1)
        for some in combinations(chosen, size)
        if (members[list(some)].sum(0) == 1).all()
    ]
    assert len(sums) > 3
    assert values[found].sum() == pytest.approx(max(sums))
    assert tree.cut(low).tolist() == tree.cut(low, high, np.zeros(len(values))).tolist()


class OpenEncoder(FakeEncoder):
    """Was taught every word; a text is a random direction of 64 dimensions, and none of the 65th."""

    def vector(self, text: str) -> np.ndarray:
        direction = unit(np.random.default_rng(list(text.encode())).normal(size=64))
        return np.append(direction, 0).astype(np.float32)

    def unknown_words(self, text: str) -> tuple[str, ...]:
        return ()


def test_names_count_by_fit_and_area():
    tree = MergeTree(np.array([0, 1, 1, 2, -1], np.int32), np.array([[0, 1]], np.int32), np.array([0.7]))
    areas, sofa, nameless = np.array([1.0, 2, 3, 1, 9]), OpenEncoder().vector("sofa"), np.eye(65)[64]
    scores = name_scores(tree, areas, np.stack([sofa, sofa, nameless, 0 * sofa]), OpenEncoder())
    assert scores[0] > 0
    assert scores[1] == pytest.approx(5**AREA * scores[0])
    assert scores[2:].tolist() == [0, 0]


def test_names_decide_nothing_where_encoders_cannot_tell():
    tree = MergeTree(np.array([0, 1], np.int32), np.zeros((0, 2), np.int32), np.zeros(0))
    sofa = OpenEncoder().vector("sofa")
    assert name_scores(tree, np.ones(2), np.stack([sofa, sofa]), OpenEncoder()) is None
    assert name_scores(tree, np.ones(2), np.eye(2, 8, dtype=np.float32), FakeEncoder()) is None


@pytest.mark.parametrize("scale", [1, 0.01])
def test_pixels_show_their_heaviest_patch(scale):
    gaussians, camera = random_gaussians(60, scale_range=(0.1, 0.4)), random_camera(1, 24, 18)
    scene = transform_scene(Scene(gaussians, cameras=(camera,)), scaling(scale))
    patches = np.random.default_rng(0).integers(-1, 5, 60).astype(np.int32)
    view = view_of(scene, scene.cameras[0], CpuRasterizer())
    drawn = draw_patches(view, scene.gaussians, patches, scene.raster_settings())
    each = (patches[:, None] == np.arange(5)).astype(np.float64)
    image, alpha = view_of(scene, scene.cameras[0], ReferenceRasterizer()).splat(each)
    two = np.sort(image, axis=-1)[..., -2:]
    clear = (two[..., 1] - two[..., 0] > 1e-3) & (np.abs(alpha - SOLID) > 1e-3)
    want = np.where((alpha > SOLID) & (image.max(-1) > 0), image.argmax(-1), -1)
    assert clear.mean() > 0.8
    np.testing.assert_array_equal(drawn[clear], want[clear])


def test_empty_scenes_have_empty_trees():
    """No Gaussian, one, and masks that no Gaussian paints."""
    eyes = np.zeros((1, 3))
    for count in (0, 1, 3):
        gaussians = random_gaussians(count)
        nothing = MaskWeights([np.zeros(0, PAIR)], [7], count)
        tree = find_tree(gaussians, build_surface(gaussians), nothing, eyes)
        assert tree.patches.shape == (count,)
        assert (tree.cut(0.5) >= 0).all()
    view = CpuRasterizer().view(gaussians, random_camera(0, 8, 6))
    assert (draw_patches(view, gaussians, np.full(3, -1, np.int32)) == -1).all()
    assert (nested_maps(np.full((6, 8), -1, np.int32), [np.zeros(0, np.int32)] * 3, 0.1)[0] == -1).all()


def test_label_maps_number_the_nodes_of_all_levels():
    drawn, cuts = np.array([[0, 0, 1], [2, 2, -1]]), np.array([[0, 1, 2], [3, 3, 2], [4, 4, 4]])
    maps, nodes = nested_maps(drawn, cuts, 0.2)  # two pixels of six, not one
    want = np.where((drawn >= 0) & (cuts[:, drawn] != 1), cuts[:, drawn], -1)
    np.testing.assert_array_equal(np.append(nodes, -1)[maps], want)


def test_best_views_show_much_from_far_apart():
    chosen = best_views(np.array([[100, 99, 50, 0], [0, 0, 0, 9]]).T, np.array([[0], [0.1], [1], [2]]), 2)
    assert chosen.T.astype(int).tolist() == [[1, 0, 1, 0], [0, 0, 0, 1]]
