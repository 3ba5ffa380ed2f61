"""The protocols, each one frozen value that pins every constant and says where it is from, and how each turns
maps, drawn selections or the engine's own answer into a mask and a place.

Figures of one benchmark differ by ten points between protocols, so a figure belongs to a profile. Nothing
here depends on a label: a profile is chosen by name, and no threshold is searched.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Literal

import numpy as np
from scipy.ndimage import uniform_filter

from langsplat_core.arrays import Array
from langsplat_core.config import PictureConfig
from langsplat_core.query.answers import QueryResult, peak_pixel, splatted_relevancy
from langsplat_core.raster.protocol import View

Border = Literal["mirror", "inside"]  # cv2's reflect101; the mean of what lies inside the image
LevelRule = Literal["peak", "inside"]  # the highest map; the highest mean inside its own mask
# "clipped": LangSplat's loop, which never counts the last row and column; "inside": V2's.
Vote = Literal["none", "clipped", "inside"]
Benchmark = Literal["lerf-ovs", "3d-ovs"]
LerfProtocol = Literal["langsplat-code", "langsplat-paper", "langsplat-v2", "direct-3d", "ours"]
OvsProtocol = Literal["langsplat-paper", "direct-3d", "ours"]


@dataclass(frozen=True)
class MapRule:
    """A rule that turns relevancy maps, one per level, into a mask and a peak."""

    window: int  # px, mean filter of the map that is cut; 1: none
    raw_share: float  # of the unfiltered map in what is cut
    border: Border
    level: LevelRule
    min_max: bool  # cut the chosen map after it was brought to [0, 1]
    threshold: float  # strictly above belongs to the mask
    vote: Vote
    vote_window: int  # px
    peak_window: int  # px, mean filter of the map whose peak is the place; its level is chosen apart
    ties: bool  # every pixel as high as the peak is tried, else the first in reading order


@dataclass(frozen=True)
class SilhouetteRule:
    """From the image of the selected Gaussians alone to a mask; no place is scored."""

    alpha: float = 0.7  # strictly above, else the pixel is black
    grey: int = 10  # of 255, strictly above belongs to the mask


@dataclass(frozen=True)
class OwnRule:
    """The rule that turns the engine's own answer into a mask and a peak (see `own_prediction`)."""

    share: float = 0.5  # of a pixel's light that comes from members, strictly above
    peak_window: int = 20  # px of an image of `rows` rows, as the paper's; in proportion for others
    rows: int = 731


@dataclass(frozen=True)
class Profile:
    """A protocol on one benchmark."""

    name: str
    source: str  # what pins the constants, and what had to be filled in
    rule: MapRule | SilhouetteRule | OwnRule
    max_rows: int = 1080  # higher images are scored at this height, as LangSplat's loader shrinks them


_CODE = MapRule(30, 0.5, "mirror", "peak", True, 0.7, "clipped", 7, 30, True)
_LERF_PAPER = MapRule(20, 0.0, "mirror", "peak", True, 0.7, "none", 1, 20, False)
_OVS_PAPER = MapRule(1, 1.0, "mirror", "inside", False, 0.4, "none", 1, 20, False)
_DIRECT = Profile(
    "direct-3d",
    "OpenGaussian's protocol: Gaussians are selected by the phrase, drawn alone, and the image is cut; of "
    "a scene, the members of the engine's answer; how often a Gaussian was seen is not kept and not asked",
    SilhouetteRule(),
)
_OURS = Profile(
    "ours", "this program's answer as it shows it, its verdict included: not here is an empty mask", OwnRule()
)

LERF_PROFILES: Mapping[LerfProtocol, Profile] = MappingProxyType(
    {
        "langsplat-code": Profile(
            "langsplat-code",
            "LangSplat's public evaluator: (filter 30 + raw) / 2, level by the peak before min-max, min-max "
            "above 0.7, 7x7 majority; place: all highest pixels of the filtered map",
            _CODE,
        ),
        "langsplat-paper": Profile(
            "langsplat-paper",
            "LangSplat's text: filter 20, level and place by the filtered peak; the text gives no cut for "
            "LERF-OVS: min-max above 0.7 as its code, without the vote",
            _LERF_PAPER,
        ),
        "langsplat-v2": Profile(
            "langsplat-v2",
            "LangSplatV2's public evaluator: 29x29 mean of what lies inside the image, the same blend and "
            "cut, 7x7 mean above one half; place as in LangSplat's code",
            MapRule(29, 0.5, "inside", "peak", True, 0.7, "inside", 7, 29, True),
        ),
        "direct-3d": _DIRECT,
        "ours": _OURS,
    }
)
OVS_PROFILES: Mapping[OvsProtocol, Profile] = MappingProxyType(
    {
        "langsplat-paper": Profile(
            "langsplat-paper",
            "LangSplat's appendix: absolute 0.4, the level whose mask has the highest mean relevancy, no "
            "filter; its code for 3D-OVS was never released",
            _OVS_PAPER,
        ),
        "direct-3d": _DIRECT,
        "ours": _OURS,
    }
)


