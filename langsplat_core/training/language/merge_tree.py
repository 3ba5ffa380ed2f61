"""Merge tree of a scene from inconsistent masks: parts, instances and groups by the consensus of all views.

The surface of a scene is divided into small patches, then the two neighbours with the lowest cost merge,
until no two are neighbours (average linkage). The cost of neighbours x and y is

    cost(x, y) = [ SEEN (1 - agreement) + SEEN border + BENT concavity + COLOUR |difference of chromaticity|
                   + STAND standing ] s

    agreement     probability that a pixel of x and one of y are in one mask, mean over views and levels,
                  weighted by the smaller one's pixels there
    border        share of views and levels in which the two ends of a link are in two masks, mean over the
                  links between x and y
    concavity     how much the surface is concave along these links, as where two instances meet
    standing      h / (h + thickness) (1 - size / twice the width) if the centre of the smaller one is h in
                  front of the plane of the larger one, of this thickness and width: it stands on a table or
                  hangs on a wall; 0 behind the plane, and if the last factor is negative
    s             (smaller one's share of the area / PLAIN) ^ SMALL: small patches merge early

A mask of one photograph may be wrong; few are wrong in the same way from all sides. Vectors of masks are not
used, and masks may be of any source. Similar affinity trees of masks (THGS 2025, PairGS 2026) need a trained
segmenter; this one also works without: `--masks.source graph`.
"""

import heapq
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import scipy

from langsplat_core.arrays import Array, pieces
from langsplat_core.compiled import kernel, shared_workers
from langsplat_core.config import INRIA, RasterSettings
from langsplat_core.progress import Progress, silent
from langsplat_core.raster.protocol import LiftingView
from langsplat_core.raster.reference import Footprints, project
from langsplat_core.scene import LEVELS, Camera, Gaussians
from langsplat_core.scene.surface import Surface, divide, surface_areas
from langsplat_core.scene.transform import C0
from langsplat_core.training.language.lift import MaskWeights

SEEN, BENT, COLOUR, STAND = 0.5, 0.6, 1.0, 1.0  # weights of the cost's terms
UNSEEN = 0.5  # disagreement of Gaussians and patches that no view shows together
STEP_BENT = 0.1  # weight of concavity in the step between two Gaussians
SCALE, SMALLEST = 0.6, 10  # of the division into patches, see `surface.divide`
PLAIN, SMALL = 1 / 200, 0.1  # share of the area with factor s = 1, and the exponent of s
ENOUGH = 4.0  # largest weight, in pixels, of a Gaussian in a mask
STAGE = "merging what masks agree on"


@dataclass(frozen=True, eq=False)
class MergeTree:
    """A binary tree over P patches of a surface: nodes 0 to P - 1 are the patches, later ones merge two."""

    patches: Array  # (N,) int32 patch of every Gaussian; -1 for those on no surface
    children: Array  # (K, 2) int32 children of node P + k, each with a lower number
    costs: Array  # (K,) float64 cost of merging these

    @property
    def count(self) -> int:
        """Number P of patches; with a tree for each connected surface, P - K nodes are roots."""
        return int(self.patches.max(initial=-1)) + 1

    @cached_property
    def highest(self) -> Array:
        """The (P + K,) float64 highest cost of a merge within each node; 0 for a patch."""
        highest = np.zeros(self.count + len(self.children))
        for node, (children, own) in enumerate(zip(self.children, self.costs, strict=True), self.count):
            highest[node] = max(own, *highest[children])
        return highest

    def totals(self, values: Array) -> Array:
        """Return (P + K, ...) sums of (P, ...) values over the patches of every node; of bools, any."""
        totals = np.concatenate([values, np.zeros((len(self.children), *values.shape[1:]), values.dtype)])
        for node, (a, b) in enumerate(self.children, self.count):
            totals[node] = totals[a] + totals[b]
        return totals

    def between(self, cost: float, most: float) -> Array:
        """Return (P + K,) bool, the nodes that `cut` chooses from."""
        above = np.full(len(self.highest), np.inf)
        above[self.children] = self.highest[self.count :, None]
        return np.asarray((above > cost) & (self.highest <= max(cost, most)))

    def cut(self, cost: float, most: float = 0.0, values: Array | None = None) -> Array:
        """Return the (P,) int32 node of each patch: the largest with a highest cost of at most `cost`.

        A larger node, with a cost of at most `most`, replaces nodes within it if its value, in `values`
        (P + K,), exceeds the largest sum of values of disjoint nodes within it.
        """
        owner, kept = np.arange(len(self.highest), dtype=np.int32), self.highest <= max(cost, 0)
        best = np.zeros(len(owner)) if values is None else values.copy()
        for node in np.flatnonzero(~kept).tolist():
            within = best[self.children[node - self.count]].sum()
            kept[node] = self.highest[node] <= most and best[node] > within
            best[node] = best[node] if kept[node] else within
        for node in range(len(owner) - 1, self.count - 1, -1):
            if kept[node] or owner[node] != node:
                owner[self.children[node - self.count]] = owner[node]
        return owner[: self.count]


