"""The crops that SAM sees beside the whole picture, and what becomes of the masks that they give."""

import numpy as np
import pytest
import torch

from langsplat_core.config import MaskConfig
from langsplat_core.progress import Progress, silent
from langsplat_core.semantics.sam import SamMasks, crop_boxes, cut_by_crop

pytestmark = pytest.mark.long


def test_crops_are_those_of_the_public_code() -> None:
    # overlap int(1080 * 512 / 1500) = 368; width (1440 + 368) / 2 = 904, height (1080 + 368) / 2 = 724
    corners = [(0, 0), (0, 356), (536, 0), (536, 356)]
    want = [(0, 0, 1440, 1080), *((x, y, x + 904, y + 724) for x, y in corners)]
    assert crop_boxes((1080, 1440), 1).tolist() == [list(box) for box in want]
    assert crop_boxes((1080, 1440), 0).tolist() == [[0, 0, 1440, 1080]]
    assert len(crop_boxes((1080, 1440), 2)) == 1 + 4 + 16
    for shape in [(1, 1), (1, 70), (7, 3)]:
        boxes = crop_boxes(shape, 2)
        assert (boxes[:, :2] < boxes[:, 2:]).all()
        assert boxes.max(axis=0).tolist() == [*boxes[:, :2].max(axis=0), shape[1], shape[0]]


def test_a_mask_that_goes_on_outside_its_crop_is_not_taken() -> None:
    crop, shape = np.array([0, 0, 904, 724]), (1080, 1440)
    assert not cut_by_crop(np.array([30, 30, 500, 500]), crop, shape)
    assert not cut_by_crop(np.array([0, 0, 500, 500]), crop, shape)  # the picture itself ends there
    assert cut_by_crop(np.array([30, 30, 890, 500]), crop, shape)
    assert not cut_by_crop(np.array([0, 0, 1440, 1080]), np.array([0, 0, 1440, 1080]), shape)


class Blind:
    """Stands in for a SAM that overlooks small things in large pictures: a mask is what has one colour."""

    name = "blind"

    def look(self, image: np.ndarray) -> "Seen":
        return Seen(image[..., 0])


class Seen:
    def __init__(self, colours: np.ndarray) -> None:
        self.colours = colours
        self.from_afar = colours.size >= 200 * 200

    def ask(self, points: np.ndarray) -> tuple[torch.Tensor, torch.Tensor]:
        masks = [self.mask(self.colours[int(y), int(x)]) for x, y in points]
        logits = torch.from_numpy(np.stack(masks) * 20.0 - 10)[:, None].repeat(1, 3, 1, 1)
        scores = torch.zeros(len(points), 3)
        scores[:, 0] = torch.tensor([(0.95 if self.from_afar else 0.9) * mask.any() for mask in masks])
        return scores, logits

    def mask(self, colour: int) -> np.ndarray:
        mask = (self.colours == colour) & (colour > 0)
        if self.from_afar:
            return mask & (mask.sum() >= 400)
        rows, columns = np.nonzero(mask)
        if len(rows):  # by this the mask of a crop can be told from that of the whole picture
            mask[int(rows.mean()), int(columns.mean())] = False
        return mask

    def enlarge(self, logits: torch.Tensor) -> torch.Tensor:
        return logits


def test_crops_find_small_things_and_win_where_both_see_a_thing_whole() -> None:
    image = np.zeros((200, 200, 3), np.uint8)  # crops of 134 px begin at 0 and 66
    small, across, both = np.s_[30:40, 30:40], np.s_[70:130, 70:130], np.s_[25:65, 140:180]
    for colour, place in enumerate((small, across, both), start=1):
        image[place] = colour
    config = MaskConfig(points_per_side=16, predicted_iou=0.5, min_region=0)
    alone = SamMasks(Blind(), config)(image, silent).masks[0]
    assert sorted(mask.sum() for mask in alone) == [1600, 3600]
    with_crops = SamMasks(
        Blind(), MaskConfig(points_per_side=16, predicted_iou=0.5, min_region=0, crop_layers=1)
    )
    found = with_crops(image, silent)
    assert sorted(mask.sum() for mask in found.masks[0]) == [99, 1599, 3600]
    for mask in found.masks[0]:
        assert len(np.unique(image[..., 0][mask])) == 1  # in its place in the whole picture
    assert [len(masks) for masks in found.masks[1:]] == [0, 0]


def test_progress_runs_once_through_all_crops() -> None:
    seen: list[float] = []
    config = MaskConfig(points_per_side=4, points_per_batch=8, crop_layers=1)
    SamMasks(Blind(), config)(np.zeros((40, 40, 3), np.uint8), Progress(lambda at: seen.append(at.fraction)))
    assert seen == sorted(seen)
    assert (seen[0], seen[-1], len(seen)) == (0.0, 1.0, 5 * 2 + 1)
