"""The method, and the method with one stage swapped: its error budget, and the ways of lifting compared."""

from dataclasses import dataclass, replace
from typing import Literal

from langsplat_core.config import (
    AutoencoderConfig,
    CodebookConfig,
    CodecConfig,
    LevelChoice,
    LiftConfig,
    LinearConfig,
)
from langsplat_core.lab.config import BenchmarkConfig, LiftBenchConfig, MaskOrigin


@dataclass(frozen=True)
class Variant:
    """Which stages are the method's own, and which make no mistake."""

    name: str
    masks: MaskOrigin
    vectors: Literal["image", "text"] = "image"  # text: of every region's true words
    codec: CodecConfig = CodebookConfig()  # noqa: RUF009 (frozen)
    lift: LiftConfig = LiftConfig()  # noqa: RUF009
    query: Literal["blend answers", "paper"] = "blend answers"  # paper: blend latents, then decode
    level: LevelChoice = "auto"  # that is asked


def autoencoder(d: int = 3, steps: int = AutoencoderConfig.steps) -> AutoencoderConfig:
    """The paper's codec."""
    return AutoencoderConfig(latent_dim=d, steps=steps)


def ceiling(dim: int) -> CodecConfig:
    """A codec that loses nothing: all `dim` numbers."""
    return LinearConfig(latent_dim=dim)


def variants(config: BenchmarkConfig, dim: int) -> list[Variant]:
    """The method first; then the ceiling of codecs, or, with `config.budget`, one variant per stage, which
    differs in that stage alone. dim: numbers of the encoder's vectors."""
    method = Variant("the method", config.masks, codec=config.codec, lift=config.lift)
    if not config.budget:
        return [method, replace(method, name="no codec", codec=ceiling(dim))][: 1 + config.ceiling]
    perfect = [replace(method, name="perfect masks", masks="truth")] if config.masks != "truth" else []
    decoded = replace(method, name="autoencoder, d = 3", codec=autoencoder())
    return [
        method,
        *perfect,
        replace(method, name="perfect embeddings", vectors="text"),
        replace(method, name="no codec", codec=ceiling(dim)),
        decoded,
        replace(decoded, name="autoencoder, the paper's order", query="paper"),
    ]


def liftings(config: LiftBenchConfig, masks: MaskOrigin, dim: int) -> list[Variant]:
    """Every way from masks to meanings: the paper's, and those that lift CLIP vectors, then encode them."""
    latent, method = autoencoder(steps=config.codec_steps), Variant("", masks)
    trained = LiftConfig(mode="gradient", steps=config.gradient_steps)
    paper = replace(method, codec=latent, query="paper")
    made = [
        replace(paper, name="paper: Adam from zeros", lift=replace(trained, start="zeros-as-published")),
        replace(paper, name="paper: Adam from one-pass", lift=trained),
        replace(paper, name="paper's order, one-pass latents", lift=LiftConfig(mode="one-pass")),
        replace(paper, name="one-pass latents", lift=LiftConfig(mode="one-pass"), query="blend answers"),
        replace(method, name="mean, autoencoder d = 3", codec=latent, lift=LiftConfig(mode="mean")),
    ]
    made += [
        replace(method, name=f"median, autoencoder d = {d}", codec=replace(latent, latent_dim=d))
        for d in config.dims
    ]
    made += [
        replace(method, name=f"median, linear r = {rank}", codec=LinearConfig(latent_dim=rank))
        for rank in config.ranks
    ]
    made += [
        replace(method, name=f"median, codebook K = {size}", codec=CodebookConfig(size=size))
        for size in config.sizes
    ]
    chosen = replace(method, name="median, codebook by error budget")
    return [*made, chosen, replace(method, name=f"median, all {dim} numbers", codec=ceiling(dim))]
