"""Label maps of patches and nodes: what each pixel of a photograph shows of them."""

from collections.abc import Sequence

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.raster.protocol import LiftingView
from langsplat_core.raster.reference import project
from langsplat_core.scene import Camera, Gaussians

SOLID = 0.5  # of a pixel: where the Gaussians cover less, there is nothing
CELL = 8  # pixels a side, in which patches of one channel keep apart


def draw_patches(view: LiftingView, gaussians: Gaussians, patches: Array) -> Array:
    """Return the (H, W) int32 patch that most of each pixel is, -1 for none.

    patches: (N,) int32 of the Gaussians, -1 for those of none. Patches whose boxes in the image do not meet
    share a channel, so that thousands take some dozen.
    """
    inside = patches >= 0
    if not inside.any():
        return np.full((view.camera.height, view.camera.width), -1, np.int32)
    shown = np.bincount(patches[inside], view.contributions()[inside]) >= 1  # pixel
    channel_of, owners = _share_channels(_boxes(view.camera, gaussians, patches, len(shown)), shown)
    channels, view = np.where(inside, channel_of[patches], -1), view.frozen()
    most = np.zeros((view.camera.height, view.camera.width), np.float32)
    drawn = np.full(most.shape, -1, np.int32)
    rows, columns = np.indices(most.shape) // CELL
    for some in np.split(np.arange(len(owners)), np.arange(32, len(owners), 32)):
        image, alpha = view.splat((channels[:, None] == some).astype(np.float32))
        best = image.max(-1)
        more = (best > most) & (alpha > SOLID)
        drawn[more] = owners[some[image.argmax(-1)[more]], rows[more], columns[more]]
        most = np.where(more, best, most)
    return drawn


def _boxes(camera: Camera, gaussians: Gaussians, patches: Array, count: int) -> Array:
    """(P, 4) left, top, right, bottom cell of everything that a patch may paint, the last two exclusive."""
    footprints = project(gaussians, camera)
    drawn = np.flatnonzero((patches >= 0) & (footprints.opacities > 0))
    low, high = np.full((count, 2), np.inf), np.full((count, 2), -np.inf)
    np.minimum.at(low, patches[drawn], footprints.means_px[drawn] - footprints.extents_px[drawn] - 1)
    np.maximum.at(high, patches[drawn], footprints.means_px[drawn] + footprints.extents_px[drawn] + 1)
    size = camera.width, camera.height
    boxes = np.concatenate([np.clip(low, 0, size) // CELL, -(-np.clip(high, 0, size) // CELL)], 1)
    return np.asarray(boxes.astype(np.int64))


def _share_channels(boxes: Array, shown: Array) -> tuple[Array, Array]:
    """Return the (P,) channel of each patch, -1 for those not shown, and what channels show.

    (C, rows, columns) int32: the patch that each cell of a channel belongs to. The largest boxes choose
    first.
    """
    channel_of = np.full(len(boxes), -1)
    owners: list[Array] = []
    rows, columns = (int(boxes[:, side].max(initial=0)) for side in (3, 2))
    areas = (boxes[:, 2] - boxes[:, 0]) * (boxes[:, 3] - boxes[:, 1])
    seen = np.flatnonzero(shown & (boxes[:, :2] < boxes[:, 2:]).all(1))
    for patch in seen[np.argsort(-areas[seen], kind="stable")]:
        left, top, right, bottom = boxes[patch]
        place = np.s_[top:bottom, left:right]
        free = (number for number, owner in enumerate(owners) if owner[place].max() < 0)
        channel_of[patch] = channel = next(free, len(owners))
        if channel == len(owners):
            owners.append(np.full((rows, columns), -1, np.int32))
        owners[channel][place] = patch
    return channel_of, np.array(owners, np.int32).reshape(-1, rows, columns)


def nested_maps(drawn: Array, cuts: Sequence[Array], least: float) -> Array:
    """Return label maps (3, H, W) int32, as of `masks.label_maps`, of the nodes of patches.

    drawn: (H, W) int32 patches, -1 for none; cuts: of each level, the (P,) int32 node of each patch; least:
    share of the image below which a node is left out.
    """
    maps = np.full((len(cuts), *drawn.shape), -1, np.int32)
    first, there = 0, drawn >= 0
    for level, nodes in zip(maps, cuts, strict=True):
        found = nodes[drawn[there]]
        kept = np.flatnonzero(np.bincount(found) >= max(least * drawn.size, 1))
        rows = np.full(int(nodes.max(initial=-1)) + 1, -1, np.int32)
        rows[kept] = np.arange(first, first + len(kept))
        level[there] = rows[found]
        first += len(kept)
    return maps
