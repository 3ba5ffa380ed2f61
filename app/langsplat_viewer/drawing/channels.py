"""Settings of looking that are neither the camera's nor the picture's: plain data, a part of the state."""

import math
from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Literal, get_args

import numpy as np

from langsplat_core.arrays import Array, check_array, logit
from langsplat_core.config import INRIA, Display, PictureConfig, RasterSettings
from langsplat_core.display.displays import DISPLAYS, MAX_QUERIES, Channels, Extra, HeatRanges
from langsplat_core.query.answers import QueryResult, Verdict
from langsplat_core.raster import Rasterizer, View
from langsplat_core.raster.render import splat_colours
from langsplat_core.scene import SH_COUNTS, Camera, Gaussians, Scene
from langsplat_core.semantics.relevancy import FLOOR

SplitMode = Literal["off", "wipe", "levels"]
AT_RANGE = (0.02, 0.98)  # of the area's width, where the line can be: it stays within reach


@dataclass(frozen=True)
class Split:
    """Several pictures of one camera in the scene's area.

    "wipe": the display that is chosen left of a line, `second` right of it. "levels": three columns, from
    subpart to whole, with the relevancy of the shown queries at each level where a display of answers is
    chosen, else with the latents.
    """

    mode: SplitMode = "off"
    second: Display = "depth"
    second_level: int = 2  # index into scene.LEVELS, where latents are shown
    at: float = 0.5  # where the line is, of the area's width


Overlay = Literal["things", "cameras", "cube", "grid"]
OVERLAYS: tuple[Overlay, ...] = get_args(Overlay)
Point = tuple[float, float, float]  # world units


@dataclass(frozen=True)
class Ruler:
    """A distance between two points on the surface."""

    measures: bool = False  # a click on the scene sets a point
    points: tuple[Point, ...] = ()  # at most two

    @property
    def length(self) -> float | None:
        """World units; None before there are two points."""
        return math.dist(*self.points) if len(self.points) > 1 else None

    def with_point(self, point: Point) -> "Ruler":
        """Set the second point, or the first of a new measurement."""
        return replace(self, points=(*self.points, point) if len(self.points) == 1 else (point,))


SIZE_RANGE = (0.1, 1.0)
MOST_DEGREE = 3


@dataclass(frozen=True)
class Splats:
    """How the Gaussians are drawn, for looking alone: answers and files have them as they are."""

    size: float = 1.0  # factor of every axis, within SIZE_RANGE: small ones are points, and show gaps
    sh_degree: int = MOST_DEGREE  # at most; 0: colours that do not depend on the direction


@dataclass(frozen=True)
class Clip:
    """Between which depths Gaussians are drawn, told by their centres; world units from the eye. For looking
    into things: answers and files have all of them."""

    near: float = 0.0
    far: float = math.inf

    def keeps(self, depths: Array) -> Array:
        """(N,) bool, of (N,) camera z."""
        kept: Array = (depths > self.near) & (depths <= self.far)
        return kept


UNCLIPPED = Clip()


@dataclass(frozen=True)
class Seeing:
    """How the scene is looked at."""

    split: Split = Split()
    ruler: Ruler = Ruler()
    splats: Splats = Splats()
    clip: Clip = UNCLIPPED
    transparent: bool = False  # pictures are saved without a background
    fade: float = 0.0  # how much of the photograph of a training camera lies over the picture, 0 to 1


# Image formation for looking round: what training would clip is shown, a picture of nothing explained.

NEAR_SHARE = 0.25  # of the depth of what is nearest in the picture
NEAREST_SHARE = 0.01  # of the Gaussians in the picture that count as the nearest
LEAST_NEAR = 1e-3  # of the depth of the middle one: nearer, a Gaussian would be a fog over everything
VISIBLE_ALPHA = 1 / 255
_SAMPLE = 20_000  # Gaussians looked at; quantiles need no more


