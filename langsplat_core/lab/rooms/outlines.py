"""Masks as polygons through the centres of their outermost pixels, as an annotator's tool keeps them."""

import numpy as np
from scipy.ndimage import binary_fill_holes, find_objects
from scipy.ndimage import label as connected

from langsplat_core.arrays import Array

EDGE = 0.999  # height at which a mask's edge is traced: within a thousandth of the centres of its own pixels
PIECES = np.ones((3, 3), int)


def outlines(mask: Array) -> list[Array]:
    """(H, W) bool -> polygons, (K, 2) int x, y each, K >= 3, which filled, border included, give the mask.

    A piece with a hole is cut through it into pieces without one.
    """
    found = []
    pieces, _ = connected(mask, PIECES)
    for number, part in enumerate(find_objects(pieces), 1):
        piece = pieces[part] == number
        corner = np.array([part[1].start, part[0].start])
        holes = binary_fill_holes(piece) & ~piece
        if holes.any():
            column = int(np.flatnonzero(holes.any(0))[0])
            left, right = piece.copy(), piece.copy()
            left[:, column + 1 :], right[:, : column + 1] = False, False
            found += [polygon + corner for polygon in outlines(left) + outlines(right)]
        else:
            found.append(_trace(piece) + corner)
    return found


def _trace(piece: Array) -> Array:
    """(K, 2) the border of one piece without holes, pixel by pixel."""
    from skimage.measure import find_contours

    contours = find_contours(np.pad(piece.astype(float), 1), EDGE, fully_connected="high")
    longest = max(contours, key=len)
    corners = np.rint(longest - 1).astype(int)[:, ::-1]
    corners = corners[np.r_[True, (np.diff(corners, axis=0) != 0).any(1)]]
    return np.concatenate([corners, np.repeat(corners[-1:], max(0, 3 - len(corners)), 0)])