@dataclass(frozen=True, eq=False)
class Patches:
    """The masks, colours, positions and borders of P patches."""

    masses: "scipy.sparse.csr_matrix"  # (P, masks of all views) float32 pixels, columns sorted
    labelling: Array  # (masks of all views,) int32 number 3 view + level of each mask
    moments: Array  # (P, 7, 4) sums over the area, > 0, of x, y, z, 1 and the chromaticity times x, y, z, 1
    eyes: Array  # (V, 3) positions of cameras, relative to the same origin, which define the outside
    borders: Array  # (2, B) int32 neighbouring patches, the lower number first
    sums: Array  # (B, 3) float64 sums over their links: number, disagreement, concavity


def find_tree(
    gaussians: Gaussians,
    surface: Surface,
    mask_weights: MaskWeights,
    eyes: Array,
    progress: Progress = silent,
) -> MergeTree:
    """Return the merge tree of a scene; eyes: (V, 3) positions of cameras."""
    everywhere = np.full(len(gaussians), -1, np.int32)
    if len(surface.rows) == 0:
        return MergeTree(everywhere, np.zeros((0, 2), np.int32), np.zeros(0))
    disagreement = link_disagreement(surface, mask_weights, progress)
    concavity = link_concavity(surface, eyes)
    colours = 0.5 + C0 * gaussians.sh[surface.rows, 0].astype(np.float64)
    colours = np.nan_to_num(colours).clip(0.02, 1)  # black has no chromaticity
    colours /= colours.sum(1, keepdims=True)
    a, b = surface.ends
    steps = disagreement + STEP_BENT * concavity + COLOUR * np.linalg.norm(colours[a] - colours[b], axis=1)
    of = divide(surface, steps, np.argsort(steps, kind="stable").astype(np.int32), SCALE, SMALLEST)
    everywhere[surface.rows] = of
    count, origin = int(of.max()) + 1, surface.positions.mean(0)
    areas = np.maximum(surface_areas(gaussians)[surface.rows], 1e-30)
    values = *(surface.positions - origin).T, np.ones(len(of)), *colours.T
    moments = np.stack([np.bincount(of, areas * one * other) for one in values for other in values[:4]], 1)
    patches = Patches(
        *mask_weights.sums(everywhere, count),
        moments.reshape(-1, 7, 4),
        eyes - origin,
        *find_borders(of, surface.ends, disagreement, concavity),
    )
    children, costs = merge(patches, progress)
    return MergeTree(np.append(of, np.int32(-1))[surface.anchors], children, costs)  # -1: without an anchor


# Costs between linked Gaussians.


def link_disagreement(surface: Surface, mask_weights: MaskWeights, progress: Progress = silent) -> Array:
    """Return the (E,) share of views and levels in which the ends of each link are in different masks.

    Only views and levels with a mask at both ends count, by the lower of their pixels, at most `ENOUGH`.
    """
    first, second = surface.ends
    apart, seen = np.zeros(len(first), np.float32), np.zeros(len(first), np.float32)
    number = np.full(mask_weights.count, -1, np.int32)
    number[surface.rows] = np.arange(len(surface.rows))
    for done, pairs in enumerate(mask_weights.pairs, 1):
        pairs = pairs[number[pairs["row"]] >= 0]
        place = pairs["level"].astype(np.int64) * len(surface.rows) + number[pairs["row"]]
        weight = np.ascontiguousarray(pairs["weight"])
        most = np.zeros(len(LEVELS) * len(surface.rows), np.float32)
        np.maximum.at(most, place, weight)
        # The mask that each Gaussian paints most of at each level; the first of equal ones is written last.
        mask = np.full(len(most), -1, np.int32)
        heaviest = np.flatnonzero(weight == most[place])[::-1]
        mask[place[heaviest]] = pairs["mask"][heaviest]
        levels = (one.reshape(len(LEVELS), -1) for one in (mask, most))
        shared_workers().run(_compare, len(first), first, second, *levels, apart, seen)
        progress(STAGE, 0.8 * done / len(mask_weights.pairs))
    return np.where(seen > 0, apart / np.maximum(seen, 1e-9), UNSEEN).astype(np.float64)


