"""Fitting of codecs to the CLIP vectors of one scene, with their errors in the relevancy of phrases."""

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
    """The phrases and the scale with which errors of relevancy are measured."""

    phrases: Array  # (Q, D) float32 unit text vectors
    scale: Scale

    def relevancy(self, vectors: Array) -> Array:
        """Return (M, Q) relevancy in [0, 1] of (M, D) unit vectors."""
        zero, rate = self.scale.of(vectors @ self.scale.texts.T)
        return relevancy_of(vectors @ self.phrases.T, zero[:, None], rate[:, None])


def everyday_vocabulary(encoder: PhraseEncoder, phrases: tuple[str, ...] = ()) -> Vocabulary:
    """Return the vocabulary of `phrases` and everyday phrases, encoded by `encoder`."""
    texts = list(dict.fromkeys([*phrases, *everyday_phrases(encoder.unknown_words)]))
    canonical = encoder.encode_texts(list(CANONICAL_PHRASES))
    scale = Scale(canonical, everyday_vectors(encoder), encoder.temperature)
    return Vocabulary(encoder.encode_texts(texts) if texts else canonical, scale)


def relevancy_error(made: Array, vectors: Array, vocabulary: Vocabulary) -> tuple[float, float]:
    """Return mean and 99 % quantile of the absolute difference of relevancy of two (M, D); 0 if M = 0."""
    if not len(vectors):
        return 0.0, 0.0
    errors = np.empty((len(vectors), len(vocabulary.phrases)), np.float32)
    for part in pieces(len(vectors), 4_096):
        errors[part] = np.abs(vocabulary.relevancy(made[part]) - vocabulary.relevancy(vectors[part]))
    return float(errors.mean(dtype=np.float64)), float(np.quantile(errors, 0.99))


@dataclass(frozen=True)
class CodecReport:
    """Errors of a codec on vectors that it was not fitted to."""

    cosine: float  # mean, of a vector with its reconstruction
    error_mean: float  # of relevancy, see `relevancy_error`
    error_p99: float


def codec_report(codec: Codec, vectors: Array, vocabulary: Vocabulary) -> CodecReport:
    """Return the errors of a codec on (M, D) float32 unit vectors."""
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
    """Return a codec fitted to (M, D) float32 unit CLIP vectors, for the phrases of the `vocabulary`.

    Deterministic for a given seed on one machine. Raises InputError for settings out of range. further: (M',
    D) additional vectors for codecs that interpolate, or if there are no others.
    """
    check_settings(config, "--codec.")
    if further is not None and (codecs.KINDS[config.kind].blends or len(vectors) == 0):
        vectors = np.concatenate([further, vectors])
    if config.kind == "codebook":
        return fit_codebook(vectors, config, vocabulary, progress)
    if config.kind == "autoencoder":
        return train_autoencoder(vectors, config, progress)
    # The leading right singular vectors are the best basis by least squares. They are those of the D x D Gram
    # matrix, as D is 512 and M may be a million; float64 for its squared condition number.
    wide = np.asarray(vectors, np.float64)
    _, axes = np.linalg.eigh(wide.T @ wide)
    return codecs.LinearCodec(np.ascontiguousarray(axes[:, ::-1][:, : config.latent_dim].T, np.float32))


# The paper's codec: an autoencoder of one scene's CLIP vectors (LangSplat section 3.2, layers of its code).

ENCODER_WIDTHS = (256, 128, 64, 32)  # each with batch normalisation and ReLU
DECODER_WIDTHS = (16, 32, 64, 128, 256, 256)  # each with ReLU


def train_autoencoder(vectors: Array, config: CodecConfig, progress: Progress = silent) -> AutoencoderCodec:
    """Return an autoencoder trained on (M, D) unit vectors, with latents of length 1.

    The loss is the paper's, L1 plus cosine distance, minimised by Adam with a cosine schedule on random
    batches. Progress shows the batch's mean cosine. Deterministic for a given seed on one machine.
    """
    import torch  # takes seconds; other codecs do not need it
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
    optimiser = torch.optim.Adam([*encoder.parameters(), *decoder.parameters()], lr=config.lr, fused=True)
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
    """Recompute batch statistics with the final weights, since running averages lag."""
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
    """Return (out, in) weights and biases of a torch `Sequential` with folded batch normalisations."""
    return codecs.folded({name: t.double().numpy() for name, t in m.state_dict().items()} for m in network)


# A scene's own codebook, of as many codewords as its language features need.


