"""Protocols of the benchmarks: frozen values with every constant and its source.

The module also turns relevancy maps, rendered selections or the engine's own answers into masks and
positions. Figures of one benchmark differ by ten points between protocols, so a figure belongs to a protocol.
Nothing here depends on labels: a protocol is chosen by name, and no threshold is searched.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np
from scipy.ndimage import uniform_filter

from langsplat_core.arrays import Array
from langsplat_core.config import PictureConfig
from langsplat_core.errors import FormatError
from langsplat_core.extensions.benchmarks.labels import Size, check_same_image, read_grey
from langsplat_core.io.hostile import opened, read_npy
from langsplat_core.query.answers import QueryResult
from langsplat_core.query.compose import run_phrase
from langsplat_core.query.engine import QueryEngine
from langsplat_core.query.lookup import peak_pixel, splatted_relevancy
from langsplat_core.raster.protocol import View
from langsplat_core.raster.render import render, view_of
from langsplat_core.scene import LEVELS, Camera

Border = Literal["mirror", "inside"]  # cv2's reflect101; the mean over pixels inside the image
LevelRule = Literal["peak", "inside"]  # the highest peak; the highest mean inside its own mask
# "clipped": LangSplat's loop, which never counts the last row and column; "inside": LangSplatV2's.
Vote = Literal["none", "clipped", "inside"]
LerfProtocol = Literal["langsplat-code", "langsplat-paper", "langsplat-v2", "direct-3d", "ours"]
OvsProtocol = Literal["langsplat-paper", "direct-3d", "ours"]


@dataclass(frozen=True, kw_only=True)
class MapRule:
    """A rule that turns relevancy maps, one per level, into a mask and a peak."""

    window: int  # px, mean filter of the map that is cut; 1: none
    raw_share: float  # weight of the unfiltered map in the map that is cut
    border: Border
    level: LevelRule
    min_max: bool  # scale the chosen map to [0, 1] before the cut
    threshold: float  # strictly above is the mask
    vote: Vote
    vote_window: int  # px
    peak_window: int  # px, mean filter of the map whose peak is the position; its level is chosen by itself
    ties: bool  # all pixels as high as the peak are positions, else the first in reading order


@dataclass(frozen=True)
class SilhouetteRule:
    """A rule that makes a mask from an image of the selected Gaussians alone; no position is scored."""

    alpha: float = 0.7  # strictly above, else the pixel is black
    grey: int = 10  # of 255, strictly above is the mask


@dataclass(frozen=True)
class OwnRule:
    """A rule that turns the engine's own answer into a mask and a peak (see `own_prediction`)."""

    share: float = 0.5  # of a pixel's weight that is of members, strictly above
    peak_window: int = 20  # px for an image of `rows` rows, as in the paper; in proportion for others
    rows: int = 731
    composed: bool = False  # phrases are compositional queries, else plain ones


@dataclass(frozen=True)
class Profile:
    """A protocol on one benchmark."""

    name: str
    source: str  # where the constants are from, and which had to be chosen
    rule: MapRule | SilhouetteRule | OwnRule
    max_rows: int = 1080  # higher images are scored at this height, as LangSplat's loader shrinks them


_CODE = MapRule(window=30, raw_share=0.5, border="mirror", level="peak", min_max=True, threshold=0.7,
                vote="clipped", vote_window=7, peak_window=30, ties=True)  # fmt: skip
_TEXT = MapRule(window=20, raw_share=0.0, border="mirror", level="peak", min_max=True, threshold=0.7,
                vote="none", vote_window=1, peak_window=20, ties=False)  # fmt: skip
_CODE_V2 = MapRule(window=29, raw_share=0.5, border="inside", level="peak", min_max=True, threshold=0.7,
                   vote="inside", vote_window=7, peak_window=29, ties=True)  # fmt: skip
_TEXT_OVS = MapRule(window=1, raw_share=1.0, border="mirror", level="inside", min_max=False, threshold=0.4,
                    vote="none", vote_window=1, peak_window=20, ties=False)  # fmt: skip
_DIRECT = Profile(
    "direct-3d",
    "OpenGaussian's protocol: Gaussians are selected by the phrase, drawn alone, and the image is cut; of "
    "a scene, the members of the engine's answer; how often a Gaussian was seen is not kept and not asked",
    SilhouetteRule(),
)
_OURS = Profile(
    "ours", "this program's answer as it shows it, its verdict included: not here is an empty mask", OwnRule()
)

