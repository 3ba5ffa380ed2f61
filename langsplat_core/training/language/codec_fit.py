"""Fitting codecs to the CLIP vectors of one scene, and what they cost: errors of the relevancy of phrases."""

import logging
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import scipy

from langsplat_core.arrays import Array, pieces, unit
from langsplat_core.config import CodecConfig, check_settings
from langsplat_core.progress import Progress, silent
from langsplat_core.scene import CANONICAL_PHRASES, NO_NODE, LanguageField, Tree
from langsplat_core.scene import codec as codecs
from langsplat_core.scene.codec import AutoencoderCodec, CodebookCodec, Codec
from langsplat_core.scene.surface import Surface
from langsplat_core.semantics.encoders import PhraseEncoder
from langsplat_core.semantics.relevancy import Scale, everyday_phrases, everyday_vectors, relevancy_of
from langsplat_core.training import one_torch_thread

log = logging.getLogger("langsplat")


@dataclass(frozen=True, eq=False)
class Vocabulary:
    """The phrases that errors are measured with, and against which relevancy is read."""

    phrases: Array  # (Q, D) float32 unit text vectors
    scale: Scale

    def relevancy(self, vectors: Array) -> Array:
        """Return (M, Q) relevancy in [0, 1] of (M, D) unit vectors."""
        zero, rate = self.scale.of(vectors @ self.scale.texts.T)
        return relevancy_of(vectors @ self.phrases.T, zero[:, None], rate[:, None])


def everyday_vocabulary(encoder: PhraseEncoder, phrases: tuple[str, ...] = ()) -> Vocabulary:
    """Return the vocabulary of `phrases` and everyday ones in the vectors of `encoder`."""
    texts = list(dict.fromkeys([*phrases, *everyday_phrases(encoder.unknown_words)]))
    canonical = encoder.encode_texts(list(CANONICAL_PHRASES))
    scale = Scale(canonical, everyday_vectors(encoder), encoder.temperature)
    return Vocabulary(encoder.encode_texts(texts) if texts else canonical, scale)


def relevancy_error(made: Array, vectors: Array, vocabulary: Vocabulary) -> tuple[float, float]:
    """Return mean and 99 % quantile of the change of relevancy by (M, D) unit `made`; 0 where M = 0."""
    if not len(vectors):
        return 0.0, 0.0
    errors = np.empty((len(vectors), len(vocabulary.phrases)), np.float32)
    for part in pieces(len(vectors), 4_096):
        errors[part] = np.abs(vocabulary.relevancy(made[part]) - vocabulary.relevancy(vectors[part]))
    return float(errors.mean(dtype=np.float64)), float(np.quantile(errors, 0.99))


@dataclass(frozen=True)
class CodecReport:
    """Losses of a codec on vectors that it was not fitted to."""

    cosine: float  # mean, of a vector with what the codec makes of it
    error_mean: float  # of relevancy, see `relevancy_error`
    error_p99: float


def codec_report(codec: Codec, vectors: Array, vocabulary: Vocabulary) -> CodecReport:
    """Report on (M, D) float32 unit vectors."""
    made = codec.decode(codec.encode(vectors))
    cosine = float((made * vectors).sum(1).mean()) if len(vectors) else 1.0
    return CodecReport(cosine, *relevancy_error(made, vectors, vocabulary))


def fit_codec(
    vectors: Array,
    config: CodecConfig,
    vocabulary: Vocabulary,
    progress: Progress = silent,
    further: Array | None = None,
) -> Codec:
    """Fit a codec to (M, D) float32 unit CLIP vectors, so that phrases of the `vocabulary` find the same.

    Deterministic for a given seed on one machine. Raises InputError for settings out of range. further: (M',
    D) vectors that are not kept, but help a kind that interpolates between what it has seen.
    """
    check_settings(config, "--codec.")
    if further is not None and (codecs.KINDS[config.kind].blends or len(vectors) == 0):
        vectors = np.concatenate([further, vectors])
    if config.kind == "codebook":
        return fit_codebook(vectors, config, vocabulary, progress)
    if config.kind == "autoencoder":
        return train_autoencoder(vectors, config, progress)
    # The leading right singular vectors, the best basis by least squares; through the D x D Gram matrix: D is
    # 512, M may be a million. float64 keeps its squared condition usable.
    wide = np.asarray(vectors, np.float64)
    _, axes = np.linalg.eigh(wide.T @ wide)
    return codecs.LinearCodec(np.ascontiguousarray(axes[:, ::-1][:, : config.latent_dim].T, np.float32))