@kernel
def _compare(
    begin: int, end: int, first: Array, second: Array, masks: Array, most: Array, apart: Array, seen: Array
) -> None:
    """Add a view to links [begin, end). masks, most: (3, M) mask of each Gaussian and its weight."""
    for link in range(begin, end):
        a, b = first[link], second[link]
        for level in range(masks.shape[0]):
            if masks[level, a] >= 0 and masks[level, b] >= 0:
                weight = min(most[level, a], most[level, b], np.float32(ENOUGH))
                seen[link] += weight
                if masks[level, a] != masks[level, b]:
                    apart[link] += weight


def link_concavity(surface: Surface, eyes: Array) -> Array:
    """Return the (E,) concavity of links in [0, 1], from normals; eyes: (V, 3), which define the outside."""
    normals = _normals(surface)
    away = surface.positions - eyes[scipy.spatial.cKDTree(eyes).query(surface.positions)[1]]
    normals[(normals * away).sum(1) > 0] *= -1
    a, b = surface.ends
    along = surface.positions[b] - surface.positions[a]
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-12)
    return np.asarray((((normals[a] - normals[b]) * along).sum(1) / 2).clip(0, 1))


def _normals(surface: Surface) -> Array:
    """Return (M, 3) unit normals of planes fitted to the neighbourhoods, of either sign."""
    normals = np.empty((len(surface.rows), 3))
    for part in pieces(len(normals), 65_536):
        near = surface.neighbours[part]
        weights = surface.weights[near].astype(np.float64)[..., None]
        points = surface.positions[near]
        middles = (points * weights).sum(1, keepdims=True) / weights.sum(1, keepdims=True)
        spread = (points - middles) * np.sqrt(weights)
        normals[part] = np.linalg.eigh(spread.swapaxes(1, 2) @ spread)[1][..., 0]
    return normals


# Patches, and their merging.


def find_borders(
    of: Array, ends: tuple[Array, Array], disagreement: Array, concavity: Array
) -> tuple[Array, Array]:
    """Return `borders` and `sums` of `Patches`.

    of: (M,) patch of each surface Gaussian; ends, disagreement, concavity: (E,) of each link.
    """
    sides = np.sort(np.stack([of[end] for end in ends]).astype(np.int64), axis=0)
    between, size = sides[0] != sides[1], int(of.max(initial=-1)) + 1
    found, row = np.unique(sides[0, between] * size + sides[1, between], return_inverse=True)
    values = np.ones(int(between.sum())), disagreement[between], concavity[between]
    sums = np.stack([np.bincount(row, value, len(found)) for value in values], 1)
    return np.stack(np.divmod(found, max(size, 1))).astype(np.int32), sums


