"""The protocols, each one frozen value that pins every constant, and where it is from.

Figures of one benchmark differ by ten points between protocols, so a figure belongs to a profile. Nothing
here depends on a label: a profile is chosen by name, and no threshold is searched.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal

Border = Literal["mirror", "inside"]  # cv2's reflect101; the mean of what lies inside the picture
LevelRule = Literal["peak", "inside"]  # the highest map; the highest mean inside its own mask
Vote = Literal[
    "none", "clipped", "inside"
]  # LangSplat's loop, which never counts the last row and column; V2's
Benchmark = Literal["lerf-ovs", "3d-ovs"]
LerfProtocol = Literal["langsplat-code", "langsplat-paper", "langsplat-v2", "direct-3d", "ours"]
OvsProtocol = Literal["langsplat-paper", "direct-3d", "ours"]


@dataclass(frozen=True)
class MapRule:
    """From relevancy maps, one per level, to a mask and a peak."""

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
    """From the picture of the selected Gaussians alone to a mask; no place is scored."""

    alpha: float = 0.7  # strictly above, else the pixel is black
    grey: int = 10  # of 255, strictly above belongs to the mask


@dataclass(frozen=True)
class OwnRule:
    """From the engine's own answer to a mask and a peak (see `own_rule.own_prediction`)."""

    share: float = 0.5  # of a pixel's light that comes from members, strictly above
    peak_window: int = 20  # px of a picture of `rows` rows, as the paper's; in proportion for others
    rows: int = 731


@dataclass(frozen=True)
class Profile:
    """A protocol on one benchmark."""

    name: str
    source: str  # what pins the constants, and what had to be filled in
    rule: MapRule | SilhouetteRule | OwnRule
    max_rows: int = 1080  # higher pictures are scored at this height, as LangSplat's loader shrinks them


_CODE = MapRule(30, 0.5, "mirror", "peak", True, 0.7, "clipped", 7, 30, True)
_LERF_PAPER = MapRule(20, 0.0, "mirror", "peak", True, 0.7, "none", 1, 20, False)
_OVS_PAPER = MapRule(1, 1.0, "mirror", "inside", False, 0.4, "none", 1, 20, False)
_DIRECT = Profile(
    "direct-3d",
    "OpenGaussian's protocol: Gaussians are selected by the phrase, drawn alone, and the picture is cut; of "
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
            "LangSplatV2's public evaluator: 29x29 mean of what lies inside the picture, the same blend and "
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
