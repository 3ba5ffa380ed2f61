"""The render request: everything that an image of the scene depends on, as one value.

The canvas of the window, saved images, films, comparisons and `--headless` each fill one in; a renderer
(`rendering.renderer`) draws it. An image may have several panes: displays of one camera side by side.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

from langsplat_core.arrays import Array, logit
from langsplat_core.config import INRIA, Display, PictureConfig, RasterSettings
from langsplat_core.display.displays import DISPLAYS, Answers, DisplayRow, Ranges, Subject, painted
from langsplat_core.scene import LEVELS, SH_COUNTS, Camera, Gaussians, Scene
from langsplat_core.scene.gaussians import Merged
from langsplat_core.scene.transform import C0
from langsplat_viewer.marks import Marks

# Depths of an image: clipping, near plane, the range of the depth display, and why nothing is seen.


@dataclass(frozen=True)
class Clip:
    """Range of depths in which Gaussians are drawn, by their centres; world units from the eye. Answers and
    files have all of them."""

    near: float = 0.0
    far: float = math.inf

    def keeps(self, depths: Array) -> Array:
        kept: Array = (depths > self.near) & (depths <= self.far)
        return kept


UNCLIPPED = Clip()


# Image formation for looking round: what training would clip is shown, an image of nothing explained.

NEAR_SHARE = 0.25  # of the depth of what is nearest in the image
NEAREST_SHARE = 0.01  # of the Gaussians in the image that count as the nearest
LEAST_NEAR = 1e-3  # of the depth of the middle one: nearer, a Gaussian would be a fog over everything
VISIBLE_ALPHA = 1 / 255
_SAMPLE = 20_000  # Gaussians looked at; quantiles need no more


def _in_image(gaussians: Gaussians, camera: Camera) -> tuple[slice, Array, Array]:
    """A sample of the Gaussians: their rows, the (M,) camera z of their centres, world units, and (M,) bool,
    those whose centres are in the image."""
    rows = slice(None, None, max(len(gaussians) // _SAMPLE, 1))
    with np.errstate(invalid="ignore", over="ignore"):
        pixels, depths = camera.project(gaussians.means[rows].astype(np.float64))
    return rows, depths, camera.in_image(pixels, depths)


def near_plane(gaussians: Gaussians, camera: Camera, most: float = INRIA.near) -> float:
    """World units from the camera to the near plane: a share of the depth of what is nearest in the
    image, so that one can go as near to a thing as it is small; at most `most`, the constant of training,
    so that the view of a photograph is the one that was trained. Without perspective, that of the eye."""
    if camera.orthographic:
        return 0.0
    rows, depths, inside = _in_image(gaussians, camera)
    with np.errstate(invalid="ignore"):
        inside &= gaussians.opacity_logits[rows] > logit(np.array(VISIBLE_ALPHA))
    if not inside.any():
        return most
    nearest, middle = np.quantile(depths[inside], [NEAREST_SHARE, 0.5])
    return float(min(most, max(NEAR_SHARE * nearest, LEAST_NEAR * middle)))


def image_formation(scene: Scene, camera: Camera, clip: Clip = UNCLIPPED) -> RasterSettings:
    """The scene's own image formation, with the near plane of `near_plane`, and what `clip` cuts away."""
    settings = scene.raster_settings()
    near = near_plane(scene.gaussians, camera, settings.near)
    return replace(settings, near=max(near, clip.near), far=None if math.isinf(clip.far) else clip.far)


def depth_range(gaussians: Gaussians, camera: Camera, clip: Clip = UNCLIPPED) -> tuple[float, float]:
    """Near and far end of the depth display: the 2 % and 98 % quantiles of the camera z of those
    Gaussians whose centres are in the image and not cut away. World units; (0, 1) where there are none."""
    _, depths, inside = _in_image(gaussians, camera)
    with np.errstate(invalid="ignore"):
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


def why_undrawable(gaussians: Gaussians) -> str:
    """Return why no camera could see anything of these; empty where one could."""
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
    reason = why_undrawable(gaussians)
    if reason:
        return reason
    _, depths = camera.project(gaussians.means[gaussians.valid()].astype(np.float64))
    if (depths <= 0).all():
        return "the whole scene lies behind the camera"
    if (depths <= near_plane(gaussians, camera)).all():
        return "the whole scene lies nearer than the camera can see"
    return "nothing of the scene lies in this picture"


# Parts of a request.

