"""Every setting a user can change, as frozen dataclasses from which the command line is derived.

A number's range is part of its field's type, ``steps: Annotated[int, Range(1, 1_000_000)] = 100``, and bounds
each number of a field with several. `check_settings` refuses what lies outside, in all that one holds.
"""

import dataclasses
import typing
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from numbers import Integral, Real
from types import MappingProxyType
from typing import Annotated, Any, Literal, get_args, get_origin

import tyro

from langsplat_core.errors import InputError, printable_line


@dataclass(frozen=True)
class Range:
    """Range of a number; both ends count, but for `low` where `above` says so. Always finite."""

    low: float
    high: float
    above: bool = False  # low itself is no value
    some: bool = False  # of a field with several numbers: there must be at least one

    def holds(self, value: float) -> bool:
        """Return True where `value` lies in the range; NaN lies in none."""
        return (self.low < value if self.above else self.low <= value) and value <= self.high

    def __str__(self) -> str:
        low, high = _word(self.low), _word(self.high)
        return f"above {low} and at most {high}" if self.above else f"{low} to {high}"


def check_settings(settings: object, option: str = "--") -> None:
    """InputError for the first number out of its field's range; `option`: before names, as ``--codec.``."""
    if not dataclasses.is_dataclass(settings):
        raise InputError(f"expected settings such as TrainConfig(), got {type(settings).__name__}")
    for name, value, hint in named_values(settings, option):
        if problem := _problem(value, hint):
            shown = printable_line(" ".join(map(_word, _flat(value))), 40)
            raise InputError(f"{name} {shown}: {problem}")


def range_of(hint: Any) -> Range | None:
    """Return the range of the numbers in a field of this type."""
    return next((part for part in annotations(hint) if isinstance(part, Range)), None)


def named_values(settings: object, option: str = "--") -> Iterator[tuple[str, Any, Any]]:
    """(option as typed, value, type hint) of every field of a dataclass and of dataclasses in it."""
    hints = typing.get_type_hints(type(settings), include_extras=True)
    for entry in dataclasses.fields(settings):  # type: ignore[arg-type]  # checked by the callers' types
        value, hint = getattr(settings, entry.name), hints[entry.name]
        name = option + entry.name.replace("_", "-")
        if dataclasses.is_dataclass(value) and not isinstance(value, type):
            # of `tyro.conf.arg(name="")`, whose fields are options without its own name
            is_flat = any(getattr(part, "name", None) == "" for part in annotations(hint))
            yield from named_values(value, option if is_flat else f"{name}.")
        else:
            yield name, value, hint


def annotations(hint: Any) -> Iterator[Any]:
    """Yield what `Annotated` says beside types, in unions and tuples too, plain types and literal words."""
    if get_origin(hint) is Annotated:
        yield from hint.__metadata__
        hint = hint.__origin__
    for part in get_args(hint):
        yield from annotations(part)
    if not get_args(hint):
        yield hint


def _problem(value: Any, hint: Any) -> str | None:
    """Fault of the value of a field of this type; None where there is none."""
    said = list(annotations(hint))
    bound, whole = range_of(hint), float not in said
    numbers = [one for one in _flat(value) if one not in said]
    if bound is None:
        return None
    if bound.some and not numbers:
        return "give at least one number"
    kind: Any = Integral if whole else Real
    if any(isinstance(number, bool) or not isinstance(number, kind) for number in numbers):
        return f"must be {'a whole number' if whole else 'a number'}, {bound}"
    return None if all(map(bound.holds, numbers)) else f"must be {bound}"


def _flat(value: Any) -> Iterator[Any]:
    if isinstance(value, tuple | list):
        for part in value:
            yield from _flat(part)
    elif value is not None:
        yield value


def _word(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)


# Every field with numbers names one of these, or a range of its own.
Count = Annotated[int, Range(1, 1_000_000_000)]
SeveralCount = Annotated[int, Range(2, 1_000_000_000)]
FrameCount = Annotated[int, Range(3, 100_000)]
CountOrZero = Annotated[int, Range(0, 1_000_000_000)]
Seed = Annotated[int, Range(0, 2**32 - 1)]
Side = Annotated[int, Range(16, 65_536)]  # pixels of an image's longer side
Share = Annotated[float, Range(0.0, 1.0)]
Rate = Annotated[float, Range(0.0, 10.0, above=True)]  # a learning rate
NotNegative = Annotated[float, Range(0.0, 1e9)]
Decibels = Annotated[float, Range(0.0, 200.0)]
Positive = Annotated[float, Range(0.0, 1e9, above=True)]
Coordinate = Annotated[float, Range(-1e12, 1e12)]
Degrees = Annotated[float, Range(-360.0, 360.0)]
Device = Literal["auto", "cpu", "cuda"]


