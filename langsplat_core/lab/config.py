"""Settings of the workshop, as frozen dataclasses; the command line is derived from them."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal, get_args

from langsplat_core.config import (
    CodebookConfig,
    CodecConfig,
    Count,
    CountOrZero,
    LiftConfig,
    Positive,
    Range,
    Rate,
    Seed,
)
from langsplat_core.query.answers import CutRule

Pixels = Annotated[int, Range(1, 65_536)]
Tier = Literal["separate", "clutter", "occlusion"]  # objects apart, cluttered, packed with look-alikes
TIERS: tuple[Tier, ...] = get_args(Tier)
# The outlines a perfect segmenter would find; the same, but 15 % of the vectors are another region's; the
# weight-free segmenter's; squares in place of masks.
MaskOrigin = Literal["truth", "wrong", "graph", "tiles"]
Latents = Annotated[int, Range(1, 512)]  # numbers per Gaussian
Codewords = Annotated[int, Range(1, 65_535)]
Channels = Annotated[int, Range(1, 4_096)]  # values per Gaussian
Views = Annotated[int, Range(8, 100_000)]  # photographs of a room, of which every eighth is held out
Size = tuple[Pixels, Pixels]  # width and height of a picture
Seeds = Annotated[tuple[Seed, ...], Range(0, 2**32 - 1, some=True)]
LabelLayout = Literal["plain", "lerf-ovs", "3d-ovs"]  # how a rendered room's truth is written


@dataclass(frozen=True)
class DemoEncoderConfig:
    """Training of the small CLIP that comes with the program (`langsplat demo encoder`)."""

    start: Path | None = None  # folder of an earlier demo encoder to begin from; None: random weights
    rooms: Count = 400  # random rooms that crops are rendered from
    views: Count = 3  # photographs of each room
    plain_crops: CountOrZero = 8_000  # crops of nothing but a colour or a texture
    steps: Count = 8_000  # of training
    batch: Count = 128  # crops per step
    phrases: Count = 192  # phrases per step
    lr: Rate = 1e-3  # largest learning rate
    seed: Seed = 0  # of random numbers


@dataclass(frozen=True)
class BenchmarkConfig:
    """Fresh rooms, and the method that is measured in them (`langsplat eval synthetic`)."""

    tiers: tuple[Tier, ...] = TIERS  # how crowded the rooms are
    seeds: Seeds = (101,)  # one room of every tier each; never that of the bundled scene
    views: Views = 48  # photographs of each room; every eighth is held out
    size: Size = (400, 300)  # width and height, pixels
    steps: Count = 1_500  # of radiance training
    max_gaussians: Count = 50_000  # of a room
    masks: MaskOrigin = "truth"  # where outlines come from
    encoder: str = "demo"
    """"demo" for the bundled one, a folder, a hub id, or clip-geometry:OWN[,ALIKE]: vectors made from truth
    with the geometry of CLIP, OWN being the cosine of a picture with its words (0.22 to 0.32)."""
    text_vectors: Path | None = None  # .npy of real text vectors for clip-geometry, names in a .txt beside it
    codec: CodecConfig = CodebookConfig()  # noqa: RUF009 (frozen)
    lift: LiftConfig = field(default_factory=LiftConfig)
    cut: CutRule | Literal["regions"] = "regions"
    """How an answer becomes a mask: whole regions, or a rule of `query.cut` for the map."""
    ceiling: bool = False  # also keep all of the encoder's numbers, by which a codec is judged
    budget: bool = False  # also swap one stage at a time for one that makes no mistake


@dataclass(frozen=True)
class LiftBenchConfig:
    """Ways from masks to meanings, compared in one room (`langsplat bench lift`)."""

    tier: Tier = "clutter"  # how crowded the rooms are
    seed: Seed = 101
    """Of the room; never that of the bundled scene."""
    masks: tuple[MaskOrigin, ...] = ("truth", "wrong", "graph")
    """Exact outlines, the same with every seventh vector another region's, the weight-free segmenter's."""
    dims: tuple[Latents, ...] = (1, 2, 3, 8)
    """Numbers per latent of the autoencoders."""
    ranks: tuple[Latents, ...] = (8, 64)
    """Numbers per latent of the linear codecs."""
    sizes: tuple[Codewords, ...] = (256, 1_024, 4_096)
    """Codewords of the codebooks."""
    codec_steps: Count = 4_000
    """Of the autoencoders' training."""
    gradient_steps: Count = 3_000
    """Of the paper's training; it takes 30 000."""
    only: tuple[str, ...] = ()
    """Rows whose name holds one of these texts; all of them if empty."""


@dataclass(frozen=True)
class PaperBenchConfig:
    """The paper's comparisons, on rooms with known truth (`langsplat bench paper`)."""

    tier: Tier = "clutter"  # how crowded the rooms are
    seeds: Seeds = (301, 302, 303, 304, 305)
    """Of the rooms; never that of the bundled scene, nor 201 to 203, on which the readings were tuned."""
    dims: tuple[Latents, ...] = (1, 2, 3, 8)
    """Numbers per latent of the autoencoders."""
    codec_steps: Count = 4_000
    """Of the autoencoders' training."""
    gradient_steps: Count = 3_000
    """Of the paper's training, from one-pass latents; from zeros it takes 30 000."""
    only: tuple[str, ...] = ()
    """Rows whose name holds one of these texts; all of them if empty."""


