"""Spherical k-means: few unit vectors that many lie close to (Dhillon and Modha 2001)."""

import numpy as np

from langsplat_core.arrays import Array, unit

CHUNK = 8_192  # vectors compared with all centres at a time
STEP = 8  # one in so many centres is added, or given up, at a time


def nearest_centres(vectors: Array, centres: Array) -> tuple[Array, Array]:
    """Return the (M,) int64 nearest centre of each vector, and its (M,) float32 cosine.

    vectors: (M, D), centres: (K, D) float32 unit vectors.
    """
    nearest, cosines = np.empty(len(vectors), np.int64), np.empty(len(vectors), np.float32)
    for start in range(0, len(vectors), CHUNK):
        part = slice(start, start + CHUNK)
        products = vectors[part] @ centres.T
        nearest[part] = products.argmax(1)
        cosines[part] = np.take_along_axis(products, nearest[part, None], 1)[:, 0]
    return nearest, cosines


def spherical_kmeans(
    vectors: Array,
    count: int,
    rounds: int = 8,
    start: Array | None = None,
    generator: np.random.Generator | None = None,
) -> Array:
    """Return at most `count` unit centres (K, D) float32 of (M, D) float32 unit vectors.

    Begins at `start` (K' <= count centres) and adds vectors that these fit badly, drawn by their distance: a
    quarter more than asked for, of which those are given up again, round by round, that would be missed
    least. That finds the gaps which plain k-means leaves where two clusters share a centre. Fewer than
    `count` come back where fewer different vectors are there.
    """
    generator = generator or np.random.default_rng(0)
    centres = np.zeros((0, vectors.shape[1]), np.float32) if start is None else start
    extra = (count - len(centres)) / 4
    centres = _grown(vectors, centres, count + round(extra), generator)
    for done in range(1, rounds + 1):
        nearest, counts, missed = _assigned(vectors, centres)
        size = count + round(extra * max(1 - 2 * done / rounds, 0))
        kept = _without_spare(missed, size)
        centres = _means(vectors, nearest, counts)[kept & (counts > 0)]
    while True:
        _, counts, missed = _assigned(vectors, centres)
        kept = _without_spare(missed, count) & (counts > 0)
        if kept.all():
            return centres
        centres = centres[kept]


def _without_spare(missed: Array, size: int) -> Array:
    """(K,) bool: all but those missed least, where there are more than `size`.

    Only one in `STEP` goes at a time, because of two that are alike neither is missed.
    """
    spare = min(max(len(missed) - size, 0), 1 + len(missed) // STEP)
    kept = np.ones(len(missed), bool)
    kept[np.argsort(missed, kind="stable")[:spare]] = False
    return kept


def _assigned(vectors: Array, centres: Array) -> tuple[Array, Array, Array]:
    """Return the nearest centre of each vector, and how many and how much each centre serves.

    (M,) centres, (K,) vectors of every centre, and (K,) by how much the sum of cosines would fall without it.
    """
    nearest = np.empty(len(vectors), np.int64)
    gain = np.zeros(len(vectors), np.float32)
    for start in range(0, len(vectors), CHUNK):
        part = slice(start, start + CHUNK)
        products = vectors[part] @ centres.T
        nearest[part] = products.argmax(1)
        best = np.take_along_axis(products, nearest[part, None], 1)
        np.put_along_axis(products, nearest[part, None], -1, 1)
        gain[part] = best[:, 0] - products.max(1)
    counts = np.bincount(nearest, minlength=len(centres))
    return nearest, counts, np.bincount(nearest, gain, len(centres))


def _grown(vectors: Array, centres: Array, count: int, generator: np.random.Generator) -> Array:
    """`centres` and badly fitted vectors, few at a time: one gap is not filled ten times."""
    distance = np.full(len(vectors), 2, np.float32)
    new = centres if len(centres) else vectors[_badly_fitted(distance, 1, generator)]
    while True:
        distance = np.minimum(distance, 1 - nearest_centres(vectors, new)[1])
        centres = np.concatenate([centres, new]) if new is not centres else centres
        rows = _badly_fitted(distance, min(count - len(centres), 1 + len(centres) // STEP), generator)
        if len(rows) == 0:
            return centres
        new = vectors[rows]


def _badly_fitted(distance: Array, count: int, generator: np.random.Generator) -> Array:
    """Up to `count` rows, drawn without repetition in proportion to (M,) distances; none that fit."""
    weights = np.where(distance > 1e-5, distance, 0).astype(np.float64)
    possible = int((weights > 0).sum())
    if possible == 0:
        return np.zeros(0, np.int64)
    return generator.choice(len(weights), min(count, possible), replace=False, p=weights / weights.sum())


def _means(vectors: Array, nearest: Array, counts: Array) -> Array:
    """(K, D) float32 directions of the sums over each centre's vectors."""
    order = np.argsort(nearest, kind="stable")
    used = np.flatnonzero(counts)
    firsts = np.concatenate([[0], np.cumsum(counts[used])[:-1]])
    means = np.zeros((len(counts), vectors.shape[1]), np.float32)
    means[used] = unit(np.add.reduceat(vectors[order], firsts, axis=0))
    return means