@dataclass(frozen=True)
class RasterSettings:
    """Constants of image formation, of INRIA's diff-gaussian-rasterization (`INRIA`) and of `GSPLAT`."""

    # Gaussians with camera z <= near are not drawn, world units; but for published code it follows from the
    # scene, see `scene.near_plane`
    near: Positive = 0.2
    far: Positive | None = None  # nor those with camera z > far; None: none is too far
    fov_clamp: Positive = 1.3  # Jacobian taken at most at this multiple of the half field of view
    dilation: NotNegative = 0.3  # added to both diagonal entries of the 2D covariance, px^2
    # px, of the photographs that the Gaussians were fitted to: a longer one dilates more, a shorter one less,
    # see `raster.protocol.dilation`; None: all alike
    focal: Positive | None = None
    alpha_max: Share = 0.99  # cap of one Gaussian's alpha
    alpha_min: Share = 1 / 255  # smaller alphas are skipped
    transmittance_min: Share = 1e-4  # stop when the next transmittance would be <= this, without adding
    antialiased: bool = False  # Mip-Splatting: opacity times sqrt(det before / det after dilation)


INRIA = RasterSettings()
GSPLAT = replace(INRIA, near=0.01)


@dataclass(frozen=True)
class DatasetConfig:
    """Settings for reading photographs and their cameras."""

    max_side: Side = 800  # pixels of a photograph's longer side: larger ones are shrunk
    test_every: CountOrZero = 8  # one view in so many is held out from training; 0: none is
    # which views are held out: chosen, those that others surround (none of fewer than six), or every n-th
    hold_out: Literal["chosen", "every"] = "chosen"
    frames: FrameCount = 100  # parts of a video, of each of which the sharpest image is a photograph
    # transparent pixels: mask, which do not count; background, which are empty; auto: as a capture looks
    alpha: Annotated[Literal["auto", "mask", "background"], tyro.conf.arg(aliases=["--alpha"])] = "auto"
    metres_per_unit: Positive | None = None  # scale of the dataset; by default of transforms.json, else GPS
    # go on where fewer than half of the photographs, or fewer than three, have a camera
    allow_few_cameras: bool = False


@dataclass(frozen=True)
class RadianceConfig:
    """3D Gaussian Splatting training (Kerbl et al. 2023); defaults are those of the INRIA code.

    Step counts below are for `reference_steps`; a smaller `steps` scales every schedule with it and lets
    geometry learn faster (see `training.radiance.trainer`).
    """

    steps: Count = 30_000  # number of training steps
    reference_steps: Count = 30_000  # number of steps for which the step numbers of other options are meant
    backend: Device = "auto"  # device that rasterizes
    sh_degree: Annotated[int, Range(0, 3)] = 3  # highest degree of the spherical harmonics, 0 to 3
    sh_degree_every: Count = 1_000  # steps after which the degree of the harmonics grows by one
    max_gaussians: Count = 1_000_000  # largest number of Gaussians
    lambda_dssim: Share = 0.2  # share of 1 - SSIM in the loss; the rest is L1
    # weight of the mean opacity in the loss: what no photograph needs fades (INRIA: 0; Kheradmand 2024: 0.01)
    opacity_decay: NotNegative = 0.0
    position_lr_init: Rate = 1.6e-4  # learning rate of positions at the first step, in extents of the cameras
    position_lr_final: Rate = 1.6e-6  # learning rate of positions at the last step, in extents of the cameras
    feature_lr: Rate = 2.5e-3  # learning rate of colours; of higher SH coefficients a twentieth
    opacity_lr: Rate = 0.05  # learning rate of opacity logits
    scale_lr: Rate = 5e-3  # learning rate of logarithms of scales
    rotation_lr: Rate = 1e-3  # learning rate of rotation quaternions
    densify_from: CountOrZero = 500  # first step at which Gaussians are split, cloned and pruned
    densify_until: CountOrZero = 15_000  # last step at which Gaussians are split, cloned and pruned
    densify_every: Count = 100  # steps between two rounds of splitting, cloning and pruning
    densify_grad: NotNegative = 2e-4  # least mean gradient by the 2D mean, in NDC, that densifies a Gaussian
    percent_dense: Share = 0.01  # size, in extents of the cameras, above which Gaussians split; others clone
    opacity_reset_every: CountOrZero = 3_000  # steps between two resets of opacities to at most 0.01; 0: none
    prune_opacity: Share = 5e-3  # opacity below which a Gaussian is removed
    coarse_fraction: Share = 1 / 3  # share of the steps, the first, on images of half the size; INRIA: 0
    # most training views with which Gaussians begin at depths by stereo and leave the space before surfaces,
    # and opacities decay and are not reset; 0 (as published): none
    few_views: CountOrZero = 50
    # most training views with which training is capped, at 64 steps of each, 60 000 Gaussians and degree 1:
    # more lose on views held out; 0: none
    capped_views: CountOrZero = 24
    ensemble: Annotated[int, Range(0, 16)] = 0  # trainings to merge; 0: two with capped views, else one
    # each photograph has an exposure and white balance of its own; auto: where that explains enough
    exposure: Literal["auto", "on", "off"] = "auto"
    # what moves in a photograph, such as people, does not count; auto: where it explains enough of the error
    transients: Literal["auto", "on", "off"] = "auto"
    checkpoint_every: Count = 2_000  # steps between two checkpoints of a training
    near: Positive | None = None  # depth up to which nothing is drawn, units; by default from what is seen
    seed: Seed = 0  # seed of the training's random numbers

    def formation(self, near: float) -> RasterSettings:
        """Return the constants of image formation; `near`: the plane that follows from what is seen."""
        return replace(INRIA, near=self.near or near)


