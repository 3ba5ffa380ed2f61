"""Masks at three levels: the interface of mask sources, suppression of masks, and masks without weights."""

import heapq
import json
import math
from abc import abstractmethod
from collections.abc import Callable
from typing import Protocol

import numpy as np
import scipy
from PIL import Image

from langsplat_core.arrays import Array, pieces
from langsplat_core.compiled import kernel, shared_workers
from langsplat_core.config import MaskConfig
from langsplat_core.progress import Progress

# Masks at the levels subpart, part, whole: (M, H, W) bool each, M may be 0; later ones cover earlier ones.
LevelMasks = tuple[Array, Array, Array]


class MaskSource(Protocol):
    """Finds the masks of a photograph."""

    agrees: bool = True
    """False if masks of different photographs differ so much that they are replaced by what they agree on
    (`pipeline.language_field`) before CLIP vectors are computed."""

    @property
    def name(self) -> str:
        """Name for messages, such as "graph (no weights)"."""

    @property
    def key(self) -> str:
        """All that its masks depend on besides the photograph: stored masks with another key are stale."""

    @abstractmethod
    def __call__(self, image: Array, progress: Progress) -> LevelMasks:
        """Return the masks of an image (H, W, 3) uint8."""

    def begin(self, image: Array, progress: Progress) -> Callable[[], LevelMasks]:
        """Run the model, and return a function that computes the masks, which may run in another thread."""
        found = self(image, progress)
        return lambda: found


def label_maps(levels: LevelMasks) -> Array:
    """Return (3, H, W) int32: the row of the topmost mask at each pixel, -1 for none.

    Rows are counted through all three levels, subpart first, as in LangSplat's `*_s.npy` (without its
    "default" level); within a level later masks cover earlier ones. Unlike there, a mask without a visible
    pixel has no row, so every row from 0 to the maximum occurs, each in one level.
    """
    maps = np.full((len(levels), *levels[0].shape[1:]), -1, np.int32)
    first = 0
    for labels, masks in zip(maps, levels, strict=True):
        for row, mask in enumerate(masks, first):
            labels[mask] = row
        first += len(masks)
    return within(maps, None)


def within(labels: Array, mask: Array | None) -> Array:
    """Return (L, H, W) label maps restricted to the (H, W) mask, renumbered without gaps."""
    kept = labels if mask is None else np.where(mask, labels, -1)
    numbers = np.unique(kept[kept >= 0])
    rows = np.full(int(kept.max(initial=-1)) + 2, -1, labels.dtype)  # the last entry is what -1 indexes
    rows[numbers] = np.arange(len(numbers))
    return rows[kept]


# Suppression of proposed masks by box and by pixels, and removal of small regions.

PIXELS_PER_PRODUCT = 1 << 16  # columns of the matrix product that counts common pixels
EIGHT = np.ones((3, 3), bool)  # diagonal neighbours are connected, as in SAM's own clean-up


def mask_boxes(masks: Array) -> Array:
    """Return (M, 4) int64 left, top, right, bottom of masks, none empty; the last two exclusive."""
    boxes = np.zeros((len(masks), 4), np.int64)
    for box, mask in zip(boxes, masks, strict=True):
        rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
        box[:] = columns[0], rows[0], columns[-1] + 1, rows[-1] + 1
    return boxes


def box_nms(boxes: Array, scores: Array, iou: float) -> Array:
    """Greedy non-maximum suppression: (K,) indices kept, by falling score; ties by index.

    boxes: (M, 4) left, top, right, bottom, non-empty; a box goes when its IoU with a kept one is > `iou`.
    """
    order = np.argsort(-scores, kind="stable")
    left, top, right, bottom = boxes.astype(float).T
    area = (right - left) * (bottom - top)
    kept = []
    while len(order):
        best, rest = order[0], order[1:]
        kept.append(int(best))
        width = np.minimum(right[best], right[rest]) - np.maximum(left[best], left[rest])
        height = np.minimum(bottom[best], bottom[rest]) - np.maximum(top[best], top[rest])
        common = np.maximum(width, 0) * np.maximum(height, 0)
        order = rest[common / (area[best] + area[rest] - common) <= iou]
    return np.array(kept, int)


