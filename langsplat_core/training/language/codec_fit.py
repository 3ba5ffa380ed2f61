"""Fitting codecs to the CLIP vectors of one scene, and what they cost: errors of the relevancy of phrases."""

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import pairwise
from types import MappingProxyType
from typing import Any

import numpy as np
import torch
from torch import nn

from langsplat_core.arrays import Array
from langsplat_core.config import AutoencoderConfig, CodebookConfig, CodecConfig, LinearConfig, check_settings
from langsplat_core.progress import Progress, silent
from langsplat_core.scene import CANONICAL_PHRASES, AutoencoderCodec, CodebookCodec, Codec, LinearCodec
from langsplat_core.scene.codec import KINDS, principal_colours
from langsplat_core.semantics.encoder import PhraseEncoder
from langsplat_core.semantics.relevancy import Scale, relevancy_of
from langsplat_core.semantics.vocabulary import everyday_phrases, everyday_vectors
from langsplat_core.training import one_torch_thread
from langsplat_core.training.language.kmeans import nearest_centres, spherical_kmeans

log = logging.getLogger("langsplat")


@dataclass(frozen=True, eq=False)
class Vocabulary:
    """The phrases that errors are measured with, and against which relevancy is read."""

    phrases: Array  # (Q, D) float32 unit text vectors
    scale: Scale

    def relevancy(self, vectors: Array) -> Array:
        """(M, D) unit vectors -> (M, Q) in [0, 1]."""
        zero, rate = self.scale.of(vectors @ self.scale.texts.T)
        return relevancy_of(vectors @ self.phrases.T, zero[:, None], rate[:, None])


def everyday_vocabulary(encoder: PhraseEncoder, phrases: tuple[str, ...] = ()) -> Vocabulary:
    """Return the vocabulary of `phrases` and everyday ones in the vectors of `encoder`."""
    texts = list(dict.fromkeys([*phrases, *everyday_phrases(encoder.unknown_words)]))
    canonical = encoder.encode_texts(list(CANONICAL_PHRASES))
    scale = Scale(canonical, everyday_vectors(encoder), encoder.temperature)
    return Vocabulary(encoder.encode_texts(texts) if texts else canonical, scale)


def relevancy_error(made: Array, vectors: Array, vocabulary: Vocabulary) -> tuple[float, float]:
    """Return the mean and the 99 % quantile of the change of relevancy, over vectors and phrases.

    With (M, D) `made` in place of (M, D) `vectors`, both float32 unit vectors; 0 where M = 0.
    """
    if not len(vectors):
        return 0.0, 0.0
    errors = np.empty((len(vectors), len(vocabulary.phrases)), np.float32)
    for start in range(0, len(vectors), 4_096):
        part = slice(start, start + 4_096)
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


# The paper's codec: an autoencoder of one scene's CLIP vectors.
#
# LangSplat section 3.2, with the layer widths of its public code (512-256-128-64-32-d with
# batch normalisation and ReLU, latent normalised to length 1; decoder d-16-32-64-128-256-256-512 with
# ReLU) and the paper's loss, L1 plus cosine distance.

ENCODER_WIDTHS = (256, 128, 64, 32)
DECODER_WIDTHS = (16, 32, 64, 128, 256, 256)


def train_autoencoder(
    vectors: Array, config: AutoencoderConfig, progress: Progress = silent
) -> AutoencoderCodec:
    """Train the autoencoder of (M, D) unit vectors: Adam with a cosine schedule on random batches.

    Progress shows the batch's mean cosine. Deterministic for a given seed on one machine.
    """
    torch.manual_seed(config.seed)
    data = torch.from_numpy(np.ascontiguousarray(vectors, np.float32))
    encoder, decoder = networks(data.shape[1], config.latent_dim)
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


def networks(dim: int, latent_dim: int) -> tuple[nn.Sequential, nn.Sequential]:
    """Return the encoder and the decoder, with random weights."""
    encoder: list[nn.Module] = []
    for width, size in pairwise((dim, *ENCODER_WIDTHS)):
        encoder += [nn.Linear(width, size), nn.BatchNorm1d(size), nn.ReLU()]
    encoder.append(nn.Linear(ENCODER_WIDTHS[-1], latent_dim))
    decoder: list[nn.Module] = []
    for width, size in pairwise((latent_dim, *DECODER_WIDTHS)):
        decoder += [nn.Linear(width, size), nn.ReLU()]
    decoder.append(nn.Linear(DECODER_WIDTHS[-1], dim))
    return nn.Sequential(*encoder), nn.Sequential(*decoder)


def _settle_statistics(encoder: nn.Sequential, data: torch.Tensor) -> None:
    """Recompute batch statistics over the data with final weights.

    Running averages lag behind them, and with few vectors that lag is most of the reconstruction error.
    """
    for module in encoder:
        if isinstance(module, nn.BatchNorm1d):
            module.reset_running_stats()
            module.momentum = None  # cumulative average
    encoder.train()
    with torch.no_grad():
        for chunk in data.split(8_192):
            if len(chunk) > 1:
                encoder(chunk)
    encoder.eval()