LERF_PROFILES: Mapping[str, Profile] = {
    profile.name: profile
    for profile in (
        Profile(
            "langsplat-code",
            "LangSplat's public evaluator: (filter 30 + raw) / 2, level by the peak before min-max, min-max "
            "above 0.7, 7x7 majority; place: all highest pixels of the filtered map",
            _CODE,
        ),
        Profile(
            "langsplat-paper",
            "LangSplat's text: filter 20, level and place by the filtered peak; the text gives no cut for "
            "LERF-OVS: min-max above 0.7 as its code, without the vote",
            _TEXT,
        ),
        Profile(
            "langsplat-v2",
            "LangSplatV2's public evaluator: 29x29 mean of what lies inside the image, the same blend and "
            "cut, 7x7 mean above one half; place as in LangSplat's code",
            _CODE_V2,
        ),
        _DIRECT,
        _OURS,
    )
}
GR_PROFILES = {**LERF_PROFILES, "ours": replace(_OURS, rule=OwnRule(composed=True))}
_OVS_PAPER = Profile(
    "langsplat-paper",
    "LangSplat's appendix: absolute 0.4, the level whose mask has the highest mean relevancy, no filter; its "
    "code for 3D-OVS was never released",
    _TEXT_OVS,
)
OVS_PROFILES: Mapping[str, Profile] = {profile.name: profile for profile in (_OVS_PAPER, _DIRECT, _OURS)}


# Masks and positions from relevancy maps or images of selected Gaussians, without labels.

TINY = 1e-9  # added to the range by which a map is divided, as in LangSplat's code: a flat map is 0


@dataclass(frozen=True, eq=False)
class Prediction:
    """The answer to a phrase in a view, for scoring."""

    mask: Array  # (H, W) bool
    level: int | None = None  # of the map that was cut
    # (P, 2) int column and row: the position, or several equal ones; empty: none
    peaks: Array = field(default_factory=lambda: np.empty((0, 2), int))


def read_maps(maps: Array, rule: MapRule) -> Prediction:
    """Return the prediction from (L, H, W) relevancy maps, L >= 1, of one chosen level."""
    maps = np.asarray(maps, np.float64)
    blended = [
        (1 - rule.raw_share) * mean_filtered(level, rule.window, rule.border) + rule.raw_share * level
        for level in maps
    ]
    heights = [values.max() for values in blended]
    if rule.level == "inside":  # -1, below every relevancy, for an empty mask
        heights = [values[values > rule.threshold].mean() if high > rule.threshold else -1.0
                   for values, high in zip(blended, heights, strict=True)]  # fmt: skip
    chosen = int(np.argmax(heights))
    values = blended[chosen]
    if rule.min_max:
        values = values - values.min()
        values = values / (values.max() + TINY)
    mask = voted(values > rule.threshold, rule.vote, rule.vote_window)
    return Prediction(mask, chosen, peak_pixels(maps, rule))


def peak_pixels(maps: Array, rule: MapRule) -> Array:
    """Return (P, 2) column and row of the highest pixel over all maps, or of all equal ones of its level."""
    smooth = [mean_filtered(level, rule.peak_window, rule.border) for level in maps]
    best = smooth[int(np.argmax([values.max() for values in smooth]))]
    pixels = np.argwhere(best == best.max())[:, ::-1]
    return pixels if rule.ties else pixels[:1]


def mean_filtered(values: Array, window: int, border: Border) -> Array:
    """Return (H, W) means over `window`^2 pixels; an even window extends further up and left, as in cv2."""
    if border == "mirror":
        return uniform_filter(values, window, mode="mirror")
    total = uniform_filter(values, window, mode="constant")
    return total / uniform_filter(np.ones_like(values), window, mode="constant")


def voted(mask: Array, vote: Vote, window: int) -> Array:
    """Return the (H, W) bool majority of `window`^2 pixels, ties False; "clipped": no last row and column."""
    if vote == "none":
        return mask
    counted = np.ones(mask.shape)
    if vote == "clipped":
        counted[-1], counted[:, -1] = 0, 0
    votes = uniform_filter(mask * counted, window, mode="constant")
    of = uniform_filter(counted, window, mode="constant")
    return np.asarray(2 * votes > of + TINY)


# Mask and position of this program's own answer in a view.


def own_prediction(view: View, result: QueryResult, rule: OwnRule) -> Prediction:
    """Return mask and position of an answer as the program shows it.

    The mask has the pixels that show mostly members of the answer, the position is the peak of the filtered
    map of the answer's level. Both are empty unless the answer is found.
    """
    values = np.stack([result.members, result.relevancy[result.level]], 1).astype(np.float32)
    drawn = splatted_relevancy(view, values, PictureConfig().alpha_gate)
    if not result.found:
        return Prediction(np.zeros(drawn.shape[:2], bool), result.level)
    column, row, _ = peak_pixel(drawn[..., 1], round(rule.peak_window * len(drawn) / rule.rows))
    return Prediction(drawn[..., 0] > rule.share, result.level, np.array([[column, row]]))


# Sources of answers: a scene of this program, or a folder of relevancy maps and masks of another system.
# Neither sees labels.
#
#     <view>/<phrase>.npy     float (L, H, W) or (H, W) relevancy; L levels, at most three
#     <view>/<phrase>.png     a single map; for protocol direct-3d the drawn silhouette instead
#
# A PNG of 8 or 16 bits has relevancies from 0 to 1. A "/" in a phrase is "_" in its file name. Maps of one
# phrase have one size; masks of labels are resized to it.


