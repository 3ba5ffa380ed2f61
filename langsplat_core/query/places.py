"""Where a phrase is: the strongest place among the Gaussians, its extent, and its pixel in a view."""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import uniform_filter

from langsplat_core.arrays import Array
from langsplat_core.query.surface import Surface

PLATEAU = 1e-3  # of relevancy: what is this close to the peak is as high


@dataclass(frozen=True, eq=False)
class Place:
    """A connected set of Gaussians that answer a phrase."""

    position: Array  # (3,) world units, around the middle of what is as high as the peak
    box: Array  # (2, 3) lower and upper corner, world units, between 2 % and 98 % of the members
    count: int  # Gaussians in it


def locate(surface: Surface, smoothed: Array, threshold: float) -> Place | None:
    """The connected part above `threshold` that holds the peak of `smoothed` (M,); None where all is 0."""
    if len(smoothed) == 0:
        return None
    peak = int(smoothed.argmax())
    if smoothed[peak] <= 0:
        return None
    inside = smoothed > threshold
    inside[peak] = True
    members = surface.connected(inside, peak)
    # All of a thing may mean the very same: then its middle is the place, not whichever comes first.
    highest = members[smoothed[members] >= smoothed[peak] - PLATEAU]
    centre = surface.positions[highest].mean(0)
    middle = highest[((surface.positions[highest] - centre) ** 2).sum(1).argmin()]
    near = surface.neighbours[middle]
    weights = surface.weights[near] * smoothed[near]
    position = (surface.positions[near] * weights[:, None]).sum(0) / weights.sum()
    box = np.quantile(surface.positions[members], [0.02, 0.98], axis=0)
    return Place(position, box, len(members))


def peak_pixel(relevancy: Array, window: int) -> tuple[int, int, float]:
    """Peak (column, row, value) of a relevancy map (H, W) after a mean filter of `window` px (paper: 20).

    The window never exceeds the picture; borders repeat the edge pixels.
    """
    window = max(1, min(window, *relevancy.shape))
    smooth = uniform_filter(np.asarray(relevancy, np.float64), size=window, mode="nearest")
    row, column = np.unravel_index(int(smooth.argmax()), smooth.shape)
    return int(column), int(row), float(smooth[row, column])