# From relevancy maps or images of selected Gaussians to a mask and a place, as a profile says.
#
# Everything here is given maps and constants, never a label.

TINY = 1e-9  # added to the range that a map is divided by, as in LangSplat's code: a flat map is 0


@dataclass(frozen=True, eq=False)
class Prediction:
    """The answer to a phrase in a view, as it is scored."""

    mask: Array  # (H, W) bool
    level: int | None = None  # whose map was cut
    # (P, 2) int column and row: the place, or several as high; empty: none was named
    peaks: Array = field(default_factory=lambda: np.empty((0, 2), int))


def read_maps(maps: Array, rule: MapRule) -> Prediction:
    """(L, H, W) relevancy per level, L >= 1 -> mask and place."""
    maps = np.asarray(maps, np.float64)
    blended = [
        (1 - rule.raw_share) * mean_filtered(level, rule.window, rule.border) + rule.raw_share * level
        for level in maps
    ]
    if rule.level == "peak":
        chosen = int(np.argmax([values.max() for values in blended]))
    else:
        chosen = int(np.argmax([_mean_inside(values, rule.threshold) for values in blended]))
    values = blended[chosen]
    if rule.min_max:
        values = values - values.min()
        values = values / (values.max() + TINY)
    mask = voted(values > rule.threshold, rule.vote, rule.vote_window)
    return Prediction(mask, chosen, peak_pixels(maps, rule))


def peak_pixels(maps: Array, rule: MapRule) -> Array:
    """(P, 2) column and row of the highest pixel over all levels' filtered maps; more than one where several
    of that level are as high and the rule tries all."""
    smooth = [mean_filtered(level, rule.peak_window, rule.border) for level in maps]
    best = smooth[int(np.argmax([values.max() for values in smooth]))]
    pixels = np.argwhere(best == best.max())[:, ::-1]
    return pixels if rule.ties else pixels[:1]


def _mean_inside(values: Array, threshold: float) -> float:
    """Return the mean of the values above the threshold; -1, below every relevancy, where there are none."""
    inside = values[values > threshold]
    return float(inside.mean()) if len(inside) else -1.0


def mean_filtered(values: Array, window: int, border: Border) -> Array:
    """(H, W) means over `window` x `window` pixels; an even window reaches one pixel further up and left, as
    cv2's does."""
    if window <= 1:
        return values
    if border == "mirror":
        return uniform_filter(values, window, mode="mirror")
    total = uniform_filter(values, window, mode="constant")
    return total / uniform_filter(np.ones_like(values), window, mode="constant")


def voted(mask: Array, vote: Vote, window: int) -> Array:
    """(H, W) bool after a majority vote over `window` x `window` pixels inside the image; a tie is False.

    "clipped": the image's last row and column are never counted, as in LangSplat's code.
    """
    if vote == "none" or window <= 1:
        return mask
    counted = np.ones(mask.shape)
    if vote == "clipped":
        counted[-1], counted[:, -1] = 0, 0
    votes = uniform_filter(mask * counted, window, mode="constant")
    of = uniform_filter(counted, window, mode="constant")
    return np.asarray(2 * votes > of + TINY)


def read_silhouette(colours: Array, alpha: Array, rule: SilhouetteRule) -> Array:
    """(H, W, 3) colours over black and (H, W) alpha of the selected Gaussians alone -> (H, W) mask."""
    grey = np.clip(colours, 0, 1) @ np.array([0.299, 0.587, 0.114])
    drawn = np.where(alpha > rule.alpha, np.rint(255 * grey), 0)
    return np.asarray(drawn > rule.grey)


# How this program's own answer becomes a mask and a place in a view: the one place to change it.


def own_prediction(view: View, result: QueryResult, rule: OwnRule) -> Prediction:
    """The mask is what shows mostly members of the answer (hidden ones do not count), the place is the peak
    of the filtered map of the answer's level. Nothing of either where the verdict is "not here"."""
    values = np.stack([result.members, result.relevancy[result.level]], 1).astype(np.float32)
    drawn = splatted_relevancy(view, values, PictureConfig().alpha_gate)
    if not result.found:
        return Prediction(np.zeros(drawn.shape[:2], bool), result.level)
    column, row, _ = peak_pixel(drawn[..., 1], round(rule.peak_window * len(drawn) / rule.rows))
    return Prediction(drawn[..., 0] > rule.share, result.level, np.array([[column, row]]))
