"""The render request: everything that an image of the scene depends on, as one value.

The canvas of the window, saved images, films and `--headless` each fill one in; a renderer
(`rendering.renderer`) draws it. An image may have several panes: displays of one camera side by side.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Annotated, Any, Literal

import numpy as np
from msgspec import Meta

from langsplat_core.arrays import Array, logit
from langsplat_core.config import Display, PictureConfig, RasterSettings
from langsplat_core.display.displays import DISPLAYS, Answers, DisplayRow, Ranges, painted
from langsplat_core.scene import LEVELS, SH_COUNTS, Camera, Gaussians, Scene, near_plane
from langsplat_core.scene.gaussians import Merged
from langsplat_viewer.marks import Marks

# View settings that a request has.

SH_DEGREE = len(SH_COUNTS) - 1


def widget(panel: str, title: str, about: str, low: float | None = None, high: float | None = None) -> Meta:
    """Return the annotation of a setting that has a widget in a panel; its bounds hold for files, too."""
    return Meta(ge=low, le=high, title=title, description=about, extra={"panel": panel})


@dataclass(frozen=True)
class Clip:
    """Depths between which Gaussians are drawn, by their centres; world units from the eye."""

    near: Annotated[float, Meta(ge=0)] = 0.0
    far: Annotated[float, Meta(ge=0)] = math.inf

    def keeps(self, depths: Array) -> Array:
        """Return (N,) bool, which of (N,) depths are within the range."""
        kept: Array = (depths > self.near) & (depths <= self.far)
        return kept


UNCLIPPED = Clip()


@dataclass(frozen=True)
class Splats:
    """Changes of the Gaussians' sizes and colours in images; answers and files are not affected."""

    size: Annotated[float, widget("Display", "Splat size", "Draw every Gaussian smaller", 0.1, 1)] = 1.0
    sh_degree: Annotated[
        int, widget("Display", "SH degree", "How much colours change with the direction", 0, SH_DEGREE)
    ] = SH_DEGREE  # at most


SplitMode = Literal["off", "wipe", "levels", "scenes"]
AT_RANGE = (0.02, 0.98)  # of the area's width, where the line can be: it stays within reach


