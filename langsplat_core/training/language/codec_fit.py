"""Fitting a codec to the CLIP vectors of one scene."""

from collections.abc import Callable, Mapping
from types import MappingProxyType

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.config import CodecConfig
from langsplat_core.progress import Progress, silent
from langsplat_core.ranges import check_settings
from langsplat_core.scene import AutoencoderCodec, CodebookCodec, Codec, LinearCodec
from langsplat_core.training.language.autoencoder_fit import train_autoencoder
from langsplat_core.training.language.codebook_fit import fit_codebook
from langsplat_core.training.language.relevancy_error import Vocabulary


def fit_codec(
    vectors: Array, config: CodecConfig, vocabulary: Vocabulary, progress: Progress = silent
) -> Codec:
    """(M, D) float32 unit CLIP vectors -> a codec for them; what phrases of the `vocabulary` find is what it
    may not change. Deterministic for a given seed on one machine. InputError for settings out of range."""
    check_settings(config, "--codec.")
    return FITTERS[config.kind](vectors, config, vocabulary, progress)


def fit_autoencoder(
    vectors: Array, config: CodecConfig, vocabulary: Vocabulary, progress: Progress = silent
) -> AutoencoderCodec:
    """The paper's codec, see `autoencoder_fit`."""
    return train_autoencoder(
        vectors, config.latent_dim, config.steps, config.batch, config.lr, config.seed, progress
    )


def fit_linear(
    vectors: Array, config: CodecConfig, vocabulary: Vocabulary, progress: Progress = silent
) -> LinearCodec:
    """The leading right singular vectors, `config.latent_dim` of them: the best basis in the least-squares
    sense (Eckart-Young)."""
    # Through the D x D Gram matrix: D is 512, M may be a million. float64 keeps its squared condition usable.
    wide = np.asarray(vectors, np.float64)
    _, axes = np.linalg.eigh(wide.T @ wide)
    return LinearCodec(np.ascontiguousarray(axes[:, ::-1][:, : config.latent_dim].T, np.float32))


FITTERS: Mapping[str, Callable[[Array, CodecConfig, Vocabulary, Progress], Codec]] = MappingProxyType(
    {CodebookCodec.kind: fit_codebook, AutoencoderCodec.kind: fit_autoencoder, LinearCodec.kind: fit_linear}
)
