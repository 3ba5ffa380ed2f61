"""Every setting a user can change, as frozen dataclasses; the command line is derived from them."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Literal


@dataclass(frozen=True)
class RasterSettings:
    """Constants of image formation; see `INRIA` and `GSPLAT` for the two named profiles.

    Sources: graphdeco-inria/diff-gaussian-rasterization and gsplat.
    """

    near: float = 0.2  # Gaussians with camera z <= near are not drawn, world units
    fov_clamp: float = 1.3  # Jacobian taken at most at this multiple of the half field of view
    dilation: float = 0.3  # added to both diagonal entries of the 2D covariance, px^2
    alpha_max: float = 0.99  # cap of one Gaussian's alpha
    alpha_min: float = 1 / 255  # smaller alphas are skipped
    transmittance_min: float = 1e-4  # stop when the next transmittance would be <= this, without adding
    antialiased: bool = False  # Mip-Splatting: opacity times sqrt(det before / det after dilation)


INRIA = RasterSettings()
GSPLAT = replace(INRIA, near=0.01)
RASTER_PROFILES = {"inria": INRIA, "gsplat": GSPLAT}


@dataclass(frozen=True)
class DatasetConfig:
    """How photographs are read."""

    max_side: int = 800  # photographs are shrunk until their longer side has at most this many pixels
    test_every: int = 8  # every n-th view, in name order, is held out from training; 0 holds out none
    metres_per_unit: float | None = None  # of the dataset's world; None: as transforms.json says, if it does


@dataclass(frozen=True)
class RadianceConfig:
    """3D Gaussian Splatting training (Kerbl et al. 2023); defaults are those of the INRIA code.

    Step counts below are for `reference_steps`; a smaller `steps` scales every schedule with it and lets
    geometry learn faster (see `training.radiance.schedule`).
    """

    steps: int = 30_000
    reference_steps: int = 30_000
    backend: Literal["auto", "cpu", "cuda"] = "auto"
    sh_degree: int = 3
    sh_degree_every: int = 1_000
    max_gaussians: int = 1_000_000
    lambda_dssim: float = 0.2
    position_lr_init: float = 1.6e-4  # times the cameras' extent
    position_lr_final: float = 1.6e-6
    feature_lr: float = 2.5e-3  # higher SH coefficients: a twentieth
    opacity_lr: float = 0.05
    scale_lr: float = 5e-3
    rotation_lr: float = 1e-3
    densify_from: int = 500
    densify_until: int = 15_000
    densify_every: int = 100
    densify_grad: float = 2e-4  # mean norm of the gradient by the 2D mean, in NDC
    percent_dense: float = 0.01  # of the extent: larger Gaussians split, smaller ones are cloned
    opacity_reset_every: int = 3_000
    prune_opacity: float = 5e-3
    coarse_fraction: float = 1 / 3  # of the steps, at the start, on pictures of half the size; INRIA: 0
    checkpoint_every: int = 2_000  # steps of this run
    seed: int = 0


@dataclass(frozen=True)
class MaskConfig:
    """Where masks come from and which are kept (paper section 3.1 and the method's public code)."""

    source: Literal["auto", "sam", "graph"] = "auto"  # auto: sam when `sam` names weights, else graph
    # hub id or folder of SAM, SAM 2 or SAM-HQ weights, e.g. facebook/sam-vit-huge
    sam: str = ""
    # layers of crops that SAM sees beside the whole picture, 2 x 2 in the first: 0 as the paper's text,
    # 1 as its code, which takes five times as long
    crop_layers: int = 0
    points_per_side: int = 32
    points_per_batch: int = 64
    predicted_iou: float = 0.7
    stability: float = 0.85
    stability_offset: float = 1.0
    box_nms: float = 0.7
    min_region: int = 100  # px
    nms_iou: float = 0.8
    nms_score: float = 0.7
    nms_inner: float = 0.5


@dataclass(frozen=True)
class ClipConfig:
    """The vision-language encoder: CLIP, SigLIP, SigLIP 2 or TIPS v2."""

    model: str = "laion/CLIP-ViT-B-16-laion2B-s34B-b88K"  # hub id, folder, or "demo" for the bundled one
    batch: int = 32
    device: Literal["auto", "cpu", "cuda"] = "auto"


@dataclass(frozen=True)
class CodecConfig:
    """How a Gaussian keeps a CLIP vector: by the number of a codeword, or as latents (paper section 3.2)."""

    kind: Literal["codebook", "autoencoder", "linear"] = "codebook"
    size: int = 0  # codewords of a codebook; 0: as many as `max_relevancy_error` asks for
    max_relevancy_error: float = 0.005  # mean over the scene's vectors and a few hundred phrases
    latent_dim: int = 3  # numbers that the other kinds keep
    steps: int = 4_000  # of the autoencoder's training, as are the following
    batch: int = 256
    lr: float = 3e-3  # 7e-4 in the public code: with as many steps a quarter more error
    seed: int = 0


@dataclass(frozen=True)
class LiftConfig:
    """How mask vectors reach the Gaussians."""

    # median, mean: of the CLIP vectors of the masks a Gaussian belongs to, then encoded;
    # one-pass: the paper's latents, averaged as W^T H / W^T 1; gradient: trained by Adam, as in the paper
    mode: Literal["median", "mean", "one-pass", "gradient"] = "median"
    chunk: int = 32  # mask channels per gather pass, where a backend cannot lift label maps at once
    backend: Literal["auto", "cpu", "cuda"] = "auto"
    steps: int = 30_000  # of mode gradient, as are the following
    lr: float = 2.5e-3
    start: Literal["one-pass", "zeros-as-published"] = "one-pass"
    seed: int = 0


@dataclass(frozen=True)
class TrainConfig:
    """The whole path from photographs to a scene with a language field."""

    dataset: DatasetConfig = field(default_factory=DatasetConfig)
    radiance: RadianceConfig = field(default_factory=RadianceConfig)
    masks: MaskConfig = field(default_factory=MaskConfig)
    clip: ClipConfig = field(default_factory=ClipConfig)
    codec: CodecConfig = field(default_factory=CodecConfig)
    lift: LiftConfig = field(default_factory=LiftConfig)
    phrases: tuple[str, ...] = ()  # stored encoded in the scene: they can be asked without any encoder


# The method as published (paper sections 3.1 to 3.3 and its public code): 2 x 2 crops beside the whole
# photograph, an autoencoder of 3 numbers, features trained through the rasterizer from zeros.
PAPER = TrainConfig(
    radiance=RadianceConfig(coarse_fraction=0.0),
    masks=MaskConfig(source="sam", sam="facebook/sam-vit-huge", crop_layers=1),
    codec=CodecConfig(kind="autoencoder", steps=10_000, batch=64, lr=7e-4),
    lift=LiftConfig(mode="gradient", start="zeros-as-published"),
)
TrainProfile = Literal["default", "paper"]
TRAIN_PROFILES: Mapping[TrainProfile, TrainConfig] = MappingProxyType(
    {"default": TrainConfig(), "paper": PAPER}
)


@dataclass(frozen=True)
class CompactConfig:
    """How small a scene may be made (`langsplat compact`)."""

    max_psnr_loss: float = 0.1  # dB, mean over the measuring views; nothing that loses more is written
    views: int = 96  # at most, of the scene's cameras or photographs; a sixth of them measures the loss
    max_side: int = 800  # pictures are drawn with at most this many pixels on their longer side
    # dB that the scene is assumed to have where no photographs are given: higher is more cautious
    assumed_psnr: float = 35.0
    phrases: tuple[str, ...] = ()  # asked before and after, beside those in the scene's phrasebook


Display = Literal["rgb", "latent", "relevancy", "segmentation", "depth", "alpha"]
LevelChoice = Literal["auto", "subpart", "part", "whole"]


@dataclass(frozen=True)
class PictureConfig:
    """How channels become a picture; the window's shader and the NumPy twin follow the same list."""

    display: Display = "rgb"
    heat_opacity: float = 0.85  # of the heat map over the colours where relevancy is high
    dim: float = 0.45  # colours are multiplied by this where a query finds nothing
    own_colours: bool = False  # heat in the colour of each query instead of the colour map
    threshold: float = 0.5  # share of a pixel's light from an answer's Gaussians from which it is segmented
    alpha_gate: float = 0.3  # pixels with less alpha carry no relevancy
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)  # display values in [0, 1]