def clean_regions(mask: Array, min_region: int) -> tuple[Array, bool]:
    """Fill holes below `min_region` px, then drop islands below it; the largest island always stays.

    mask: (H, W) bool, not empty. Returns the mask and whether anything changed. The result equals that of
    SAM's `remove_small_regions`; only the surroundings of the mask are processed.
    """
    (left, top, right, bottom), (height, width) = mask_boxes(mask[None])[0], mask.shape
    beyond = np.array([top * width, (height - bottom) * width, left * height, (width - right) * height])
    window = np.s_[max(top - 1, 0) : bottom + 1, max(left - 1, 0) : right + 1]
    if ((beyond > 0) & (beyond < min_region)).any():  # the area beyond the box may itself be a small hole
        window, beyond = np.s_[0:height, 0:width], np.zeros(4, int)
    holes, count = scipy.ndimage.label(~mask[window], EIGHT)
    small = np.bincount(holes.ravel(), minlength=count + 1) < min_region
    for side, goes_on in zip((holes[0], holes[-1], holes[:, 0], holes[:, -1]), beyond > 0, strict=True):
        if goes_on:
            small[side] = False
    small[0] = False  # the mask itself
    islands, count = scipy.ndimage.label(mask[window] | small[holes], EIGHT)
    sizes = np.bincount(islands.ravel(), minlength=count + 1)
    keep = sizes >= min_region
    if not keep[1:].any():
        keep[1 + np.argmax(sizes[1:])] = True
    keep[0] = False
    cleaned = np.zeros_like(mask)
    cleaned[window] = keep[islands]
    return cleaned, not np.array_equal(cleaned, mask)


def common_pixels(masks: Array) -> Array:
    """Return (M, M) int64: pixels in both of two masks; areas on the diagonal."""
    flat = masks.reshape(len(masks), -1)
    total = np.zeros((len(masks), len(masks)), np.int64)
    for part in pieces(flat.shape[1], PIXELS_PER_PRODUCT):
        pixels = flat[:, part].astype(np.float32)
        total += (pixels @ pixels.T).astype(np.int64)  # exact: counts stay below 2**24
    return total


def mask_nms(masks: Array, scores: Array, config: MaskConfig) -> Array:
    """Return (K,) indices of the masks that stay, rising.

    masks: (M, H, W) bool, none empty; scores: (M,) stability times predicted IoU. A mask is removed if its
    IoU with any higher-scored mask, removed or not, is > nms_iou; if its score is <= nms_score; or if it is
    inside another mask of any score, so that 1 - (product of the common shares of both areas) > nms_inner.
    Source: `mask_nms` of LangSplat's preprocessing, with the thresholds that it passes.
    """
    common = common_pixels(masks)
    area = np.diag(common)
    rank = np.empty(len(scores), int)
    rank[np.argsort(-scores, kind="stable")] = np.arange(len(scores))
    iou = common / np.maximum(area[:, None] + area[None] - common, 1)
    rival = (iou > config.nms_iou) & (rank[None] < rank[:, None])
    share = common / np.maximum(area[:, None], 1)  # of the row's mask in the column's
    # at least 85 % of it in another mask, of which it covers less than half
    inside = (share >= 0.85) & (share.T < 0.5) & (1 - share * share.T > config.nms_inner)
    return np.flatnonzero((scores > config.nms_score) & ~rival.any(axis=1) & ~inside.any(axis=1))


# Hierarchical merging of the regions of a photograph, for `GraphMasks`.

CONTRAST_REACH = 2  # px on either side of a boundary, because blurred edges are wider than one step


