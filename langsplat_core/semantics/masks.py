"""Masks at three levels: what every source of masks gives, and how they become one map per level."""

import heapq
import json
from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from PIL import Image

from langsplat_core.arrays import Array, check_array
from langsplat_core.progress import Progress


@dataclass(frozen=True, eq=False)
class LevelMasks:
    """Masks of one photograph at the levels subpart, part, whole; a level may have none."""

    masks: tuple[Array, Array, Array]  # (M_l, H, W) bool each; may overlap, later ones lie on top
    scores: tuple[Array, Array, Array]  # (M_l,) float32 each, in [0, 1]

    def __post_init__(self) -> None:
        dims: dict[str, int] = {}
        for level, (masks, scores) in enumerate(zip(self.masks, self.scores, strict=True)):
            count = f"M{level}"
            dims = check_array(f"masks[{level}]", masks, (count, "H", "W"), dims, dtype=np.bool_)
            dims = check_array(f"scores[{level}]", scores, (count,), dims, dtype=np.float32)


class MaskSource(Protocol):
    """Finds the masks of a photograph."""

    agrees: bool = True
    """False where masks of different photographs differ so much that what all of them agree on takes their
    place (`pipeline.language_field`) before CLIP sees it."""

    @property
    def name(self) -> str:
        """Name for messages, such as "graph (no weights)"."""

    @property
    def key(self) -> str:
        """Everything that its masks depend on besides the photograph: stored masks with another are stale."""

    @abstractmethod
    def __call__(self, image: Array, progress: Progress) -> LevelMasks:
        """Masks of an image (H, W, 3) uint8."""

    def begin(self, image: Array, progress: Progress) -> Callable[[], LevelMasks]:
        """Do the model's part, and return what does the rest, in any thread.

        A model meanwhile sees the next photograph. By default all is done at once.
        """
        found = self(image, progress)
        return lambda: found


def label_maps(levels: LevelMasks) -> Array:
    """(3, H, W) int32: the row of the mask that is on top at each pixel, -1 where there is none.

    Rows count through all three levels, subpart first, as in LangSplat's `*_s.npy` (without its "default"
    level); within a level later masks cover earlier ones. Unlike there, a mask that ends with no visible
    pixel has no row, so every row from 0 to the maximum occurs, each in one level.
    """
    maps = np.full((len(levels.masks), *levels.masks[0].shape[1:]), -1, np.int32)
    first = 0
    for level, masks in enumerate(levels.masks):
        for row, mask in enumerate(masks):
            maps[level][mask] = row
        visible = np.unique(maps[level][maps[level] >= 0])
        compact = np.full(len(masks) + 1, -1, np.int32)  # the last entry is what -1 indexes
        compact[visible] = np.arange(first, first + len(visible))
        maps[level] = compact[maps[level]]
        first += len(visible)
    return maps


# Hierarchical merging of the regions of a photograph: the data structure behind the graph's masks.

MEAN_LIGHTNESS = 0.25  # weight of lightness where mean colours are compared: shade is no other thing
EDGE_LIGHTNESS = 0.4  # and where a boundary's contrast is measured
CONTRAST_REACH = 2  # px on either side of a boundary, because blurred edges are wider than one step
SIZE_POWER = 0.25  # how much cheaper small regions merge than large ones
SIZE_UNIT = 1 / 200  # of the image: a region of this size merges at its plain cost
ENCLOSED = 0.5  # a region wholly inside another merges with it at this much less


class RegionGraph:
    """Regions of an image with their neighbours.

    The cheapest pair merges first, so that every later partition is made of unions of every earlier one. The
    cost of a pair is the distance of its mean colours plus the mean contrast along the common boundary, less
    for small regions and for those that the other one encloses.
    """

    def __init__(self, labels: Array, colours: Array) -> None:
        """labels: (H, W) int, 0..N-1, each present; colours: (H, W, 3) lightness and two chromaticities."""
        self._labels = labels
        count = int(labels.max()) + 1
        flat = labels.ravel()
        self._size = np.bincount(flat, minlength=count).astype(float)  # px
        shades = colours * (MEAN_LIGHTNESS, 1.0, 1.0)
        sums = [np.bincount(flat, shades[..., c].ravel(), count) for c in range(3)]
        self._mean = np.stack(sums, axis=1) / self._size[:, None]
        self._neighbours = _adjacency(labels, colours, count)
        self._perimeter = [sum(length for length, _ in edges.values()) for edges in self._neighbours]
        self._parent = np.arange(count)
        self._version = [0] * count  # rises with every change: entries of the heap with another are stale
        self._heap: list[tuple[float, int, int, int, int]] = []
        for i in range(count):
            for j in self._neighbours[i]:
                if i < j:
                    self._push(i, j)

    def merge_until(self, cost: float, min_fraction: float) -> None:
        """Merge every pair cheaper than `cost`, then small regions with their cheapest neighbour.

        Small is below `min_fraction` of the image.
        """
        while self._heap and self._heap[0][0] <= cost:
            _, i, j, version_i, version_j = heapq.heappop(self._heap)
            if (self._version[i], self._version[j]) == (version_i, version_j):
                self._merge(i, j)
        alive = np.flatnonzero(self._parent == np.arange(len(self._parent)))
        while len(alive) > 1:
            smallest = int(alive[np.argmin(self._size[alive])])
            if self._size[smallest] >= min_fraction * self._labels.size:
                return
            into = min(self._neighbours[smallest], key=lambda other: (self._cost(smallest, other), other))
            self._merge(into, smallest)
            alive = alive[alive != smallest]

    def partition(self) -> Array:
        """(H, W) int: the regions as they are now, numbered 0..M-1."""
        roots = self._parent
        while not np.array_equal(roots, roots[roots]):
            roots = roots[roots]
        return np.unique(roots, return_inverse=True)[1][self._labels]

    def _cost(self, i: int, j: int) -> float:
        length, contrast = self._neighbours[i][j]
        smaller = min(self._size[i], self._size[j]) / self._labels.size
        shared = length / min(self._perimeter[i], self._perimeter[j])
        enclosure = 1 - ENCLOSED * max(0.0, 2 * shared - 1)
        difference = float(np.linalg.norm(self._mean[i] - self._mean[j])) + contrast / length
        return float(difference * (smaller / SIZE_UNIT) ** SIZE_POWER * enclosure)

    def _push(self, i: int, j: int) -> None:
        heapq.heappush(self._heap, (self._cost(i, j), i, j, self._version[i], self._version[j]))

    def _merge(self, kept: int, gone: int) -> None:
        size = self._size[kept] + self._size[gone]
        weighted = self._mean[kept] * self._size[kept] + self._mean[gone] * self._size[gone]
        self._mean[kept], self._size[kept] = weighted / size, size
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
    """Per region: neighbour -> (length of the common boundary, px; sum of the contrast along it)."""
    weighted = colours * (EDGE_LIGHTNESS, 1.0, 1.0)
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