def _read_relevancy(path: Path) -> Array:
    """Return (L, H, W) float64 maps in a file; FormatError for a damaged one."""
    values = read_npy(path) if path.suffix == ".npy" else _image(path)
    values = values[None] if values.ndim == 2 else values
    if values.ndim != 3 or 0 in values.shape or len(values) > len(LEVELS):
        raise FormatError(f"{path}: shape {values.shape}; expected (H, W), or (L, H, W), at most 3 levels")
    if not np.isfinite(values).all():
        raise FormatError(f"{path}: holds numbers that are not finite")
    return values.astype(np.float64)


def _image(path: Path) -> Array:
    """Return (H, W) relevancy in [0, 1] of an image file."""
    with opened(path) as image:
        if image.mode.startswith("I"):
            return np.asarray(image, np.float64) / 65535
        return np.asarray(image.convert("L"), np.float64) / 255


TOGETHER = 10  # phrases splatted in one pass, three channels each


@dataclass(frozen=True, eq=False)
class SceneSource:
    """A scene of this program, rendered from the labelled views."""

    engine: QueryEngine
    cameras: Mapping[str, Camera]  # by name without extension
    trained: frozenset[str] | None  # names of the training views; None: unknown in the dataset's names
    profile: Profile

    def answers(self, frame: str, size: Size, phrases: Sequence[str]) -> Mapping[str, Prediction | str]:
        """Return the answer to each phrase in the view `frame`, rendered at `size`, or why there is none."""
        if frame not in self.cameras:
            return dict.fromkeys(phrases, "no camera of that name")
        camera = self.cameras[frame]
        check_same_image(frame, (camera.width, camera.height), size)
        camera = camera.resized(*size)
        found: dict[str, Prediction | str] = {}
        for phrase in phrases:
            unknown = self.engine.unknown_words(phrase)
            if unknown:
                found[phrase] = f"the encoder does not know {', '.join(repr(word) for word in unknown)}"
        asked = [phrase for phrase in phrases if phrase not in found]
        for start in range(0, len(asked), TOGETHER):
            part = asked[start : start + TOGETHER]
            found |= zip(part, self._predictions(camera, part), strict=True)
        return found

    def _predictions(self, camera: Camera, phrases: Sequence[str]) -> list[Prediction]:
        rule, scene, engine = self.profile.rule, self.engine.scene, self.engine
        view, gate, count = view_of(scene, camera), PictureConfig().alpha_gate, len(LEVELS)
        if isinstance(rule, OwnRule) and rule.composed:
            results = [run_phrase(engine, phrase, viewpoint=camera).answer for phrase in phrases]
        else:
            results = engine.run_many(phrases)
        if isinstance(rule, OwnRule):
            return [own_prediction(view, result, rule) for result in results]
        if isinstance(rule, SilhouetteRule):
            return [Prediction(self._silhouette(camera, result, rule), result.level) for result in results]
        values = np.concatenate([result.relevancy for result in results]).T
        maps = np.moveaxis(splatted_relevancy(view, values, gate), 2, 0)
        return [read_maps(maps[row : row + count], rule) for row in range(0, len(maps), count)]

    def _silhouette(self, camera: Camera, result: QueryResult, rule: SilhouetteRule) -> Array:
        """Return the mask of the answer's Gaussians rendered alone, without occlusion by others."""
        if not result.members.any():
            return np.zeros((camera.height, camera.width), bool)
        drawn = render(self.engine.scene.take(result.members), camera)  # over black
        grey = np.clip(drawn.colours, 0, 1) @ np.array([0.299, 0.587, 0.114])
        return np.asarray(np.where(drawn.alpha > rule.alpha, np.rint(255 * grey), 0) > rule.grey)


@dataclass(frozen=True, eq=False)
class MapSource:
    """Another system's maps of one scene, scored on their own grid; for files see above."""

    folder: Path  # <view>/<phrase>...
    rule: MapRule | SilhouetteRule
    trained: frozenset[str] | None = None

    def answers(self, frame: str, size: Size, phrases: Sequence[str]) -> Mapping[str, Prediction | str]:
        """Return the answer to each phrase by its map in the view `frame`, or why there is none."""
        return {phrase: self._answer(self.folder / frame, phrase) for phrase in phrases}

    def _answer(self, folder: Path, phrase: str) -> Prediction | str:
        suffixes = (".png",) if isinstance(self.rule, SilhouetteRule) else (".npy", ".png")
        files = (folder / f"{phrase.replace('/', '_')}{suffix}" for suffix in suffixes)
        path = next((path for path in files if path.is_file()), None)
        if path is None:
            return "no map"
        if isinstance(self.rule, SilhouetteRule):
            return Prediction(read_grey(path) > self.rule.grey)
        return read_maps(_read_relevancy(path), self.rule)


Source = SceneSource | MapSource