SplitMode = Literal["off", "wipe", "levels", "scenes"]
AT_RANGE = (0.02, 0.98)  # of the area's width, where the line can be: it stays within reach
SIZE_RANGE = (0.1, 1.0)
MOST_DEGREE = 3


@dataclass(frozen=True)
class Split:
    """Several panes of one camera in an image.

    "wipe": the display that is chosen left of a line, `second` right of it. "levels": three columns, from
    subpart to whole, with the relevancy of the shown queries at each level where a display of answers is
    chosen, else with the latents. "scenes": one pane, and another scene right of the line, whose image is
    not this request's.
    """

    mode: SplitMode = "off"
    second: Display = "depth"
    second_level: int = 2  # index into scene.LEVELS, where latents are shown
    at: float = 0.5  # where the line is, of the area's width

    @property
    def columns(self) -> int:
        """Columns that the image is divided into; the two panes of a wipe lie over each other."""
        return len(LEVELS) if self.mode == "levels" else 1

    def pane_size(self, size: tuple[int, int]) -> tuple[int, int]:
        """Pixels of each pane of an image of `size` (width, height)."""
        return max(size[0] // self.columns, 1), size[1]

    def within_pane(self, u: float) -> float:
        """A fraction of the image's width -> the fraction of the width of the pane there."""
        return u * self.columns - min(max(int(u * self.columns), 0), self.columns - 1)

    def joined(self, images: Sequence[Array], width: int) -> Array:
        """(H, W, C) images of all panes -> one of `width` pixels; pixels left over repeat the last one."""
        if self.mode in ("wipe", "scenes") and len(images) > 1:
            line = round(self.at * width)
            return np.concatenate([images[0][:, :line], images[1][:, line:]], 1)
        if len(images) == 1:
            return images[0]
        whole = np.concatenate(list(images), 1)
        return np.pad(whole, ((0, 0), (0, max(width - whole.shape[1], 0)), (0, 0)), "edge")


@dataclass(frozen=True)
class Splats:
    """Sizes and colours of the Gaussians as drawn; answers and files have them as they are."""

    size: float = 1.0  # factor of every axis, within SIZE_RANGE: small ones are points, and show gaps
    sh_degree: int = MOST_DEGREE  # at most; 0: colours that do not depend on the direction


# The edited scene: without what is hidden or deleted, and with the selection in its own colour. A renderer
# draws it as it draws any other scene.

TINT = np.array([1.0, 0.15, 0.85], np.float32)  # unlike the colours of queries, and rare in photographs
TINT_STRENGTH = 0.6  # the rest is the thing's own colour, so that its shape stays readable


@dataclass(frozen=True)
class EditedScene:
    """A scene with its edits, and the scene that is drawn for them. Equal for the same scene and marks."""

    source: Scene
    marks: Marks | None
    scene: Scene = field(compare=False)  # M Gaussians
    rows: Array | None = field(compare=False)  # (M,) int64 which of the source's they are; None: all
    selected: Array | None = field(compare=False)  # (M,) bool; None: nothing
    untinted: Scene = field(compare=False)  # of the same Gaussians, in their own colours

    def values(self, values: Array, is_colour: bool = False) -> Array:
        """(N, C) values of the source's Gaussians -> (M, C) of those drawn; colours are tinted as theirs."""
        taken: Array = values if self.rows is None else values[self.rows]
        if not is_colour or self.selected is None:
            return taken
        mixed = np.array(taken, np.float32)
        mixed[self.selected] += TINT_STRENGTH * (TINT - mixed[self.selected])
        return mixed


def edited_scene(source: Scene, marks: Marks | None = None, before: EditedScene | None = None) -> EditedScene:
    """`source` with its edits. The last one made, `before`, is used as far as it fits: where only the
    selection changed, only colours are made anew. Marks for another number of Gaussians count as none."""
    if before is not None and before.source is source and before.marks is marks:
        return before
    if marks is None or len(marks.selected) != len(source.gaussians):
        return EditedScene(source, marks, source, None, None, source)
    rows, untinted = _shown(source, marks, before)
    selected = marks.selected if rows is None else marks.selected[rows]
    if not selected.any():
        return EditedScene(source, marks, untinted, rows, None, untinted)
    return EditedScene(source, marks, _tinted(untinted, selected), rows, selected, untinted)


def _shown(source: Scene, marks: Marks, before: EditedScene | None) -> tuple[Array | None, Scene]:
    if before is not None and before.source is source and before.marks is not None:
        same = before.marks.hidden is marks.hidden and before.marks.deleted is marks.deleted
        if same:
            return before.rows, before.untinted
    if marks.shown.all():
        return None, source
    rows = np.flatnonzero(marks.shown)
    # Images need neither the language field nor what else a file holds.
    return rows, replace(source, gaussians=source.gaussians.take(rows), language=None, extras={})


def _tinted(scene: Scene, selected: Array) -> Scene:
    """Return the scene with the colours of the `selected` (N,) bool mixed with `TINT`, from every side: a
    colour is linear in its coefficients, so that mixing these mixes it, but for what is clamped at black."""
    sh = scene.gaussians.sh.copy()
    sh[selected] *= 1 - TINT_STRENGTH
    sh[selected, 0] += TINT_STRENGTH * (TINT - 0.5) / C0
    return replace(scene, gaussians=replace(scene.gaussians, sh=sh))


def with_splats(scene: Scene, splats: Splats) -> Scene:
    """The scene with its Gaussians as `splats` wants them drawn; the scene itself where that changes nothing.
    The rows stay the same, so that channels fit both."""
    gaussians = scene.gaussians
    if splats.size != 1:
        scales = gaussians.log_scales + np.float32(np.log(splats.size))
        gaussians = replace(gaussians, log_scales=scales)
    if splats.sh_degree < gaussians.sh_degree:
        gaussians = replace(gaussians, sh=gaussians.sh[:, : SH_COUNTS[splats.sh_degree]])
    return scene if gaussians is scene.gaussians else replace(scene, gaussians=gaussians)


# The request.


@dataclass(frozen=True)
class Detail:
    """Level of detail: fewer pixels, and fewer Gaussians, while the camera moves."""

    scale: float = 1.0  # of the image's sides
    merged: Merged | None = None  # drawn in place of the edited scene's Gaussians


FULL = Detail()


@dataclass(frozen=True)
class Pane:
    """One display in an image."""

    picture: PictureConfig
    level: int | None  # index into scene.LEVELS of what is shown; None: the own level of each answer
    answers: Answers

    @property
    def row(self) -> DisplayRow:
        return DISPLAYS[self.picture.display]

    @property
    def ranges(self) -> Ranges:
        """Values of its channel that are drawn as 0 and as 1, as far as they follow from the answers."""
        return self.row.ranges(self.answers, self.picture.heat_scale)

    @property
    def label(self) -> str:
        return self.row.label if self.level is None else f"{self.row.label}, {LEVELS[self.level]}"


@dataclass(frozen=True)
class RenderRequest:
    """An image of a scene. Equal requests give the same image: scenes, marks and answers are equal where they
    are the same objects, cameras where they see the same."""

    scene: EditedScene
    camera: Camera = field(compare=False)  # of each pane, with the pane's size; compared by `pose`
    width: int  # of the image, pixels
    picture: PictureConfig = field(default_factory=PictureConfig)  # display, background, thresholds, colours
    level: int = 2  # index into scene.LEVELS of the latents that are shown
    answers: Answers = ()  # by colour
    split: Split = Split()
    splats: Splats = Splats()
    clip: Clip = UNCLIPPED
    detail: Detail = FULL
    pose: tuple[object, ...] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "answers", tuple(self.answers))
        object.__setattr__(self, "pose", _pose(self.camera))

    @property
    def size(self) -> tuple[int, int]:
        return self.width, self.camera.height

    @property
    def panes(self) -> tuple[Pane, ...]:
        """Displays of the image, from left to right."""
        return panes(self.picture, self.level, self.answers, self.split)

    @property
    def placement(self) -> tuple[object, ...]:
        """Equal where one projection of the Gaussians serves both requests."""
        return self.scene, self.pose, self.splats, self.clip, self.detail

    @property
    def drawn_camera(self) -> Camera:
        """Camera of each pane at the request's level of detail."""
        if self.detail.scale == 1:
            return self.camera
        sides = (self.camera.width, self.camera.height)
        width, height = (max(1, round(side * self.detail.scale)) for side in sides)
        return self.camera.resized(width, height)

    def seen_by(self, camera: Camera) -> "RenderRequest":
        """Return the request by another camera of the image's size, which is fitted into each pane."""
        pane = self.split.pane_size(self.size)
        if pane != (camera.width, camera.height):
            camera = camera.with_intrinsics(camera.intrinsics.fitted(*pane))
        return replace(self, camera=camera)

    def without_line(self) -> "RenderRequest":
        """Return the part that panes depend on, without the line: the window joins them itself."""
        return replace(self, split=replace(self.split, at=0.5))