def fit_codebook(
    vectors: Array, config: CodecConfig, vocabulary: Vocabulary, progress: Progress = silent
) -> CodebookCodec:
    """Return a codebook fitted to (M, D) float32 unit vectors.

    It has `config.size` codewords or, if that is 0, about the fewest whose mean relevancy error on vectors it
    was not fitted to is within `config.max_relevancy_error`. Codewords are rounded to float16, as in files.
    """
    order = np.random.default_rng(config.seed).permutation(len(vectors))
    fitted = judged = vectors
    if len(vectors) > 20:
        judged, fitted = vectors[order[::5]], vectors[np.delete(order, np.s_[::5])]
    generator = np.random.default_rng(config.seed)

    def grow(size: int, start: Array | None) -> Array:
        doubled = 1 << (size - 1).bit_length()  # sizes between powers of 2 are tried after the larger one
        progress("codebook", 0.1 + 0.6 * min(doubled / 2_048, 1), f"{size} codewords")
        return rounded(spherical_kmeans(fitted, size, 8 if start is None else 4, start, generator))

    def error(codewords: Array) -> float:
        return relevancy_error(codewords[nearest_centres(judged, codewords)[0]], judged, vocabulary)[0]

    if config.size:
        codewords = grow(config.size, None)
    else:
        # A codebook with fewer than four vectors per codeword would be a copy.
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
    """Return a small codebook within `budget`: the size is doubled, then the last interval bisected twice."""
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


# Spherical k-means (Dhillon and Modha 2001). scikit-learn's is not spherical and cannot grow a codebook.

CHUNK = 8_192  # vectors compared with all centres at a time
STEP = 8  # one in so many centres is added or removed at a time


def nearest_centres(vectors: Array, centres: Array, gains: bool = False) -> tuple[Array, Array, Array]:
    """Return the (M,) int64 nearest of (K, D) unit centres, and its (M,) float32 cosine with each vector.

    The third array has the (M,) float32 differences to the cosine with the next centre, or 0 without `gains`.
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

    Begins with `start` (K' <= count centres) and adds vectors that fit badly, drawn by their distance, and a
    quarter more of them than needed. The least useful ones are removed round by round, which splits clusters
    that share a centre in plain k-means. There are fewer than `count` if fewer vectors are distinct.
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
    """Return the (M,) nearest centre of each vector, and (K,) bool: the centres that are kept.

    Unused centres are not kept, nor, above `size`, the least useful ones, one in `STEP` at a time.
    """
    nearest, _, gain = nearest_centres(vectors, centres, gains=True)
    use = np.bincount(nearest, gain, len(centres))  # by how much the sum of cosines would fall without it
    spare = min(max(len(use) - size, 0), 1 + len(use) // STEP)
    kept = np.bincount(nearest, minlength=len(centres)) > 0
    kept[np.argsort(use, kind="stable")[:spare]] = False
    return nearest, kept


def _grown(vectors: Array, centres: Array, count: int, generator: np.random.Generator) -> Array:
    """Return `centres` with badly fitted vectors, added few at a time, so that one gap is filled once."""
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
    """Return up to `count` rows, drawn without repetition in proportion to (M,) distances, if not about 0."""
    weights = np.where(distance > 1e-5, distance, 0).astype(np.float64)
    possible = int((weights > 0).sum())
    if possible == 0:
        return np.zeros(0, np.int64)
    return generator.choice(len(weights), min(count, possible), replace=False, p=weights / weights.sum())


def _means(vectors: Array, nearest: Array, count: int) -> Array:
    """Return (K, D) float32 directions of the sums over each centre's vectors."""
    entries = np.ones(len(vectors), np.float32), (nearest, np.arange(len(vectors)))
    return unit(scipy.sparse.csr_matrix(entries, (count, len(vectors))) @ vectors)


# Colours of codewords that distinguish neighbouring instances.

FEWEST_LINKS = 10  # least links between two neighbouring nodes
LEAST = 30  # least Gaussians of a node that counts


def contrasting_colours(field: LanguageField, tree: Tree, surface: Surface) -> Array | None:
    """Return (K, 3) float32 colours in [0, 1] of codewords, for all levels; None without neighbouring nodes.

    The three axes are those along which the mean vectors of neighbouring nodes, at all levels, differ most. A
    colour is the rank of a codeword along each, weighted so that nodes of any size count equally.
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
        large = sizes[number] >= LEAST
        weights += np.bincount(codes[counted][large], 1 / sizes[number][large], len(vectors))
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
    ranks = np.empty(values.shape, np.float32)  # share of the weights below each value
    for axis in range(3):
        order = np.argsort(values[:, axis], kind="stable")
        below = np.cumsum(weights[order])
        ranks[order, axis] = (below - weights[order] / 2) / max(below[-1], 1e-30)
    return ranks