@dataclass(frozen=True)
class GainBenchConfig:
    """Changes of the lifting, and the rooms they are tried in (`langsplat bench gains`)."""

    tier: Tier = "clutter"  # how crowded the rooms are
    seeds: Seeds = (201, 202)
    """Of the rooms; never that of the bundled scene."""
    masks: tuple[MaskOrigin, ...] = ("truth", "wrong")
    """Exact outlines, the same with 15 % wrong vectors, the weight-free segmenter's."""
    size: Codewords = 1_024
    """Codewords, the same for all changes."""


@dataclass(frozen=True)
class VerdictBenchConfig:
    """Rooms in which present and absent things are asked for (`langsplat bench verdict`)."""

    tiers: tuple[Tier, ...] = ("clutter",)  # how crowded the rooms are
    seeds: Seeds = (301, 302, 303, 304, 305)
    """Of the rooms; never that of the bundled scene, nor 201 to 203, which calibrate the demo encoder."""
    masks: MaskOrigin = "truth"  # whose masks the fields are made of
    """Exact outlines, the same with 15 % wrong vectors, the weight-free segmenter's."""
    encoder: str = "demo"  # as of `langsplat eval synthetic`
    text_vectors: Path | None = None  # .npy of real text vectors for clip-geometry, names in a .txt beside it
    codec: CodecConfig = CodebookConfig()  # noqa: RUF009 (frozen)


@dataclass(frozen=True)
class WordBenchConfig:
    """Rooms whose things are named (`langsplat bench words`)."""

    tier: Tier = "clutter"  # how crowded the rooms are
    seeds: Seeds = (203,)
    """Of the rooms; never that of the bundled scene."""


@dataclass(frozen=True)
class PhraseBenchConfig:
    """Rooms in which phrases with structure are asked whole and composed (`langsplat bench phrases`)."""

    tier: Tier = "clutter"  # how crowded the rooms are
    seeds: Seeds = (203,)
    """Of the rooms; never that of the bundled scene, nor 201 and 202, on which composing was tuned."""


@dataclass(frozen=True)
class RasterBenchConfig:
    """What the rasterizer benchmark draws (`langsplat bench raster`)."""

    counts: tuple[Count, ...] = (10_000, 31_000, 100_000, 200_000, 1_000_000)
    """Sizes of the random scenes, drawn at the middle one of --sizes."""
    sizes: Annotated[tuple[Size, ...], Range(1, 65_536, some=True)] = ((320, 240), (640, 480), (960, 720))
    """Widths and heights of the picture, pixels; all are drawn with --pivot Gaussians."""
    pivot: Count = 200_000
    """Gaussians of the random scene that is drawn at every size."""
    channels: Annotated[tuple[Channels, ...], Range(1, 4_096, some=True)] = (3, 12)
    """Values per Gaussian."""
    scenes: tuple[Path, ...] = ()
    """Real scenes to measure beside the random ones, from their first camera, else one that frames them."""
    limit: Positive = 60.0
    """Seconds that a single call may be expected to take; what would take longer is named and left out."""
    cold: bool = False
    """Also measure the first call in fresh processes, without and with compiled kernels."""


@dataclass(frozen=True)
class KernelStepsConfig:
    """What the CPU kernels are measured on, whole and with one step taken out (`langsplat bench steps`)."""

    scene: Path | None = None
    """A scene to measure on; without one a random one."""
    count: Count = 200_000
    """Gaussians of the random scene."""
    size: Size = (640, 480)
    """Width and height of the picture, pixels."""
    channels: Channels = 12
    """Values per Gaussian."""


@dataclass(frozen=True)
class QueryBenchConfig:
    """How phrases are asked of one scene, every way (`langsplat bench query`)."""

    size: Size = (1440, 1080)
    """Width and height of the picture, pixels; that of the paper's figures."""
    count: CountOrZero = 0
    """Gaussians; the scene's are repeated, each beside itself, until there are so many. 0: as they are."""
    phrases: Count = 8
    """That errors are averaged and times taken over; the paper's order is timed with one."""
    together: Count = 100
    """Phrases that are asked at once, and one by one."""
    repeats: Count = 5
    """Of every timing of a view and a picture, of which the median is taken."""
    codec_steps: Count = 3_000
    """Of the training of the autoencoder that stands beside the codebook."""


@dataclass(frozen=True)
class MovingBenchConfig:
    """Pictures while the camera moves (`langsplat bench moving`)."""

    count: CountOrZero = 500_000
    """Gaussians; the scene's are repeated, each beside itself, until there are so many. 0: as they are."""
    size: Size = (1280, 800)
    """Width and height of the full picture, pixels."""
    views: Count = 12
    """Cameras of the scene, evenly chosen."""


@dataclass(frozen=True)
class EnduranceConfig:
    """What one process is put through (`langsplat bench endurance`)."""

    count: Count = 5_000_000
    """Gaussians; the scene's are repeated, each beside itself, until there are so many."""
    size: Size = (7680, 4320)
    """Width and height of the pictures, pixels."""
    pictures: Count = 8
    """That are drawn behind the first one."""
    phrases: Count = 1_000
    """That are asked, one after the other; none twice."""