def plain_request(scene: Scene, camera: Camera, picture: PictureConfig, **more: Any) -> RenderRequest:
    """The image that a camera sees of a scene without edits."""
    return RenderRequest(edited_scene(scene), camera, camera.width, picture, **more)


def panes(picture: PictureConfig, level: int, answers: Answers, split: Split) -> tuple[Pane, ...]:
    """Displays of an image, from left to right; `level` is that of latents. Each query has its own colour as
    soon as two are painted."""
    picture = replace(picture, own_colours=len(painted(answers)) > 1)

    def pane(display: Display, level: int | None) -> Pane:
        return Pane(replace(picture, display=display), level, answers)

    def whole(display: Display, level: int) -> Pane:
        return pane(display, level if DISPLAYS[display].by_level else None)

    if split.mode == "levels":
        row = DISPLAYS[picture.display]
        shown: Display = "relevancy" if row.needs_query else picture.display if row.by_level else "latent"
        return tuple(pane(shown, place) for place in range(len(LEVELS)))
    first = whole(picture.display, level)
    return (first, whole(split.second, split.second_level)) if split.mode == "wipe" else (first,)


def _pose(camera: Camera) -> tuple[object, ...]:
    """Equal for cameras that see the same."""
    return camera.orthographic, camera.intrinsics, camera.world_to_camera.tobytes()


