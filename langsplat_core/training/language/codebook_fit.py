"""A scene's own codebook: as many codewords as its meanings need, and not more."""

import logging
from collections.abc import Callable

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.config import CodecConfig
from langsplat_core.progress import Progress, silent
from langsplat_core.scene import CodebookCodec
from langsplat_core.scene.codec import principal_colours
from langsplat_core.scene.codec.codebook import stretched
from langsplat_core.training.language.autoencoder_fit import train_autoencoder
from langsplat_core.training.language.clustering import nearest_centres, spherical_kmeans
from langsplat_core.training.language.relevancy_error import RelevancyError, Vocabulary, relevancy_error

log = logging.getLogger("langsplat")

SMALLEST = 64  # codewords that are tried first
LARGEST_SHARE = 4  # vectors per codeword, at least: with fewer, a codebook is a copy
JUDGED = 5  # every so many vectors, one is kept from the fit and judges it
FIRST_ROUNDS, FURTHER_ROUNDS = 8, 4
REFINEMENTS = 2  # halvings of the interval that holds the smallest codebook, by ratio
COLOUR_STEPS, COLOUR_BATCH = 300, 64  # of the autoencoder of 3 numbers whose latents are the colours
FEWEST_FOR_COLOURS = 16  # codewords; fewer have their principal axes for colours


def fit_codebook(
    vectors: Array, config: CodecConfig, vocabulary: Vocabulary, progress: Progress = silent
) -> CodebookCodec:
    """The codebook of (M, D) float32 unit vectors: of `config.size` codewords, or, where that is 0, the
    smallest that keeps the mean relevancy error on vectors it was not fitted to within
    `config.max_relevancy_error`. Codewords are float16 numbers, so that a file can hold them as such."""
    order = np.random.default_rng(config.seed).permutation(len(vectors))
    judged = vectors[order[::JUDGED]] if len(vectors) > 4 * JUDGED else vectors
    fitted = vectors[np.delete(order, np.s_[::JUDGED])] if len(vectors) > 4 * JUDGED else vectors
    generator = np.random.default_rng(config.seed)

    def grow(size: int, start: Array | None) -> Array:
        progress(f"codebook: {size} codewords", 0.1 + 0.6 * min(size / 2_048, 1))
        rounds = FIRST_ROUNDS if start is None else FURTHER_ROUNDS
        return rounded(spherical_kmeans(fitted, size, rounds, start, generator))

    if config.size:
        codewords = grow(config.size, None)
    else:
        codewords = _smallest(grow, judged, len(fitted), config.max_relevancy_error, vocabulary)
    progress("colours of the codewords", 0.8)
    nearest, _ = nearest_centres(fitted, codewords)
    usage = np.bincount(nearest, minlength=len(codewords)).astype(np.float64)
    return CodebookCodec(codewords, rounded(codeword_colours(codewords, usage, config)))


def _smallest(
    grow: Callable[[int, Array | None], Array],
    judged: Array,
    available: int,
    budget: float,
    vocabulary: Vocabulary,
) -> Array:
    """Doubled until good enough, then halved between the last two sizes."""
    most = max(min(available // LARGEST_SHARE, 65_535), 1)
    size, smaller, codewords = min(SMALLEST, most), None, np.zeros((0, 0), np.float32)
    while True:
        codewords = grow(size, smaller)
        error = codebook_error(codewords, judged, vocabulary)
        if error.mean <= budget or size == most or len(codewords) < size:
            break
        smaller, size = codewords, min(2 * size, most)
    if error.mean > budget and size == most:
        log.warning(
            "codebook: %d codewords still have a mean relevancy error of %.4f", len(codewords), error.mean
        )
    if smaller is None or error.mean > budget:
        return codewords
    low, high = len(smaller), len(codewords)
    for _ in range(REFINEMENTS):
        middle = round((low * high) ** 0.5)
        tried = grow(middle, smaller)
        if codebook_error(tried, judged, vocabulary).mean <= budget:
            codewords, high = tried, middle
        else:
            smaller, low = tried, middle
    return codewords


def codebook_error(codewords: Array, vectors: Array, vocabulary: Vocabulary) -> RelevancyError:
    """Of every vector's nearest codeword in its place."""
    nearest, _ = nearest_centres(vectors, codewords)
    return relevancy_error(codewords[nearest], vectors, vocabulary)


def codeword_colours(codewords: Array, usage: Array, config: CodecConfig) -> Array:
    """(K, 3) float32 in [0, 1]: latents of the paper's autoencoder of 3 numbers, fitted to the (K, D)
    codewords, each axis stretched over what (K,) usage says occurs."""
    if len(codewords) < FEWEST_FOR_COLOURS:
        return principal_colours(codewords, usage)
    codec = train_autoencoder(codewords, 3, COLOUR_STEPS, COLOUR_BATCH, config.lr, config.seed)
    return stretched(codec.encode(codewords), usage)


def rounded(numbers: Array) -> Array:
    """float32 numbers, each moved to the nearest float16 one."""
    return numbers.astype(np.float16).astype(np.float32)