# Masks without any weights: superpixels, merged by colour and boundary into three nested partitions.
#
# It knows nothing of objects. What it calls whole is what one paint or one material covers; SAM does better
# wherever its weights can be had.

VERSION = 1
WORK_SIDE = 400  # px, longer side at which regions are found; contrasts below are per pixel of it
SUPERPIXELS = 700
COMPACTNESS = 0.1  # of SLIC, whose colours are scaled to [0, 1]
SMOOTHING = 0.12  # total variation weight on L/100: removes carpet, keeps edges
TYPICAL = 66.0  # L + 16 at L = 50, so that chromaticities below are of the size of a and b
CHROMA_FALL = 0.045
MERGE_COSTS = (6.0, 11.0, 19.0)  # colour difference plus contrast; chosen on photographs and renderings
MIN_FRACTIONS = (0.0008, 0.002, 0.004)  # of the image's area


class GraphMasks(MaskSource):
    """Masks without weights: regions of like colour."""

    name = "graph (no weights)"
    agrees = False

    @property
    def key(self) -> str:
        return json.dumps(["graph", VERSION, WORK_SIDE, MERGE_COSTS, MIN_FRACTIONS])

    def __call__(self, image: Array, progress: Progress) -> LevelMasks:
        """Masks of an image (H, W, 3) uint8; at every level they cover each pixel exactly once."""
        progress("finding regions", 0.0)
        levels = nested_partitions(image)
        masks = [labels == np.arange(labels.max() + 1)[:, None, None] for labels in levels]
        progress("finding regions", 1.0)
        subpart, part, whole = (np.ones(len(stack), np.float32) for stack in masks)
        return LevelMasks((masks[0], masks[1], masks[2]), (subpart, part, whole))


def nested_partitions(image: Array) -> Array:
    """(3, H, W) int32 regions of an image (H, W, 3) uint8, numbered from 0 at each level.

    Every region is a union of regions of the level before. Deterministic.
    """
    from skimage.color import rgb2lab
    from skimage.restoration import denoise_tv_chambolle

    height, width = image.shape[:2]
    scale = min(1.0, WORK_SIDE / max(height, width))
    size = max(1, round(width * scale)), max(1, round(height * scale))
    small = np.asarray(Image.fromarray(image).resize(size, Image.Resampling.BOX))
    lab = 100 * denoise_tv_chambolle(rgb2lab(small) / 100, SMOOTHING, max_num_iter=60, channel_axis=-1)
    graph = RegionGraph(_superpixels(lab), _paint(lab))
    levels = []
    for cost, min_fraction in zip(MERGE_COSTS, MIN_FRACTIONS, strict=True):
        graph.merge_until(cost, min_fraction)
        levels.append(graph.partition())
    rows = ((np.arange(height) + 0.5) * size[1] / height).astype(int)
    columns = ((np.arange(width) + 0.5) * size[0] / width).astype(int)
    return np.stack(levels)[:, rows[:, None], columns].astype(np.int32)


def _paint(lab: Array) -> Array:
    """(H, W, 3) CIELAB -> (H, W, 3) colours of which shading changes only the first channel, lightness.

    In CIELAB both a, b and L + 16 are differences of cube roots, so all three scale alike with the light that
    falls on a surface: a / (L + 16) and b / (L + 16) hardly depend on it. Large chromas are compressed, since
    the eye tells those apart less well (the factor 0.045 is that of CIE 94), and since in deep shade the cube
    roots of CIELAB turn into straight lines.
    """
    lightness = np.maximum(lab[..., :1], 0)
    chromaticity = lab[..., 1:] * TYPICAL / (lightness + 16)
    chroma = np.linalg.norm(chromaticity, axis=-1, keepdims=True)
    compressed = np.log1p(CHROMA_FALL * chroma) / np.maximum(CHROMA_FALL * chroma, 1e-9)
    return np.concatenate([lightness, chromaticity * np.where(chroma > 0, compressed, 1)], axis=-1)


def _superpixels(lab: Array) -> Array:
    """(H, W) int superpixels, numbered 0..N-1."""
    from skimage.segmentation import slic

    labels = slic(
        lab * np.array([0.6, 1, 1]),
        n_segments=min(SUPERPIXELS, lab.shape[0] * lab.shape[1]),
        compactness=COMPACTNESS,
        max_num_iter=8,
        start_label=0,
        convert2lab=False,
    )
    return np.unique(labels, return_inverse=True)[1].reshape(labels.shape)
