"""Regions: patches of the surface that mean the same, at each level.

Gaussians vary, things do not: an answer made of whole regions has the borders of the things and no speckles,
and its peak is a mean over a patch instead of one lucky Gaussian. Regions are found once for a scene, on the
graph of neighbours along its surface, by the criterion of Felzenszwalb and Huttenlocher (2004): two patches
merge where the step between their meanings is no larger than the steps within either. Where a scene knows
which thing a Gaussian belongs to (`LanguageField.things`), these are the borders of the coarsest level:
the encoder may see the front and the back of a thing differently, and it stays one.
"""

from dataclasses import dataclass

import numpy as np

from langsplat_core.arrays import Array, unit
from langsplat_core.compiled import kernel
from langsplat_core.query.surface import Surface
from langsplat_core.scene import LEVELS, NO_THING, LanguageField

SCALE = 5.0  # of the criterion, in 1 - cosine times Gaussians: larger prefers larger regions
SMALLEST = 10  # Gaussians; smaller patches join the neighbour that means the most similar
BORDER = 0.3  # added to the step between two things, in 1 - cosine
UNKNOWN = 2.0  # step between a Gaussian with a meaning and one without: as much as between opposites
CHUNK = 65_536  # links whose ends are compared at a time
STEPS = 65_535 / (UNKNOWN + BORDER)  # of 1 - cosine that are told apart: 16 bits sort in linear time


@dataclass(frozen=True, eq=False)
class Regions:
    """Regions of the M Gaussians of a surface."""

    of: Array  # (3, M) int32 number of the region at each level, from 0
    sizes: tuple[Array, Array, Array]  # (R,) Gaussians in each region of a level

    def means(self, values: Array, surface: Surface) -> tuple[Array, Array, Array]:
        """(3, N) values of all Gaussians -> of every level the (R,) float64 opacity-weighted means."""
        made = []
        for of, row, size in zip(self.of, values, self.sizes, strict=True):
            total = np.bincount(of, surface.weights, len(size))
            made.append(np.bincount(of, surface.weights * row[surface.rows], len(size)) / total)
        return made[0], made[1], made[2]


def build_regions(surface: Surface, field: LanguageField) -> Regions:
    """Of a scene's surface: 0.3 s for 80 000 Gaussians."""
    links = surface.links.tocoo()
    once = links.row < links.col
    ends = links.row[once].astype(np.int32), links.col[once].astype(np.int32)
    of, sizes = [], []
    for level in range(len(LEVELS)):
        steps = _steps(field, level, surface.rows, ends)
        if level == len(LEVELS) - 1 and field.things is not None:
            steps = _along_things(steps, field.things[surface.rows], ends)
        ranks = np.round(steps * STEPS).astype(np.uint16)
        order = np.argsort(ranks, kind="stable").astype(np.int32)
        roots = _merge(len(surface.rows), *ends, steps.astype(np.float32), order, SCALE, SMALLEST)
        _, numbers, count = np.unique(roots, return_inverse=True, return_counts=True)
        of.append(numbers.astype(np.int32).reshape(-1))
        sizes.append(count)
    return Regions(np.stack(of), (sizes[0], sizes[1], sizes[2]))


def _steps(field: LanguageField, level: int, rows: Array, ends: tuple[Array, Array]) -> Array:
    """(E,) 1 - cosine between what the two ends of each link mean, in [0, 2]."""
    known, latents = field.known[level][rows], field.latents[level][rows]
    a, b = ends
    if field.codec.space == "index":
        codewords = field.codec.decode(np.arange(field.codec.index_size, dtype=np.uint16)[:, None])
        apart = 1 - codewords @ codewords.T
        codes = latents[:, 0]
        steps = apart[codes[a], codes[b]]
    else:
        directions = unit(latents.astype(np.float32))
        steps = np.empty(len(a), np.float32)
        for start in range(0, len(a), CHUNK):  # latents may be as long as the encoder's vectors
            part = slice(start, start + CHUNK)
            steps[part] = 1 - np.einsum("ed,ed->e", directions[a[part]], directions[b[part]])
    both, neither = known[a] & known[b], ~known[a] & ~known[b]
    return np.asarray(np.where(both, steps, np.where(neither, 0.0, UNKNOWN)).clip(0, UNKNOWN))


def _along_things(steps: Array, things: Array, ends: tuple[Array, Array]) -> Array:
    """No step within a thing, a larger one between two."""
    a, b = things[ends[0]], things[ends[1]]
    told = (a != NO_THING) & (b != NO_THING)
    return np.where(told, np.where(a == b, 0, steps + BORDER), steps)


@kernel
def _merge(
    count: int, first: Array, second: Array, steps: Array, order: Array, scale: float, smallest: int
) -> Array:
    """(M,) a member of each Gaussian's region, the same for all of a region. order: of the links, by rising
    step."""
    parent, size = np.arange(count, dtype=np.int32), np.ones(count, np.int32)
    largest = np.zeros(count, np.float32)  # step within each region
    for gathering in range(2):  # the criterion, then the small ones
        for link in order:
            a, b = first[link], second[link]
            while parent[a] != a:
                parent[a] = parent[parent[a]]
                a = parent[a]
            while parent[b] != b:
                parent[b] = parent[parent[b]]
                b = parent[b]
            if a == b:
                continue
            if gathering == 0:
                join = steps[link] <= min(largest[a] + scale / size[a], largest[b] + scale / size[b])
            else:
                join = size[a] < smallest or size[b] < smallest
            if join:
                parent[b] = a
                size[a] += size[b]
                largest[a] = max(steps[link], largest[a], largest[b])
    for item in range(count):
        root = item
        while parent[root] != root:
            root = parent[root]
        parent[item] = root
    return parent
