"""From relevancy maps or pictures of selected Gaussians to a mask and a place, as a profile says.

Everything here is given maps and constants, never a label.
"""

from dataclasses import dataclass, field

import numpy as np
from scipy.ndimage import uniform_filter

from langsplat_core.arrays import Array
from langsplat_core.evaluation.protocols.profiles import Border, MapRule, SilhouetteRule, Vote

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
    """Of what exceeds the threshold; below every relevancy where nothing does."""
    inside = values[values > threshold]
    return float(inside.mean()) if len(inside) else -1.0


def mean_filtered(values: Array, window: int, border: Border) -> Array:
    """(H, W) means over `window` x `window` pixels; an even window reaches one pixel further up and left, as
    cv2's does."""
    if window <= 1:
        return values
    if border == "mirror":
        found: Array = uniform_filter(values, window, mode="mirror")
        return found
    total = uniform_filter(values, window, mode="constant")
    return total / uniform_filter(np.ones_like(values), window, mode="constant")


def voted(mask: Array, vote: Vote, window: int) -> Array:
    """(H, W) bool after a majority vote over `window` x `window` pixels inside the picture; a tie is False.

    "clipped": the picture's last row and column are never counted, as in LangSplat's code.
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