@dataclass(frozen=True)
class MaskConfig:
    """Source of masks, and which are kept (paper section 3.1 and the method's public code)."""

    source: str = "auto"  # sam, graph or an extension's; auto: sam when `sam` names weights, else graph
    sam: str = ""  # hub id, folder or file of SAM, SAM 2 or SAM 3 weights, e.g. facebook/sam-vit-huge
    # layers of crops that SAM sees, too, 2 x 2 in the first; 0: as the paper's text; 1: its code, 5 x slower
    crop_layers: Annotated[int, Range(0, 4)] = 0
    points_per_side: Annotated[int, Range(1, 1_024)] = 32  # points on a side of the grid that SAM is asked at
    points_per_batch: Count = 64  # points that SAM is asked at together
    predicted_iou: Share = 0.7  # least quality, as SAM says it, of a mask that is kept
    stability: Share = 0.85  # least stability of a mask that is kept
    stability_offset: NotNegative = 1.0  # logits between the two cuts whose overlap is a mask's stability
    box_nms: Share = 0.7  # overlap of two masks' boxes from which the worse mask goes
    min_region: CountOrZero = 100  # pixels of the smallest region, or hole, that a mask keeps
    nms_iou: Share = 0.8  # overlap of two masks of a level from which the worse one goes
    nms_score: Share = 0.7  # least score of a mask that stays when overlapping ones have gone
    nms_inner: Share = 0.5  # how far, from 0 to 1, a mask may lie inside another of its level


@dataclass(frozen=True)
class ClipConfig:
    """The vision-language encoder: CLIP, SigLIP, MetaCLIP 2 or TIPS v2."""

    model: str = "laion/CLIP-ViT-B-16-laion2B-s34B-b88K"  # hub id, folder, or "demo" for the bundled one
    batch: Count = 32  # images that the encoder sees together
    device: Device = "auto"  # device that the encoder runs on


CodecKind = Literal["codebook", "autoencoder", "linear"]


@dataclass(frozen=True)
class CodecConfig:
    """Settings of the codec, by which a Gaussian keeps a CLIP vector; each kind has some of its own."""

    # what is kept: a codeword's number, latents of the paper's autoencoder, or coordinates in a linear basis
    kind: CodecKind = "codebook"
    size: Annotated[int, Range(0, 65_535)] = 0  # codewords of a codebook; 0: by --max-relevancy-error
    # largest error of a codebook: the mean over the scene's vectors and a few hundred phrases
    max_relevancy_error: Annotated[Share, tyro.conf.arg(aliases=["--max-relevancy-error"])] = 0.006
    latent_dim: Annotated[int, Range(1, 4_096)] = 3  # numbers kept by an autoencoder or a linear basis
    steps: Count = 4_000  # number of training steps of an autoencoder
    batch: SeveralCount = 256  # vectors in a training step of an autoencoder
    lr: Rate = 3e-3  # learning rate of an autoencoder; 7e-4, as published, leaves a quarter more error
    seed: Seed = 0  # seed of the codec's random numbers

    @property
    def own(self) -> dict[str, Any]:
        """The settings that its kind has, see `CODEC_SETTINGS`."""
        return {name: getattr(self, name) for name in ("kind", "seed", *CODEC_SETTINGS[self.kind])}


CODEC_SETTINGS: Mapping[CodecKind, tuple[str, ...]] = MappingProxyType({
    "codebook": ("size", "max_relevancy_error"),
    "autoencoder": ("latent_dim", "steps", "batch", "lr"),
    "linear": ("latent_dim",),
})  # fmt: skip


