"""The suppression of masks in plain loops, one pair at a time."""

import numpy as np

from langsplat_core.config import MaskConfig


def plain_mask_nms(masks: np.ndarray, scores: np.ndarray, config: MaskConfig) -> list[int]:
    """The rule of LangSplat's preprocessing, one pair at a time."""
    kept = []
    for i, mask in enumerate(masks):
        good = scores[i] > config.nms_score
        for j, other in enumerate(masks):
            if i == j:
                continue
            both = (mask & other).sum()
            if scores[j] > scores[i] and both / (mask | other).sum() > config.nms_iou:
                good = False
            mine, its = both / mask.sum(), both / other.sum()
            if mine >= 0.85 and its < 0.5 and 1 - mine * its > config.nms_inner:
                good = False
        if good:
            kept.append(i)
    return kept


def plain_box_nms(boxes: np.ndarray, scores: np.ndarray, limit: float) -> list[int]:
    kept: list[int] = []
    for i in sorted(range(len(boxes)), key=lambda k: (-scores[k], k)):
        a = np.zeros((100, 100), bool)
        a[boxes[i][1] : boxes[i][3], boxes[i][0] : boxes[i][2]] = True
        for j in kept:
            b = np.zeros((100, 100), bool)
            b[boxes[j][1] : boxes[j][3], boxes[j][0] : boxes[j][2]] = True
            if (a & b).sum() / (a | b).sum() > limit:
                break
        else:
            kept.append(i)
    return kept
