"""Which of many proposed masks are kept: suppression by box and by pixels, and the removal of crumbs."""

import numpy as np
from scipy import ndimage

from langsplat_core.arrays import Array
from langsplat_core.config import MaskConfig

CONTAINED = 0.85  # of a mask's area inside another one: it counts as inside
DOMINATED = 0.5  # a mask that covers less than this of the one around it is small beside it
PIXELS_PER_PRODUCT = 1 << 16  # columns of the matrix product that counts common pixels
EIGHT = np.ones((3, 3), bool)  # diagonal neighbours are connected, as in SAM's own clean-up


def mask_boxes(masks: Array) -> Array:
    """(M, H, W) bool, none empty -> (M, 4) int64 left, top, right, bottom; the last two exclusive."""
    boxes = np.zeros((len(masks), 4), np.int64)
    for box, mask in zip(boxes, masks, strict=True):
        rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
        box[:] = columns[0], rows[0], columns[-1] + 1, rows[-1] + 1
    return boxes


def box_nms(boxes: Array, scores: Array, iou: float) -> Array:
    """Greedy non-maximum suppression: (K,) indices kept, by falling score; ties by index.

    boxes: (M, 4) left, top, right, bottom, non-empty; a box goes when its IoU with a kept one is > `iou`.
    """
    order = np.argsort(-scores, kind="stable")
    left, top, right, bottom = boxes.astype(float).T
    area = (right - left) * (bottom - top)
    kept = []
    while len(order):
        best, rest = order[0], order[1:]
        kept.append(int(best))
        width = np.minimum(right[best], right[rest]) - np.maximum(left[best], left[rest])
        height = np.minimum(bottom[best], bottom[rest]) - np.maximum(top[best], top[rest])
        common = np.maximum(width, 0) * np.maximum(height, 0)
        order = rest[common / (area[best] + area[rest] - common) <= iou]
    return np.array(kept, int)


def clean_regions(mask: Array, min_region: int) -> tuple[Array, bool]:
    """Fill holes below `min_region` px, then drop islands below it; the largest island always stays.

    mask: (H, W) bool, not empty. Returns the mask and whether anything changed. As SAM's
    `remove_small_regions`; only the surroundings of the mask are looked at, which changes nothing else.
    """
    (left, top, right, bottom), (height, width) = mask_boxes(mask[None])[0], mask.shape
    gaps = np.array([top * width, (height - bottom) * width, left * height, (width - right) * height])
    if ((gaps > 0) & (gaps < min_region)).any():  # what lies beyond the box may itself be a small hole
        window = np.s_[0:height, 0:width]
        gaps[:] = 0
    else:
        window = np.s_[max(top - 1, 0) : bottom + 1, max(left - 1, 0) : right + 1]
    cleaned = np.zeros_like(mask)
    cleaned[window] = _drop_islands(_fill_holes(mask[window], min_region, gaps > 0), min_region)
    return cleaned, not np.array_equal(cleaned, mask)


def _fill_holes(mask: Array, min_region: int, open_sides: Array) -> Array:
    """open_sides: (4,) bool top, bottom, left, right: whether the background goes on for long there."""
    holes, count = ndimage.label(~mask, EIGHT)
    small = np.bincount(holes.ravel(), minlength=count + 1) < min_region
    for side, is_open in zip((holes[0], holes[-1], holes[:, 0], holes[:, -1]), open_sides, strict=True):
        if is_open:
            small[side] = False
    small[0] = False  # the mask itself
    return mask | small[holes]


def _drop_islands(mask: Array, min_region: int) -> Array:
    islands, count = ndimage.label(mask, EIGHT)
    sizes = np.bincount(islands.ravel(), minlength=count + 1)
    keep = sizes >= min_region
    if not keep[1:].any():
        keep[1 + np.argmax(sizes[1:])] = True
    keep[0] = False
    return keep[islands]


def common_pixels(masks: Array) -> Array:
    """(M, H, W) bool -> (M, M) int64: pixels in both masks; areas on the diagonal."""
    flat = masks.reshape(len(masks), -1)
    total = np.zeros((len(masks), len(masks)), np.int64)
    for start in range(0, flat.shape[1], PIXELS_PER_PRODUCT):
        part = flat[:, start : start + PIXELS_PER_PRODUCT].astype(np.float32)
        total += (part @ part.T).astype(np.int64)  # exact: counts stay below 2**24
    return total


def mask_nms(masks: Array, scores: Array, config: MaskConfig) -> Array:
    """(K,) indices of the masks that stay, rising.

    masks: (M, H, W) bool, none empty; scores: (M,) stability times predicted IoU. A mask goes when its IoU
    with any higher-scored mask, gone or not, is > nms_iou; when its score is <= nms_score; or when it lies
    inside another mask, whatever the scores, so that 1 - (its share in both areas multiplied) > nms_inner.
    Source: `mask_nms` of LangSplat's preprocessing, with the thresholds that it passes.
    """
    common = common_pixels(masks)
    area = np.diag(common)
    order = np.argsort(-scores, kind="stable")
    rank = np.empty(len(scores), int)
    rank[order] = np.arange(len(scores))
    iou = common / np.maximum(area[:, None] + area[None] - common, 1)
    rival = (iou > config.nms_iou) & (rank[None] < rank[:, None])
    share = common / np.maximum(area[:, None], 1)  # of the row's mask that lies in the column's
    inside = (share >= CONTAINED) & (share.T < DOMINATED) & (1 - share * share.T > config.nms_inner)
    keep = (scores > config.nms_score) & ~rival.any(axis=1) & ~inside.any(axis=1)
    return np.flatnonzero(keep)