def folded_layers(network: nn.Sequential) -> tuple[tuple[Array, Array], ...]:
    """Weights as (out, in), bias pairs, with each batch normalisation folded into the layer before it."""
    layers: list[tuple[Array, Array]] = []
    for module in network:
        if isinstance(module, nn.Linear):
            weight, bias = module.weight.detach().double(), module.bias.detach().double()
            layers.append((weight.numpy(), bias.numpy()))
        elif isinstance(module, nn.BatchNorm1d):
            assert module.running_mean is not None
            assert module.running_var is not None
            scale = (module.weight / torch.sqrt(module.running_var + module.eps)).detach().double().numpy()
            shift = module.bias.detach().double().numpy() - module.running_mean.double().numpy() * scale
            last_weight, last_bias = layers[-1]
            layers[-1] = (last_weight * scale[:, None], last_bias * scale + shift)
    return tuple((w.astype(np.float32), b.astype(np.float32)) for w, b in layers)


# A scene's own codebook: as many codewords as its language features need, and not more.


def fit_codebook(
    vectors: Array, config: CodebookConfig, vocabulary: Vocabulary, progress: Progress = silent
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
        progress("codebook", 0.1 + 0.6 * min(size / 2_048, 1), f"{size} codewords")
        return rounded(spherical_kmeans(fitted, size, 8 if start is None else 4, start, generator))

    if config.size:
        codewords = grow(config.size, None)
    else:
        # With fewer than four vectors per codeword, a codebook is a copy.
        most = max(min(len(fitted) // 4, 65_535), 1)
        codewords = _smallest(grow, most, judged, config.max_relevancy_error, vocabulary)
    progress("colours of the codewords", 0.8)
    nearest, _ = nearest_centres(fitted, codewords)
    usage = np.bincount(nearest, minlength=len(codewords)).astype(np.float64)
    return codebook_of(codewords, usage)


def codebook_of(vectors: Array, usage: Array) -> CodebookCodec:
    """Return the codebook of (K, D) unit vectors, rounded to float16, that occur (K,) `usage` times."""
    codewords = rounded(vectors)
    return CodebookCodec(codewords, rounded(principal_colours(codewords, usage)))


def _smallest(
    grow: Callable[[int, Array | None], Array],
    most: int,
    judged: Array,
    budget: float,
    vocabulary: Vocabulary,
) -> Array:
    """Return the smallest codebook within `budget`.

    Sizes are doubled, then the last interval is halved twice.
    """
    size, smaller = min(64, most), None
    while True:
        codewords = grow(size, smaller)
        error = codebook_error(codewords, judged, vocabulary)
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
        if codebook_error(tried, judged, vocabulary) <= budget:
            codewords, high = tried, middle
        else:
            smaller, low = tried, middle
    return codewords


def codebook_error(codewords: Array, vectors: Array, vocabulary: Vocabulary) -> float:
    """Mean error of relevancy when every vector is replaced by its nearest codeword."""
    nearest, _ = nearest_centres(vectors, codewords)
    return relevancy_error(codewords[nearest], vectors, vocabulary)[0]


def rounded(numbers: Array) -> Array:
    """Numbers rounded to float16, as float32."""
    return numbers.astype(np.float16).astype(np.float32)


# Fitting a codec to the CLIP vectors of one scene.


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
    if further is not None and (KINDS[config.kind].blends or len(vectors) == 0):
        vectors = np.concatenate([further, vectors])
    return FITTERS[config.kind](vectors, config, vocabulary, progress)


def fit_linear(vectors: Array, config: LinearConfig) -> LinearCodec:
    """Fit the leading `config.latent_dim` right singular vectors.

    They are the best basis in the least-squares sense (Eckart-Young).
    """
    # Through the D x D Gram matrix: D is 512, M may be a million. float64 keeps its squared condition usable.
    wide = np.asarray(vectors, np.float64)
    _, axes = np.linalg.eigh(wide.T @ wide)
    return LinearCodec(np.ascontiguousarray(axes[:, ::-1][:, : config.latent_dim].T, np.float32))


def exact_codec(vectors: Array, usage: Array, config: CodecConfig) -> Codec | None:
    """Return the codec whose latents stand for just the (K, D) float32 unit vectors.

    They occur (K,) `usage` times. None for a kind that only comes near to them.
    """
    return EXACT[config.kind](vectors, usage) if config.kind in EXACT else None


# By the kind: the fit, and the codec of given vectors.
FITTERS: Mapping[str, Callable[[Array, Any, Vocabulary, Progress], Codec]] = MappingProxyType(
    {
        "codebook": fit_codebook,
        "autoencoder": lambda vectors, config, vocabulary, progress: train_autoencoder(
            vectors, config, progress
        ),
        "linear": lambda vectors, config, vocabulary, progress: fit_linear(vectors, config),
    }
)
EXACT: Mapping[str, Callable[[Array, Array], Codec]] = MappingProxyType({"codebook": codebook_of})