class _Merger:
    """The nodes during merging, with their sums and neighbours."""

    def __init__(self, patches: Patches) -> None:
        masses, self._labelling = patches.masses, patches.labelling
        shape = len(patches.moments), int(self._labelling.max(initial=-1)) + 1
        entries = masses.data, self._labelling[masses.indices], masses.indptr
        pixels = scipy.sparse.csr_matrix(entries, shape).toarray()
        # For each node: its masks, its pixels in them, and its pixels in each view and level.
        seen = (np.split(of, masses.indptr[1:-1]) for of in (masses.indices, masses.data))
        self._masks: list[Any] = list(zip(*seen, pixels, strict=True))
        self._moments, self._eyes = list(patches.moments), patches.eyes
        self._planes = [self._plane(own) for own in self._moments]
        self._plain = PLAIN * float(patches.moments[:, 3, 3].sum())
        self.neighbours: list[dict[int, Array]] = [{} for _ in self._moments]
        for a, b, own in zip(*patches.borders.tolist(), patches.sums, strict=True):
            self.neighbours[a][b] = self.neighbours[b][a] = own

    def cost(self, a: int, b: int) -> float:
        links, disagreement, concavity = self.neighbours[a][b]
        agreement = _agreement(self._masks[a], self._masks[b], self._labelling)
        small, large = sorted((a, b), key=lambda node: self._moments[node][3, 3])
        area, larger = self._moments[small][3, 3], self._moments[large][3, 3]
        colours = self._moments[small][4:, 3] / area - self._moments[large][4:, 3] / larger
        between = SEEN * (1 - agreement) + (SEEN * disagreement + BENT * concavity) / links
        between += COLOUR * np.sqrt(colours @ colours) + STAND * self._standing(small, large)
        return float(between * (area / self._plain) ** SMALL)

    def _standing(self, small: int, large: int) -> float:
        (middle, own, _), (base, extents, outwards) = self._planes[small], self._planes[large]
        height, share = float((middle - base) @ outwards), np.linalg.norm(own) / max(2 * extents[1], 1e-30)
        return float(height / (height + extents[0]) * (1 - share)) if height > 0 and share < 1 else 0.0

    def _plane(self, moments: Array) -> tuple[Array, Array, Array]:
        """Return a node's centre, its standard deviations, rising, and the axis of the first, outwards."""
        middle = moments[3, :3] / moments[3, 3]
        squares, axes = np.linalg.eigh(moments[:3, :3] / moments[3, 3] - np.outer(middle, middle))
        nearest = np.linalg.norm(self._eyes - middle, axis=1).argmin()
        inwards = axes[:, 0] @ (self._eyes[nearest] - middle) < 0
        return middle, np.sqrt(squares.clip(0)), -axes[:, 0] if inwards else axes[:, 0]

    def join(self, a: int, b: int) -> int:
        """Merge the nodes a and b; return the number of the new one."""
        new = len(self.neighbours)
        masks, values = (np.concatenate([self._masks[a][k], self._masks[b][k]]) for k in (0, 1))
        masks, place = np.unique(masks, return_inverse=True)
        values = np.bincount(place, values).astype(np.float32)
        self._masks.append((masks, values, self._masks[a][2] + self._masks[b][2]))
        self._moments.append(self._moments[a] + self._moments[b])
        self._planes.append(self._plane(self._moments[new]))
        self.neighbours.append({})
        for old in (a, b):
            self._masks[old] = None
            for other, own in self.neighbours[old].items():
                del self.neighbours[other][old]
                if other not in (a, b):
                    joined = own + self.neighbours[new].get(other, 0)
                    self.neighbours[new][other] = self.neighbours[other][new] = joined
            self.neighbours[old] = {}
        return new


def merge(patches: Patches, progress: Progress = silent) -> tuple[Array, Array]:
    """Return (K, 2) int32 merged nodes and (K,) float64 costs, in order; at equal costs older nodes first."""
    nodes, count = _Merger(patches), len(patches.moments)
    waiting = [(nodes.cost(a, b), a, b) for a in range(count) for b in nodes.neighbours[a] if a < b]
    heapq.heapify(waiting)
    made: list[tuple[int, int, float]] = []
    while waiting:
        cost, a, b = heapq.heappop(waiting)
        if b not in nodes.neighbours[a]:  # one of them was merged
            continue
        new = nodes.join(a, b)
        made.append((a, b, cost))
        for other in nodes.neighbours[new]:
            heapq.heappush(waiting, (nodes.cost(other, new), other, new))
        progress(STAGE, 0.8 + 0.2 * len(made) / count)
    table = np.array(made, np.float64).reshape(-1, 3)
    return table[:, :2].astype(np.int32), table[:, 2]


@kernel
def _agreement(a: tuple[Array, ...], b: tuple[Array, ...], labelling: Array) -> float:
    """Return the term `agreement` of the cost; `1 - UNSEEN` if no view and level has both nodes."""
    columns_a, values_a, pixels_a = a
    columns_b, values_b, pixels_b = b
    agreed, seen = 0.0, np.minimum(pixels_a, pixels_b).sum()
    if seen <= 0:
        return 1.0 - UNSEEN
    i = j = 0
    while i < len(columns_a) and j < len(columns_b):
        if columns_a[i] < columns_b[j]:
            i += 1
        elif columns_a[i] > columns_b[j]:
            j += 1
        else:
            k = labelling[columns_a[i]]
            agreed += values_a[i] * values_b[j] / max(pixels_a[k], pixels_b[k])
            i += 1
            j += 1
    return agreed / seen


# Label maps of patches and nodes in photographs.

