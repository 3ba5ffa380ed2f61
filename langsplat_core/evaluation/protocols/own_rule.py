"""How this program's own answer becomes a mask and a place in a view: the one place to change it."""

import numpy as np

from langsplat_core.config import PictureConfig
from langsplat_core.evaluation.protocols.profiles import OwnRule
from langsplat_core.evaluation.protocols.reading import Prediction
from langsplat_core.query.answers import QueryResult
from langsplat_core.query.pixels import splatted_relevancy
from langsplat_core.query.places import peak_pixel
from langsplat_core.raster.protocol import View


def own_prediction(view: View, result: QueryResult, rule: OwnRule) -> Prediction:
    """The mask is what shows mostly members of the answer (hidden ones do not count), the place is the peak
    of the filtered map of the answer's level. Nothing of either where the verdict is "not here"."""
    values = np.stack([result.members, result.relevancy[result.level]], 1).astype(np.float32)
    drawn = splatted_relevancy(view, values, PictureConfig().alpha_gate)
    if not result.found:
        return Prediction(np.zeros(drawn.shape[:2], bool), result.level)
    column, row, _ = peak_pixel(drawn[..., 1], round(rule.peak_window * len(drawn) / rule.rows))
    return Prediction(drawn[..., 0] > rule.share, result.level, np.array([[column, row]]))