def near_plane(gaussians: Gaussians, camera: Camera, most: float = INRIA.near) -> float:
    """Where the near plane lies for looking, world units: a share of the depth of what is nearest in the
    picture, so that one can go as near to a thing as it is small; at most `most`, the constant of training,
    so that the view of a photograph is the one that was trained. Without perspective, that of the eye."""
    if camera.orthographic:
        return 0.0
    rows = slice(None, None, max(len(gaussians) // _SAMPLE, 1))
    means = gaussians.means[rows].astype(np.float64)
    with np.errstate(invalid="ignore", over="ignore"):
        pixels, depths = camera.project(means)
        inside = (depths > 0) & (pixels >= 0).all(1) & (pixels < (camera.width, camera.height)).all(1)
        inside &= gaussians.opacity_logits[rows] > logit(np.array(VISIBLE_ALPHA))
    if not inside.any():
        return most
    nearest, middle = np.quantile(depths[inside], [NEAREST_SHARE, 0.5])
    return float(min(most, max(NEAR_SHARE * nearest, LEAST_NEAR * middle)))


def drawn_scene(scene: Scene, splats: Splats) -> Scene:
    """The scene with its Gaussians as `splats` wants them drawn; the scene itself where that changes nothing.
    The rows stay the same, so that layers fit both."""
    gaussians = scene.gaussians
    if splats.size != 1:
        scales = gaussians.log_scales + np.float32(np.log(splats.size))
        gaussians = replace(gaussians, log_scales=scales)
    if splats.sh_degree < gaussians.sh_degree:
        gaussians = replace(gaussians, sh=gaussians.sh[:, : SH_COUNTS[splats.sh_degree]])
    return scene if gaussians is scene.gaussians else replace(scene, gaussians=gaussians)


def looking_settings(scene: Scene, camera: Camera, clip: Clip = UNCLIPPED) -> RasterSettings:
    """The scene's own image formation, with the near plane of `near_plane`, and what `clip` cuts away."""
    settings = scene.raster_settings()
    near = near_plane(scene.gaussians, camera, settings.near)
    return replace(settings, near=max(near, clip.near), far=None if math.isinf(clip.far) else clip.far)


def why_undrawable(gaussians: Gaussians) -> str:
    """Why no camera could see anything of these; empty where one could."""
    count = len(gaussians)
    if count == 0:
        return "the scene holds no Gaussians"
    valid = gaussians.valid()
    if not valid.any():
        reasons = ", ".join(f"{rows:,} with {reason}" for reason, rows in gaussians.invalid_rows().items())
        return f"none of the {count:,} Gaussians can be drawn: {reasons}"
    if (gaussians.opacity_logits[valid] < logit(np.array(VISIBLE_ALPHA))).all():
        return f"all {int(valid.sum()):,} Gaussians are transparent"
    return ""


def why_nothing(gaussians: Gaussians, camera: Camera) -> str:
    """Why a picture that shows nothing does."""
    reason = why_undrawable(gaussians)
    if reason:
        return reason
    _, depths = camera.project(gaussians.means[gaussians.valid()].astype(np.float64))
    if (depths <= 0).all():
        return "the whole scene lies behind the camera"
    if (depths <= near_plane(gaussians, camera)).all():
        return "the whole scene lies nearer than the camera can see"
    return "nothing of the scene lies in this picture"


# What is seen: the one value by which everything rasterized is kept or made anew.


@dataclass(frozen=True, eq=False)
class Sight:
    """All that a projection of Gaussians depends on. Equal for the same scene, as an object, cut alike, and
    cameras that give the same picture."""

    scene: Scene  # as it is drawn
    camera: Camera
    clip: Clip = UNCLIPPED

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Sight) and self.scene is other.scene and self._place() == other._place()

    def __hash__(self) -> int:
        return hash((id(self.scene), self._place()))

    def _place(self) -> tuple[object, ...]:
        camera = self.camera
        return self.clip, camera.orthographic, camera.intrinsics, camera.world_to_camera.tobytes()

    def settings(self) -> RasterSettings:
        """The image formation for it."""
        return looking_settings(self.scene, self.camera, self.clip)


class LastView:
    """The view of the last sight, for as long as that is asked for."""

    def __init__(self, rasterizer: Rasterizer) -> None:
        self._rasterizer = rasterizer
        self._kept: tuple[Sight, View] | None = None

    def of(self, sight: Sight) -> View:
        """The Gaussians projected."""
        if self._kept is None or self._kept[0] != sight:
            view = self._rasterizer.view(sight.scene.gaussians, sight.camera, sight.settings())
            self._kept = sight, view
        return self._kept[1]

    def forget(self) -> None:
        """Project anew the next time."""
        self._kept = None


# What a picture shows of answers: the numbers per Gaussian and how hot they are. The window and pictures
# without one both ask here.
#
# A thing that is "not here" is not painted at all, a "weak match" half as strongly as what was found. A
# segmentation shows the members of an answer, which are whole regions; a heat map shows raw relevancy.

STRENGTH: Mapping[Verdict, float] = MappingProxyType({"found": 1.0, "weak match": 0.5, "not here": 0.0})
NO_HEAT = (FLOOR, 1.0)  # heat range of a slot that paints nothing, whose values are 0

Shown = Sequence[QueryResult | None]  # by slot; None where a slot has no answer


def painted(shown: Shown) -> list[int]:
    """Slots that paint anything."""
    return [slot for slot, result in enumerate(shown) if result is not None and STRENGTH[result.verdict] > 0]


def columns(shown: Shown, display: Display, count: int) -> Array | None:
    """(count, Q) float32 values per Gaussian and slot; a slot that paints nothing is zero. None where no slot
    paints anything."""
    slots = painted(shown)
    if not slots:
        return None
    values = np.zeros((count, len(shown)), np.float32)
    for slot in slots:
        result = shown[slot]
        assert result is not None
        of_members = display == "segmentation"
        values[:, slot] = result.members if of_members else result.relevancy[result.level]
    return values


def heat_ranges(shown: Shown, display: Display) -> HeatRanges:
    """Per slot, the values at which heat is 0 and 1. What is half as strong never gets hotter than a half."""
    slots = painted(shown)
    return tuple(
        NO_HEAT if result is None or slot not in slots else _range(result, display)
        for slot, result in enumerate(shown)
    )


def _range(result: QueryResult, display: Display) -> tuple[float, float]:
    low, high = (0.0, 1.0) if display == "segmentation" else result.heat_range
    return low, low + (high - low) / STRENGTH[result.verdict]


def fitted(picture: PictureConfig, shown: Shown) -> PictureConfig:
    """`picture`, with each query in its own colour as soon as two are painted."""
    return replace(picture, own_colours=len(painted(shown)) > 1)


# Which channels a picture needs, and those channels as arrays. No graphics device here.

_DEPTH_SAMPLE = 20_000  # Gaussians looked at for the depth range; quantiles need no more


@dataclass(frozen=True, eq=False)
class Channel:
    """What is rasterized beside colours and alpha for one picture."""

    extra: Extra = "none"
    values: Array | None = None  # (N, 1 to 3) per Gaussian; None for "none" and "depth"

    @property
    def key(self) -> tuple[Extra, int]:
        """Equal for the same channel, as long as one of the two is held."""
        return self.extra, id(self.values)


@dataclass(frozen=True, eq=False)
class Layers:
    """Values per Gaussian that a picture may show beside the scene's own colours."""

    latent_rgb: Array | None = None  # (N, 3) in [0, 1]
    relevancies: Array | None = None  # (N, Q) in [0, 1], Q from 1 to MAX_QUERIES

    def check(self, count: int) -> None:
        """ValueError where an array does not have `count` rows or the right number of columns."""
        if self.latent_rgb is not None:
            check_array("latent_rgb", self.latent_rgb, (count, 3))
        if self.relevancies is not None:
            queries = check_array("relevancies", self.relevancies, (count, "Q"))["Q"]
            if not 1 <= queries <= MAX_QUERIES:
                raise ValueError(
                    f"relevancies: 1 to {MAX_QUERIES} queries are shown at a time, got {queries}"
                )

    def extra(self, picture: PictureConfig) -> Extra:
        """The channel that `picture` needs beside colours and alpha, if it is there."""
        extra = DISPLAYS[picture.display].extra
        absent = extra in ("latent", "relevancies") and self.values(extra) is None
        return "none" if absent else extra

    def channel(self, picture: PictureConfig) -> Channel:
        """That channel with its values."""
        extra = self.extra(picture)
        return Channel(extra, self.values(extra))

    def values(self, extra: Extra) -> Array | None:
        """The layer that is rasterized as `extra`, if there is one."""
        return {"latent": self.latent_rgb, "relevancies": self.relevancies}.get(extra)


def depth_range(gaussians: Gaussians, camera: Camera, clip: Clip = UNCLIPPED) -> tuple[float, float]:
    """Near and far end of the depth display: the 2 % and 98 % quantiles of the camera z of those
    Gaussians whose centres are in the image and not cut away. World units; (0, 1) where there are none."""
    means = gaussians.means[:: max(len(gaussians) // _DEPTH_SAMPLE, 1)].astype(np.float64)
    with np.errstate(invalid="ignore", over="ignore"):
        pixels, depths = camera.project(means)
        inside = (pixels >= 0).all(1) & (pixels < (camera.width, camera.height)).all(1) & (depths > 0)
        inside &= clip.keeps(depths)
    if not inside.any():
        return 0.0, 1.0
    near, far = np.quantile(depths[inside], [0.02, 0.98])
    return float(near), float(far)


def camera_depths(gaussians: Gaussians, camera: Camera) -> Array:
    """(N, 1) float32 camera z, world units; finite."""
    with np.errstate(invalid="ignore", over="ignore"):
        depths = gaussians.means.astype(np.float64) @ camera.rotation[2] + camera.world_to_camera[2, 3]
        return np.nan_to_num(depths.astype(np.float32))[:, None]


class ArrayChannels:
    """Channels by a rasterizer that returns arrays; the projection is kept while the camera rests."""

    def __init__(self, rasterizer: Rasterizer) -> None:
        self.views = LastView(rasterizer)

    def apart(self) -> "ArrayChannels":
        """Other ones, with the same projection to begin with: for another thread."""
        made = copy(self)
        made.views = copy(self.views)
        return made

    def render(self, sight: Sight, layers: Layers, extra: Extra) -> Channels:
        """Colours, alpha and `extra`, in one pass."""
        return self.render_all(sight, [Channel(extra, layers.values(extra))])[0]

    def render_all(self, sight: Sight, wanted: Sequence[Channel]) -> list[Channels]:
        """For each of `wanted` the colours, alpha and that channel; all of them in one pass."""
        gaussians, camera = sight.scene.gaussians, sight.camera
        columns = [camera_depths(gaussians, camera) if c.extra == "depth" else c.values for c in wanted]
        present = [column for column in columns if column is not None]
        values = np.concatenate(present, 1) if len(present) > 1 else next(iter(present), None)
        drawn = splat_colours(self.views.of(sight), gaussians, camera, values)
        ends = np.cumsum([0 if column is None else column.shape[1] for column in columns])
        parts = np.split(drawn.values, ends[:-1], axis=2)
        return [
            Channels(
                rgb=drawn.colours,
                alpha=drawn.alpha,
                latent=part if channel.extra == "latent" else None,
                relevancies=part if channel.extra == "relevancies" else None,
                depth_sum=part[..., 0] if channel.extra == "depth" else None,
                depth_range=depth_range(gaussians, camera, sight.clip)
                if channel.extra == "depth"
                else (0.0, 1.0),
            )
            for channel, part in zip(wanted, parts, strict=True)
        ]

    def depth_at(self, sight: Sight, column: int, row: int) -> tuple[float, float]:
        """Depth of the surface in a pixel (the median where the rasterizer knows it, else the mean, as where
        the scene is transparent there), world units, 0 where there is nothing, and alpha."""
        view = self.views.of(sight)
        _, alpha = view.splat(np.empty((len(sight.scene.gaussians), 0), np.float32))
        median = view.median_depth()[row, column]
        return float(median or view.depth()[row, column]), float(alpha[row, column])
