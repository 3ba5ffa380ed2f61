"""Where a relevancy map is cut, so that what lies above is the answer's mask.

Absolute relevancy says little across encoders and phrases (a cosine margin of 0.1 is 0.73), so every rule
here is relative to something measured: the floor, the scene's median, or the map's own range.
"""

from typing import Literal, get_args

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.semantics.relevancy import FLOOR

CutRule = Literal["floor", "median", "range"]
CUT_RULES: tuple[CutRule, ...] = get_args(CutRule)
SPAN = 0.02  # the least distance between the lower end and the peak that is divided
RANGE_SHARE = 0.7  # of the map's range: LangSplat's code maps [0, 1] to [-1, 1] and cuts at 0.4


def cut_level(rule: CutRule, values: Array, peak: float, median: float) -> float:
    """The relevancy above which `values` belong to the answer.

    values: the map that is cut, any shape, in [0, 1], read by "range" alone; peak: the smoothed peak of the
    whole scene at the chosen level; median: of the scene's Gaussians at that level. Rules:

    * "floor": half way between the floor, no better than the canonical phrases, and the peak;
    * "median": half way between the scene's median and the peak, since what is typical of the scene is not
      what was asked for, wherever the encoder puts it;
    * "range": at 0.7 of the map's range, as the public code of LangSplat does; it always finds something.
    """
    if rule == "range":
        low, high = (float(values.min()), float(values.max())) if np.size(values) else (0.0, 1.0)
        return low + RANGE_SHARE * (high - low)
    low = FLOOR if rule == "floor" else median
    return low + 0.5 * max(peak - low, SPAN)