@dataclass(frozen=True)
class LiftConfig:
    """Settings for lifting mask vectors onto the Gaussians."""

    # median, mean: of the CLIP vectors of the masks a Gaussian belongs to, then encoded;
    # one-pass: the paper's latents, averaged as W^T H / W^T 1; gradient: trained by Adam, as in the paper
    mode: Literal["median", "mean", "one-pass", "gradient"] = "median"
    backend: Device = "auto"  # device that lifts; auto: cpu, which is faster but for mode gradient
    steps: Count = 30_000  # number of training steps of mode gradient
    lr: Rate = 2.5e-3  # learning rate of mode gradient
    start: Literal["one-pass", "zeros-as-published"] = "one-pass"  # features that mode gradient starts from
    seed: Seed = 0  # seed of mode gradient's random numbers


@dataclass(frozen=True)
class TrainConfig:
    """The whole path from photographs to a scene with a language field."""

    dataset: DatasetConfig = field(default_factory=DatasetConfig)
    radiance: RadianceConfig = field(default_factory=RadianceConfig)
    masks: MaskConfig = field(default_factory=MaskConfig)
    clip: ClipConfig = field(default_factory=ClipConfig)
    codec: CodecConfig = field(default_factory=CodecConfig)
    lift: LiftConfig = field(default_factory=LiftConfig)
    phrases: tuple[str, ...] = ()  # phrases stored encoded in the scene, to be asked without any encoder


# The method as published (paper sections 3.1 to 3.3 and its public code): 2 x 2 crops beside the whole
# photograph, an autoencoder of 3 numbers, features trained through the rasterizer from zeros.
PAPER = TrainConfig(
    dataset=DatasetConfig(hold_out="every"),
    radiance=RadianceConfig(
        coarse_fraction=0.0, few_views=0, capped_views=0, exposure="off", transients="off", near=INRIA.near
    ),
    masks=MaskConfig(source="sam", sam="facebook/sam-vit-huge", crop_layers=1),
    codec=CodecConfig("autoencoder", steps=10_000, batch=64, lr=7e-4),
    lift=LiftConfig(mode="gradient", start="zeros-as-published"),
)
TrainProfile = Literal["default", "paper"]
TrainPreset = Literal["quick", "good", "full"]
Until = Literal["gaussians", "language field"]  # the last stage of a training
# Settings of the presets, see docs/photographs.md; by the decay few photographs gain a third of a decibel.
QUICK_SIDE, GOOD_SIDE = 320, 480  # px, the photographs' longer side
QUICK: dict[str, Any] = {"steps": 500, "max_gaussians": 30_000, "sh_degree": 1, "opacity_decay": 0.01}
GOOD: dict[str, Any] = {"steps": 1_500, "max_gaussians": 60_000, "sh_degree": 1, "opacity_decay": 0.01}


def with_preset(config: TrainConfig, preset: TrainPreset) -> TrainConfig:
    """Return `config` with a preset's budget: "quick" takes minutes on a CPU, "full" is the published one."""
    if preset == "full":
        return config
    budget, side, codewords = (QUICK, QUICK_SIDE, 512) if preset == "quick" else (GOOD, GOOD_SIDE, 0)
    return replace(
        config,
        dataset=replace(config.dataset, max_side=side),
        radiance=replace(config.radiance, **budget),
        codec=replace(config.codec, size=codewords) if config.codec.kind == "codebook" else config.codec,
    )


Display = Literal["rgb", "latent", "tree", "relevancy", "segmentation", "depth", "alpha"]
ColourMap = Literal["inferno", "viridis", "turbo", "amber", "cividis", "magma", "grey"]
HeatOf = Literal["smooth", "own", "node", "everywhere"]
Level = Literal["subpart", "part", "whole"]
LevelChoice = Literal["auto", Level]


@dataclass(frozen=True)
class PictureConfig:
    """Settings for composing an image of channels, on a graphics device and on the CPU alike."""

    display: Display = "rgb"
    # of an answer: each Gaussian's own relevancy, the same smoothed, or the mean of its node in the tree;
    # or its own, in the answer or not
    heat: HeatOf = "smooth"
    heat_opacity: Share = 0.85  # of the heat map over the colours
    colour_map: ColourMap = "inferno"  # of relevancy and depth; all but turbo suit the colour-blind
    dim: Share = 0.7  # colours are multiplied by this where a query finds nothing
    own_colours: bool = False  # heat in the colour of each query instead of the colour map
    threshold: Share = 0.5  # of a pixel's light from an answer's Gaussians from which it is segmented
    alpha_gate: Share = 0.3  # pixels with less alpha carry no relevancy
    # relevancies that are coldest and hottest; None: each answer's
    heat_scale: tuple[Share, Share] | None = None
    background: tuple[Share, Share, Share] = (0.0, 0.0, 0.0)  # display values in [0, 1]
    transparent: bool = False  # no background: the image has a fourth channel, the scene's alpha