# The paper's codec: an autoencoder of one scene's CLIP vectors (LangSplat section 3.2, layers of its code).

ENCODER_WIDTHS = (256, 128, 64, 32)  # each with batch normalisation and ReLU
DECODER_WIDTHS = (16, 32, 64, 128, 256, 256)  # each with ReLU


def train_autoencoder(vectors: Array, config: CodecConfig, progress: Progress = silent) -> AutoencoderCodec:
    """Train the autoencoder of (M, D) unit vectors, with latents of length 1.

    By the paper's loss, L1 plus cosine distance, and Adam with a cosine schedule on random batches. Progress
    shows the batch's mean cosine. Deterministic for a given seed on one machine.
    """
    import torch  # seconds that other kinds need not pay
    from torch import nn

    torch.manual_seed(config.seed)
    data = torch.from_numpy(np.ascontiguousarray(vectors, np.float32))
    layers: list[nn.Module] = []
    for width, size in pairwise((data.shape[1], *ENCODER_WIDTHS)):
        layers += [nn.Linear(width, size), nn.BatchNorm1d(size), nn.ReLU()]
    encoder = nn.Sequential(*layers, nn.Linear(ENCODER_WIDTHS[-1], config.latent_dim))
    layers = []
    for width, size in pairwise((config.latent_dim, *DECODER_WIDTHS)):
        layers += [nn.Linear(width, size), nn.ReLU()]
    decoder = nn.Sequential(*layers, nn.Linear(DECODER_WIDTHS[-1], data.shape[1]))
    parameters = [*encoder.parameters(), *decoder.parameters()]
    optimiser = torch.optim.Adam(parameters, lr=config.lr, fused=True)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, config.steps)
    generator = torch.Generator().manual_seed(config.seed)
    with one_torch_thread():
        for step in range(config.steps):
            batch = data[torch.randint(len(data), (config.batch,), generator=generator)]
            latent = nn.functional.normalize(encoder(batch), dim=1, eps=1e-6)
            output = nn.functional.normalize(decoder(latent), dim=1, eps=1e-6)
            cosine = (output * batch).sum(1).mean()
            loss = nn.functional.l1_loss(output, batch) + (1 - cosine)
            optimiser.zero_grad(set_to_none=True)
            loss.backward()
            optimiser.step()
            schedule.step()
            if step % 50 == 0 or step + 1 == config.steps:
                progress("codec", (step + 1) / config.steps, cosine=cosine.item())
        _settle_statistics(encoder, data)
    return AutoencoderCodec(folded_layers(encoder), folded_layers(decoder))


def _settle_statistics(encoder: Any, data: Any) -> None:
    """Recompute batch statistics with final weights: running averages lag, most of few vectors' error."""
    import torch

    for module in encoder:
        if isinstance(module, torch.nn.BatchNorm1d):
            module.reset_running_stats()
            module.momentum = None  # cumulative average
    encoder.train()
    with torch.no_grad():
        for chunk in data.split(8_192):
            if len(chunk) > 1:
                encoder(chunk)


def folded_layers(network: Any) -> codecs.Layers:
    """Return (out, in) weights and biases of a torch `Sequential`, batch normalisations folded in."""
    return codecs.folded({name: t.double().numpy() for name, t in m.state_dict().items()} for m in network)


# A scene's own codebook: as many codewords as its language features need, and not more.