@dataclass(frozen=True)
class Split:
    """Several panes of one camera in an image.

    "wipe": the display that is chosen left of a line, `second` right of it. "levels": three columns, from
    subpart to whole, of relevancy where a display of answers is chosen, else of latents. "scenes": one pane,
    and another scene right of the line, whose image is not this request's.
    """

    mode: SplitMode = "off"
    second: Display = "depth"
    second_level: Annotated[int, Meta(ge=0, lt=len(LEVELS))] = 2  # of latents, index into scene.LEVELS
    at: Annotated[float, Meta(ge=AT_RANGE[0], le=AT_RANGE[1])] = 0.5  # where the line is, of the area's width

    @property
    def columns(self) -> int:
        """Columns that the image is divided into; the two panes of a wipe lie over each other."""
        return len(LEVELS) if self.mode == "levels" else 1

    @property
    def has_line(self) -> bool:
        """True where two images lie over each other, left and right of a line."""
        return self.mode in ("wipe", "scenes")

    def pane_size(self, size: tuple[int, int]) -> tuple[int, int]:
        """Return the pixels of each pane of an image of `size` (width, height)."""
        return max(size[0] // self.columns, 1), size[1]

    def within_pane(self, u: float) -> float:
        """Return, for a fraction of the image's width, the fraction of the width of the pane there."""
        return u * self.columns - min(max(int(u * self.columns), 0), self.columns - 1)

    def joined(self, images: Sequence[Array], width: int) -> Array:
        """Join the (H, W, C) images of all panes to one of `width` pixels, filled by its last column."""
        if self.has_line and len(images) > 1:
            line = round(self.at * width)
            return np.concatenate([images[0][:, :line], images[1][:, line:]], 1)
        if len(images) == 1:
            return images[0]
        whole = np.concatenate(list(images), 1)
        return np.pad(whole, ((0, 0), (0, max(width - whole.shape[1], 0)), (0, 0)), "edge")


# The edited scene: without what is hidden or deleted. A renderer draws it as it draws any other scene.


@dataclass(frozen=True)
class EditedScene:
    """A scene with its edits, and the scene that is drawn for them. Equal for the same scene and marks."""

    source: Scene
    marks: Marks | None
    scene: Scene = field(compare=False)  # M Gaussians
    rows: Array | None = field(compare=False)  # (M,) int64 which of the source's they are; None: all
    selected: Array | None = field(compare=False)  # (M, 1) float32, 1 for what is selected; None: nothing

    def values(self, values: Array) -> Array:
        """Return (M, C) values of those drawn for (N, C) of the source's."""
        taken: Array = values if self.rows is None else values[self.rows]
        return taken


def edited_scene(source: Scene, marks: Marks | None = None, before: EditedScene | None = None) -> EditedScene:
    """Return `source` with its edits; marks for another number of Gaussians count as none.

    The last one made, `before`, is used as far as it fits: where only the selection changed, the scene stays.
    """
    if before is not None and before.source is source and before.marks is marks:
        return before
    if marks is None or len(marks.selected) != len(source.gaussians):
        return EditedScene(source, marks, source, None, None)
    old = before.marks if before is not None and before.source is source else None
    if before is not None and old is not None and old.hidden is marks.hidden and old.deleted is marks.deleted:
        rows, scene = before.rows, before.scene
    elif marks.shown.all():
        rows, scene = None, source
    else:  # images need neither the language field nor what else a file holds
        rows = np.flatnonzero(marks.shown)
        scene = replace(source, gaussians=source.gaussians.take(rows), language=None, extras={})
    chosen = marks.selected if rows is None else marks.selected[rows]
    selected = chosen[:, None].astype(np.float32) if chosen.any() else None
    return EditedScene(source, marks, scene, rows, selected)


# The request.


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
        everywhere = self.picture.heat == "everywhere" or self.level is not None
        return self.row.ranges(self.answers, self.picture.heat_scale, everywhere)

    @property
    def label(self) -> str:
        """Name of the display, and of its level where it shows one."""
        return self.row.label if self.level is None else f"{self.row.label}, {LEVELS[self.level]}"


def panes(picture: PictureConfig, level: int, answers: Answers, split: Split) -> tuple[Pane, ...]:
    """Return the displays of an image, from left to right; `level` is that of latents.

    Each query has its own colour as soon as two are painted.
    """
    picture = replace(picture, own_colours=len(painted(answers)) > 1)

    def pane(display: Display, level: int | None) -> Pane:
        return Pane(replace(picture, display=display), level, answers)

    if split.mode == "levels":
        row = DISPLAYS[picture.display]
        shown: Display = "relevancy" if row.needs_query else picture.display if row.by_level else "latent"
        return tuple(pane(shown, place) for place in range(len(LEVELS)))
    wanted = [(picture.display, level), (split.second, split.second_level)]
    return tuple(
        pane(display, level if DISPLAYS[display].by_level else None)
        for display, level in wanted[: 2 if split.mode == "wipe" else 1]
    )


@dataclass(frozen=True)
class RenderRequest:
    """An image of a scene; equal requests give the same image, so that a request is its own key.

    Scenes, marks and answers are equal where they are the same objects, cameras where they see the same.
    """

    scene: EditedScene
    camera: Camera = field(compare=False)  # of each pane, with the pane's size; compared by `pose`
    width: int  # of the image, pixels
    picture: PictureConfig = field(default_factory=PictureConfig)  # display, background, thresholds, colours
    level: int = 2  # index into scene.LEVELS of the latents that are shown
    answers: Answers = ()  # by colour
    split: Split = Split()
    splats: Splats = Splats()
    clip: Clip = UNCLIPPED
    merged: Merged | None = None  # drawn in place of the edited scene's Gaussians
    pose: tuple[object, ...] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        camera = self.camera
        object.__setattr__(self, "answers", tuple(self.answers))
        pose = camera.orthographic, camera.intrinsics, camera.world_to_camera.tobytes()
        object.__setattr__(self, "pose", pose)

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the image, pixels."""
        return self.width, self.camera.height

    @property
    def panes(self) -> tuple[Pane, ...]:
        """Displays of the image, from left to right."""
        return panes(self.picture, self.level, self.answers, self.split)

    @property
    def gaussians(self) -> Gaussians:
        """Gaussians that are drawn, before `splats` changes them."""
        return self.scene.scene.gaussians if self.merged is None else self.merged.gaussians

    @cached_property
    def depths(self) -> tuple[float, float] | None:
        """Camera z that is drawn as near and as far, see `depth_range`; None where no depth is shown."""
        is_shown = any(pane.row.channel == "depth" for pane in self.panes)
        return depth_range(self.gaussians, self.camera, self.clip) if is_shown else None

    @property
    def projection(self) -> tuple[object, ...]:
        """Equal where one projection of the Gaussians serves both requests."""
        return self.scene.scene, self.merged, self.splats, self.clip, self.pose

    def seen_by(self, camera: Camera) -> "RenderRequest":
        """Return the request by another camera of the image's size, which is fitted into each pane."""
        pane = self.split.pane_size(self.size)
        if pane != (camera.width, camera.height):
            camera = camera.fitted(*pane)
        return replace(self, camera=camera)

    def reduced(self, scale: float, merged: Merged | None = None) -> "RenderRequest":
        """Return the request with sides `scale` times as long, of `merged` Gaussians where there are some."""
        width, height, whole = (
            max(round(side * scale), 1) for side in (self.camera.width, self.camera.height, self.width)
        )
        camera = self.camera if scale == 1 else self.camera.resized(width, height)
        return replace(self, camera=camera, width=whole, merged=merged)

    def without_line(self) -> "RenderRequest":
        """Return the part that panes depend on, without the line: the window joins them itself."""
        return replace(self, split=replace(self.split, at=0.5))


def plain_request(scene: Scene, camera: Camera, picture: PictureConfig, **more: Any) -> RenderRequest:
    """Return the request of the image that a camera sees of a scene without edits."""
    return RenderRequest(edited_scene(scene), camera, camera.width, picture, **more)


# Image formation of the viewer: a near plane that training would clip at moves, empty images are explained.

VISIBLE_ALPHA = 1 / 255


def image_formation(scene: Scene, camera: Camera, clip: Clip = UNCLIPPED) -> RasterSettings:
    """Return the scene's own image formation, within `clip`.

    Its near plane comes nearer where the camera stands closer to what it sees than the scene's cameras do. An
    orthographic camera has it at the eye.
    """
    settings = scene.raster_settings()
    near = 0.0 if camera.orthographic else near_plane(scene.gaussians, [camera], scene.near)
    return replace(settings, near=max(near, clip.near), far=None if math.isinf(clip.far) else clip.far)


def depth_range(gaussians: Gaussians, camera: Camera, clip: Clip = UNCLIPPED) -> tuple[float, float] | None:
    """Return the 2 % and 98 % quantiles of camera z of what is in the image and in `clip`, world units.

    None where nothing is.
    """
    some = gaussians.means[:: max(len(gaussians) // 20_000, 1)]  # quantiles need no more
    with np.errstate(invalid="ignore", over="ignore"):
        pixels, depths = camera.project(some.astype(np.float64))
        inside = camera.in_image(pixels, depths) & clip.keeps(depths)
    if not inside.any():
        return None
    near, far = np.quantile(depths[inside], [0.02, 0.98])
    return float(near), float(far)


def with_splats(scene: Scene, splats: Splats) -> Scene:
    """Return the scene with `splats` applied to its Gaussians; the same object if that changes nothing."""
    gaussians = scene.gaussians
    if splats.size != 1:
        scales = gaussians.log_scales + np.float32(np.log(splats.size))
        gaussians = replace(gaussians, log_scales=scales)
    if splats.sh_degree < gaussians.sh_degree:
        gaussians = replace(gaussians, sh=gaussians.sh[:, : SH_COUNTS[splats.sh_degree]])
    return scene if gaussians is scene.gaussians else scene.recoloured(gaussians)


def why_undrawable(gaussians: Gaussians) -> str:
    """Return why no camera could see anything of these; empty where one could."""
    count, valid = len(gaussians), gaussians.valid()
    if count == 0:
        return "the scene holds no Gaussians"
    if not valid.any():
        reasons = ", ".join(f"{rows:,} with {reason}" for reason, rows in gaussians.invalid_rows().items())
        return f"none of the {count:,} Gaussians can be drawn: {reasons}"
    if (gaussians.opacity_logits[valid] < logit(np.array(VISIBLE_ALPHA))).all():
        return f"all {int(valid.sum()):,} Gaussians are transparent"
    return ""


def why_nothing(gaussians: Gaussians, camera: Camera) -> str:
    """Return why an image by `camera` shows nothing of these."""
    reason = why_undrawable(gaussians)
    if reason:
        return reason
    _, depths = camera.project(gaussians.means[gaussians.valid()].astype(np.float64))
    if (depths <= 0).all():
        return "the whole scene lies behind the camera"
    if (depths <= near_plane(gaussians, [camera])).all():
        return "the whole scene lies nearer than the camera can see"
    return "nothing of the scene lies in this picture"