class RegionGraph:
    """Region adjacency graph of an image.

    The cheapest pair merges first, so that regions of a later partition are unions of earlier ones. The cost
    of a pair is the distance of its mean colours plus the mean contrast along the common boundary, reduced
    for small regions and for enclosed ones.
    """

    def __init__(self, labels: Array, colours: Array) -> None:
        """labels: (H, W) int, 0..N-1, each present; colours: (H, W, 3) lightness and two chromaticities."""
        self._labels = labels
        count = int(labels.max()) + 1
        flat = labels.ravel()
        # Python numbers: thousands of costs are computed one at a time.
        self._size = np.bincount(flat, minlength=count).astype(float).tolist()  # px
        shades = colours * (0.25, 1.0, 1.0)  # differences in lightness are often shading
        sums = [np.bincount(flat, shades[..., c].ravel(), count) for c in range(3)]
        self._mean = (np.stack(sums, axis=1) / np.array(self._size)[:, None]).tolist()
        self._neighbours = _adjacency(labels, colours, count)
        self._perimeter = [sum(length for length, _ in edges.values()) for edges in self._neighbours]
        self._parent = np.arange(count)
        self._version = [0] * count  # rises with every change: heap entries of another version are stale
        self._heap: list[tuple[float, int, int, int, int]] = []
        for i in range(count):
            for j in self._neighbours[i]:
                if i < j:
                    self._push(i, j)

    def merge_until(self, cost: float, min_fraction: float) -> None:
        """Merge pairs cheaper than `cost`, then regions below `min_fraction` of the image."""
        while self._heap and self._heap[0][0] <= cost:
            _, i, j, version_i, version_j = heapq.heappop(self._heap)
            if (self._version[i], self._version[j]) == (version_i, version_j):
                self._merge(i, j)
        alive = np.flatnonzero(self._parent == np.arange(len(self._parent)))
        while len(alive) > 1:
            smallest = min(alive.tolist(), key=self._size.__getitem__)
            if self._size[smallest] >= min_fraction * self._labels.size:
                return
            into = min(self._neighbours[smallest], key=lambda other: (self._cost(smallest, other), other))
            self._merge(into, smallest)
            alive = alive[alive != smallest]

    def partition(self) -> Array:
        """Return (H, W) int: the current regions, numbered 0..M-1."""
        roots = self._parent
        while not np.array_equal(roots, roots[roots]):
            roots = roots[roots]
        return np.unique(roots, return_inverse=True)[1][self._labels]

    def _cost(self, i: int, j: int) -> float:
        length, contrast = self._neighbours[i][j]
        smaller = min(self._size[i], self._size[j]) / self._labels.size
        shared = length / min(self._perimeter[i], self._perimeter[j])
        enclosure = 1 - 0.5 * max(0.0, 2 * shared - 1)  # half the cost for one wholly inside another
        difference = math.dist(self._mean[i], self._mean[j]) + contrast / length
        # Small regions merge more cheaply; the factor is 1 at a 200th of the image.
        return difference * (smaller / 0.005) ** 0.25 * enclosure

    def _push(self, i: int, j: int) -> None:
        heapq.heappush(self._heap, (self._cost(i, j), i, j, self._version[i], self._version[j]))

    def _merge(self, kept: int, gone: int) -> None:
        size = self._size[kept] + self._size[gone]
        share = self._size[gone] / size
        pairs = zip(self._mean[kept], self._mean[gone], strict=True)
        self._mean[kept], self._size[kept] = [a + share * (b - a) for a, b in pairs], size
        edges = self._neighbours[gone]
        self._perimeter[kept] += self._perimeter[gone] - 2 * edges[kept][0]
        for other, (length, contrast) in edges.items():
            del self._neighbours[other][gone]
            if other != kept:
                old = self._neighbours[kept].get(other, (0.0, 0.0))
                edge = (old[0] + length, old[1] + contrast)
                self._neighbours[kept][other] = self._neighbours[other][kept] = edge
        self._neighbours[gone] = {}
        self._parent[gone] = kept
        self._version[kept] += 1
        self._version[gone] += 1
        for other in self._neighbours[kept]:
            self._push(kept, other)


def _adjacency(labels: Array, colours: Array, count: int) -> list[dict[int, tuple[float, float]]]:
    """Return for each region: neighbour -> (length of the common boundary, px; sum of contrast along it)."""
    weighted = colours * (0.4, 1.0, 1.0)
    pairs, contrasts = [], []
    for axis in (0, 1):
        steps = np.arange(labels.shape[axis] - 1)
        before = weighted.take(np.maximum(steps - CONTRAST_REACH + 1, 0), axis)
        after = weighted.take(np.minimum(steps + CONTRAST_REACH, labels.shape[axis] - 1), axis)
        first, second = labels.take(steps, axis), labels.take(steps + 1, axis)
        boundary = first != second
        low, high = np.minimum(first, second)[boundary], np.maximum(first, second)[boundary]
        pairs.append(low.astype(np.int64) * count + high)
        contrasts.append(np.linalg.norm(before - after, axis=-1)[boundary])
    keys, inverse = np.unique(np.concatenate(pairs), return_inverse=True)
    lengths = np.bincount(inverse, minlength=len(keys))
    sums = np.bincount(inverse, np.concatenate(contrasts), len(keys))
    neighbours: list[dict[int, tuple[float, float]]] = [{} for _ in range(count)]
    for key, length, total in zip(keys.tolist(), lengths.tolist(), sums.tolist(), strict=True):
        i, j = divmod(key, count)
        neighbours[i][j] = neighbours[j][i] = (float(length), total)
    return neighbours


# Masks without weights: superpixels, merged by colour and boundary into three nested partitions. They follow
# colours and materials and not objects; SAM's masks are better.

VERSION = 2
WORK_SIDE = 400  # px, longer side of the image on which regions are found
ROUNDS = 60  # of denoising at most
CHROMA_FALL = 0.045
MERGE_COSTS = (6.0, 11.0, 19.0)  # colour difference plus contrast; chosen on photographs and renderings
MIN_FRACTIONS = (0.0008, 0.002, 0.004)  # of the image's area


class GraphMasks(MaskSource):
    """Masks without weights: regions of similar colour."""

    name = "graph (no weights)"
    agrees = False

    @property
    def key(self) -> str:
        return json.dumps(["graph", VERSION, WORK_SIDE, MERGE_COSTS, MIN_FRACTIONS])

    def __call__(self, image: Array, progress: Progress) -> LevelMasks:
        """Return the masks of an image (H, W, 3) uint8; at every level they cover each pixel exactly once."""
        progress("finding regions", 0.0)
        labels = nested_partitions(image)
        progress("finding regions", 1.0)
        subparts, parts, wholes = (one == np.arange(one.max() + 1)[:, None, None] for one in labels)
        return subparts, parts, wholes