def fit_codebook(
    vectors: Array, config: CodecConfig, vocabulary: Vocabulary, progress: Progress = silent
) -> CodebookCodec:
    """Fit a codebook to (M, D) float32 unit vectors.

    It has `config.size` codewords, or, where that is 0, is the smallest that keeps the mean relevancy error
    on vectors it was not fitted to within `config.max_relevancy_error`. Codewords are float16 numbers, so
    that a file can hold them as such.
    """
    order = np.random.default_rng(config.seed).permutation(len(vectors))
    fitted = judged = vectors
    if len(vectors) > 20:
        judged, fitted = vectors[order[::5]], vectors[np.delete(order, np.s_[::5])]
    generator = np.random.default_rng(config.seed)

    def grow(size: int, start: Array | None) -> Array:
        doubled = 1 << (size - 1).bit_length()  # sizes between two powers of 2 come after the larger one
        progress("codebook", 0.1 + 0.6 * min(doubled / 2_048, 1), f"{size} codewords")
        return rounded(spherical_kmeans(fitted, size, 8 if start is None else 4, start, generator))

    def error(codewords: Array) -> float:
        made = codewords[nearest_centres(judged, codewords)[0]]
        return relevancy_error(made, judged, vocabulary)[0]

    if config.size:
        codewords = grow(config.size, None)
    else:
        # With fewer than four vectors per codeword, a codebook is a copy.
        most = max(min(len(fitted) // 4, 65_535), 1)
        codewords = _smallest(grow, error, most, config.max_relevancy_error)
    progress("colours of the codewords", 0.8)
    nearest = nearest_centres(fitted, codewords)[0]
    usage = np.bincount(nearest, minlength=len(codewords)).astype(np.float64)
    return codebook_of(codewords, usage)


def codebook_of(vectors: Array, usage: Array) -> CodebookCodec:
    """Return the codebook of (K, D) unit vectors, rounded to float16, that occur (K,) `usage` times."""
    codewords = rounded(vectors)
    return CodebookCodec(codewords, rounded(codecs.principal_colours(codewords, usage)))


def _smallest(
    grow: Callable[[int, Array | None], Array], error_of: Callable[[Array], float], most: int, budget: float
) -> Array:
    """Smallest codebook within `budget`: sizes are doubled, then the last interval is halved twice."""
    size, smaller = min(64, most), None
    while True:
        codewords = grow(size, smaller)
        error = error_of(codewords)
        if error <= budget or size == most or len(codewords) < size:
            break
        smaller, size = codewords, min(2 * size, most)
    if error > budget and size == most:
        log.warning("codebook: %d codewords still have a mean relevancy error of %.4f", len(codewords), error)
    if smaller is None or error > budget:
        return codewords
    low, high = len(smaller), len(codewords)
    for _ in range(2):
        middle = round((low * high) ** 0.5)
        tried = grow(middle, smaller)
        if error_of(tried) <= budget:
            codewords, high = tried, middle
        else:
            smaller, low = tried, middle
    return codewords


def rounded(numbers: Array) -> Array:
    """Return numbers rounded to float16, as float32."""
    return numbers.astype(np.float16).astype(np.float32)


# Spherical k-means: few unit vectors that many lie close to (Dhillon and Modha 2001). scikit-learn's knows
# neither the sphere nor a growing codebook.

CHUNK = 8_192  # vectors compared with all centres at a time
STEP = 8  # one in so many centres is added, or given up, at a time


def nearest_centres(vectors: Array, centres: Array, gains: bool = False) -> tuple[Array, Array, Array]:
    """Return the (M,) int64 nearest of (K, D) unit centres, and its (M,) float32 cosine with each vector.

    And if `gains` are asked for, (M,) float32, by how much less the cosine with the next is.
    """
    nearest, cosines = np.empty(len(vectors), np.int64), np.empty(len(vectors), np.float32)
    gain = np.zeros(len(vectors), np.float32)
    for part in pieces(len(vectors), CHUNK):
        products = vectors[part] @ centres.T
        nearest[part] = products.argmax(1)
        cosines[part] = np.take_along_axis(products, nearest[part, None], 1)[:, 0]
        if gains:
            np.put_along_axis(products, nearest[part, None], -1, 1)
            gain[part] = cosines[part] - products.max(1)
    return nearest, cosines, gain


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
        nearest, kept = _worth_keeping(vectors, centres, count + round(extra * max(1 - 2 * done / rounds, 0)))
        centres = _means(vectors, nearest, len(centres))[kept]
    while True:
        _, kept = _worth_keeping(vectors, centres, count)
        if kept.all():
            return centres
        centres = centres[kept]


def _worth_keeping(vectors: Array, centres: Array, size: int) -> tuple[Array, Array]:
    """Return (M,) nearest centre of each vector, and (K,) bool: those that serve some and are missed.

    Where there are more than `size`. Only one in `STEP` goes at a time, because of two that are alike neither
    is missed.
    """
    nearest, _, gain = nearest_centres(vectors, centres, gains=True)
    missed = np.bincount(nearest, gain, len(centres))  # by how much the sum of cosines would fall
    spare = min(max(len(missed) - size, 0), 1 + len(missed) // STEP)
    kept = np.bincount(nearest, minlength=len(centres)) > 0
    kept[np.argsort(missed, kind="stable")[:spare]] = False
    return nearest, kept


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


def _means(vectors: Array, nearest: Array, count: int) -> Array:
    """Return (K, D) float32 directions of the sums over each centre's vectors."""
    entries = np.ones(len(vectors), np.float32), (nearest, np.arange(len(vectors)))
    return unit(scipy.sparse.csr_matrix(entries, (count, len(vectors))) @ vectors)


# Colours of codewords by which neighbouring things are told apart.

FEWEST_LINKS = 10  # between the surfaces of two nodes that are neighbours
LEAST = 30  # Gaussians of a node that has a say


def contrasting_colours(field: LanguageField, tree: Tree, surface: Surface) -> Array | None:
    """Return (K, 3) float32 colours in [0, 1] of a codebook's words, the same for all levels and views.

    None where nothing lies beside anything else. The axes are those along which the mean vectors of
    neighbouring nodes, at all levels, differ the most. Along each, words are ranked, so that all of it is
    used: a node has as much say in that as another, however large it is.
    """
    vectors = field.codec.decode(np.arange(field.codec.size, dtype=np.uint16)[:, None]).astype(np.float64)
    ends = np.stack([surface.rows[end] for end in surface.ends])
    differences, weights = [np.zeros((0, vectors.shape[1]))], np.zeros(len(vectors))
    for level in range(len(field.latents)):
        codes, node = field.latents[level, :, 0], tree.at(level)
        counted = np.flatnonzero((node != NO_NODE) & field.known[level])
        names, number, sizes = np.unique(node[counted], return_inverse=True, return_counts=True)
        if len(names) == 0:
            continue
        has_say = sizes[number] >= LEAST
        weights += np.bincount(codes[counted][has_say], 1 / sizes[number][has_say], len(vectors))
        shape = (len(names), len(vectors))
        shares = scipy.sparse.csr_matrix((1 / sizes[number], (number, codes[counted])), shape=shape)
        place = np.full(int(node.max(initial=0)) + 1, -1)
        place[names] = np.arange(len(names))
        beside = np.sort(np.where(node[ends] == NO_NODE, -1, place[node[ends]]), axis=0)
        beside = beside[:, (beside[0] >= 0) & (beside[0] < beside[1])]
        pairs, links = np.unique(beside, axis=1, return_counts=True)
        first, second = pairs[:, (links >= FEWEST_LINKS) & (sizes[pairs] >= LEAST).all(0)]
        means = shares @ vectors
        differences.append(means[first] - means[second])
    found = np.concatenate(differences)
    if not found.any() or vectors.shape[1] < 3:
        return None
    values = vectors @ np.linalg.eigh(found.T @ found)[1][:, :-4:-1]
    ranks = np.empty(values.shape, np.float32)  # share of the weights that lies below each value
    for axis in range(3):
        order = np.argsort(values[:, axis], kind="stable")
        below = np.cumsum(weights[order])
        ranks[order, axis] = (below - weights[order] / 2) / max(below[-1], 1e-30)
    return ranks