SOLID = 0.5  # least alpha of a pixel with a label
CELL = 8  # px, side of cells, each with one patch per channel at most


def draw_patches(
    view: LiftingView, gaussians: Gaussians, patches: Array, settings: RasterSettings = INRIA
) -> Array:
    """Return the (H, W) int32 patch with the most weight in each pixel, -1 for none.

    patches: (N,) int32 of the Gaussians, -1 for none; settings: the view's. Patches with disjoint boxes share
    a channel of the splatted image, so that thousands of patches need some dozens.
    """
    inside = patches >= 0
    if not inside.any():
        return np.full((view.camera.height, view.camera.width), -1, np.int32)
    shown = np.bincount(patches[inside], view.contributions()[inside]) >= 1  # pixel
    boxes = _boxes(project(gaussians, view.camera, settings), view.camera, patches, len(shown))
    channel_of, owners = _share_channels(boxes, shown)
    channels = np.where(inside, channel_of[patches], -1)
    most = np.zeros((view.camera.height, view.camera.width), np.float32)
    drawn = np.full(most.shape, -1, np.int32)
    rows, columns = np.indices(most.shape) // CELL
    for some in np.split(np.arange(len(owners)), np.arange(32, len(owners), 32)):
        image, alpha = view.splat((channels[:, None] == some).astype(np.float32))
        top = image.argmax(-1)
        best = np.take_along_axis(image, top[..., None], -1)[..., 0]
        more = (best > most) & (alpha > SOLID)
        drawn[more] = owners[some[top[more]], rows[more], columns[more]]
        most = np.where(more, best, most)
    return drawn


def _boxes(footprints: Footprints, camera: Camera, patches: Array, count: int) -> Array:
    """Return (P, 4) left, top, right, bottom cell of each patch's box, the last two exclusive."""
    drawn = np.flatnonzero((patches >= 0) & (footprints.opacities > 0))
    low, high = np.full((count, 2), np.inf), np.full((count, 2), -np.inf)
    np.minimum.at(low, patches[drawn], footprints.means_px[drawn] - footprints.extents_px[drawn] - 1)
    np.maximum.at(high, patches[drawn], footprints.means_px[drawn] + footprints.extents_px[drawn] + 1)
    size = camera.width, camera.height
    boxes = np.concatenate([np.clip(low, 0, size) // CELL, -(-np.clip(high, 0, size) // CELL)], 1)
    return np.asarray(boxes.astype(np.int64))


def _share_channels(boxes: Array, shown: Array) -> tuple[Array, Array]:
    """Return the (P,) channel of each patch, -1 for none, and the (C, rows, columns) patch of each cell.

    Channels are assigned greedily, the largest box first.
    """
    channel_of = np.full(len(boxes), -1)
    rows, columns = (int(boxes[:, side].max(initial=0)) for side in (3, 2))
    owners = np.full((32, rows, columns), -1, np.int32)
    areas = (boxes[:, 2] - boxes[:, 0]) * (boxes[:, 3] - boxes[:, 1])
    seen = np.flatnonzero(shown & (boxes[:, :2] < boxes[:, 2:]).all(1))
    for patch in seen[np.argsort(-areas[seen], kind="stable")]:
        left, top, right, bottom = boxes[patch]
        taken = (owners[:, top:bottom, left:right] >= 0).any((1, 2))
        if taken.all():
            taken, owners = np.append(taken, False), np.concatenate([owners, np.full_like(owners[:32], -1)])
        channel_of[patch] = channel = taken.argmin()
        owners[channel, top:bottom, left:right] = patch
    return channel_of, owners[: channel_of.max(initial=-1) + 1]


def nested_maps(drawn: Array, cuts: Sequence[Array], least: float) -> tuple[Array, Array]:
    """Return label maps (3, H, W) int32, as of `masks.label_maps`, and the (M,) node of each region.

    drawn: (H, W) patches, -1 for none; cuts: (P,) node of each patch at each level; least: share of an image.
    """
    maps = np.full((len(cuts), *drawn.shape), -1, np.int32)
    shown, there = np.zeros(0, int), drawn >= 0
    for level, nodes in zip(maps, cuts, strict=True):
        found = nodes[drawn[there]]
        large = np.bincount(found) >= max(least * drawn.size, 1)
        level[there] = np.where(large, len(shown) + np.cumsum(large) - 1, -1)[found]
        shown = np.concatenate([shown, np.flatnonzero(large)])
    return maps, shown