# What a renderer makes of a request and keeps for the next one.


@dataclass(frozen=True, eq=False)
class Channel:
    """Numbers per Gaussian that are rasterized beside colours and alpha for one pane."""

    values: Array | None = None  # (N, 1 to 3)
    is_depth: bool = False  # camera z, which rasterizers have of their own

    @property
    def is_absent(self) -> bool:
        """The pane shows no further channel."""
        return self.values is None and not self.is_depth

    @property
    def key(self) -> tuple[bool, int]:
        """Equal for the same channel, as long as one of the two is held."""
        return self.is_depth, id(self.values)


@dataclass(frozen=True)
class RenderKey:
    """All that a projection of Gaussians depends on. Equal for the same scene, as an object, cut alike, and
    cameras that see the same."""

    scene: Scene  # as it is drawn
    camera: Camera = field(compare=False)  # compared by `pose`
    clip: Clip = UNCLIPPED
    pose: tuple[object, ...] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "pose", _pose(self.camera))

    def settings(self) -> RasterSettings:
        return image_formation(self.scene, self.camera, self.clip)


class Inputs:
    """Scenes and channels of requests as a rasterizer takes them; those of the last scene, edits and answers
    are kept, as the same objects."""

    def __init__(self) -> None:
        self._scene: tuple[tuple[object, ...], Scene] | None = None
        self._of: tuple[object, ...] = ()  # whose channels are kept
        self._channels: dict[tuple[object, int | None], Channel] = {}

    def key(self, request: RenderRequest) -> RenderKey:
        """The projection that the request needs."""
        of = (request.scene, request.splats, request.detail.merged)
        if self._scene is None or self._scene[0] != of:
            scene = request.scene.scene
            if request.detail.merged is not None:
                scene = replace(scene, gaussians=request.detail.merged.gaussians, language=None, extras={})
            self._scene = of, with_splats(scene, request.splats)
        return RenderKey(self._scene[1], request.drawn_camera, request.clip)

    def channels(self, request: RenderRequest) -> list[Channel]:
        of = (request.scene, request.answers, request.detail.merged)
        if self._of != of:
            self._of, self._channels = of, {}
        wanted = [(pane.row.channel, pane.level) for pane in request.panes]
        for of_pane, pane in zip(wanted, request.panes, strict=True):
            if of_pane not in self._channels:
                self._channels[of_pane] = _channel(request, pane)
        return [self._channels[of_pane] for of_pane in wanted]

    def forget(self) -> None:
        self._scene, self._of, self._channels = None, (), {}


def _channel(request: RenderRequest, pane: Pane) -> Channel:
    make, source = pane.row.channel, request.scene.source
    if make is None or make == "depth":
        return Channel(is_depth=make == "depth")
    values = make(Subject(len(source.gaussians), source.language, pane.answers, pane.level))
    if values is None:
        return Channel()
    values = request.scene.values(values, pane.row.is_colour)
    return Channel(values if request.detail.merged is None else request.detail.merged.values(values))