def nested_partitions(image: Array) -> Array:
    """Divide (H, W, 3) uint8 into (3, H, W) int32 regions, each a union of regions of the level before."""
    from skimage.color import rgb2lab
    from skimage.segmentation import slic

    height, width = image.shape[:2]
    scale = min(1.0, WORK_SIDE / max(height, width))
    size = max(1, round(width * scale)), max(1, round(height * scale))
    small = np.asarray(Image.fromarray(image).resize(size, Image.Resampling.BOX))
    # The weight removes the texture of a carpet and keeps edges.
    lab = 100 * denoise((rgb2lab(small) / 100).astype(np.float32), 0.12)
    superpixels = slic(
        lab * np.array([0.6, 1, 1]),
        n_segments=min(700, lab.shape[0] * lab.shape[1]),
        compactness=0.1,  # its colours are scaled to [0, 1]
        max_num_iter=8,
        start_label=0,
        convert2lab=False,
    )
    numbered = np.unique(superpixels, return_inverse=True)[1].reshape(superpixels.shape)
    graph = RegionGraph(numbered, _paint(lab))
    levels = []
    for cost, min_fraction in zip(MERGE_COSTS, MIN_FRACTIONS, strict=True):
        graph.merge_until(cost, min_fraction)
        levels.append(graph.partition())
    rows = ((np.arange(height) + 0.5) * size[1] / height).astype(int)
    columns = ((np.arange(width) + 0.5) * size[0] / width).astype(int)
    return np.stack(levels)[:, rows[:, None], columns].astype(np.int32)


def denoise(image: Array, weight: float) -> Array:
    """Return an (H, W, C) float32 image of reduced total variation: less noise, the same edges.

    By Chambolle 2004; equals scikit-image's `denoise_tv_chambolle` to 1e-6, in an eighth of its time.
    """
    given = np.pad(image.transpose(2, 0, 1), ((0, 0), (0, 0), (0, 1)), "edge")
    images = given.copy()
    shared_workers().run(_denoise, len(given), given, weight, images)
    return np.ascontiguousarray(images[..., :-1].transpose(1, 2, 0))


@kernel
def _denoise(first: int, last: int, given: Array, weight: float, images: Array) -> None:
    """Fill `images` [first, last) from `given`, both (C, H, W + 1) with the last column repeated."""
    _, height, width = images.shape
    step, one, share, part = np.float32(0.25), np.float32(1), np.float32(0.25 / weight), np.float32(weight)
    energies, started, before = np.empty(width, np.float32), 0.0, 0.0
    for n in range(first, last):
        image, dual = images[n], np.zeros((2, height + 1, width), np.float32)  # 0 before the first pixels
        for number in range(ROUNDS):
            energies[:] = 0
            for y in range(height):
                above, down, right = dual[0, y], dual[0, y + 1], dual[1, y + 1]
                for x in range(width - 1):
                    change = above[x + 1] - (down[x + 1] + right[x + 1]) + right[x]
                    image[y, x] = given[n, y, x] + change
                    energies[x] += change * change
                image[y, width - 1] = image[y, width - 2]
            for y in range(height):
                below, down, right = image[min(y + 1, height - 1)], dual[0, y + 1], dual[1, y + 1]
                for x in range(width - 1):
                    a, b = below[x] - image[y, x], image[y, x + 1] - image[y, x]
                    size = np.sqrt(a * a + b * b)
                    down[x + 1] = (down[x + 1] - step * a) / (one + share * size)
                    right[x + 1] = (right[x + 1] - step * b) / (one + share * size)
                    energies[x] += part * size
            energy = energies.sum()
            started = started if number else energy
            if number and abs(before - energy) < 2e-4 * started:
                break
            before = energy


def _paint(lab: Array) -> Array:
    """Return (H, W, 3) colours from CIELAB in which shading changes only the first channel, lightness.

    In CIELAB a, b and L + 16 are combinations of cube roots, so all three scale alike with the light on a
    surface: a / (L + 16) and b / (L + 16) hardly depend on it. Large chromas are compressed, since the eye
    distinguishes them less well (0.045 is the factor of CIE 94) and cube roots are linear in deep shade.
    """
    lightness = np.maximum(lab[..., :1], 0)
    chromaticity = lab[..., 1:] * 66.0 / (lightness + 16)  # at L = 50 of the size of a and b
    chroma = np.linalg.norm(chromaticity, axis=-1, keepdims=True)
    compressed = np.log1p(CHROMA_FALL * chroma) / np.maximum(CHROMA_FALL * chroma, 1e-9)
    return np.concatenate([lightness, chromaticity * np.where(chroma > 0, compressed, 1)], axis=-1)
