"""Masks without any weights: superpixels, merged by colour and boundary into three nested partitions.

It knows nothing of objects. What it calls whole is what one paint or one material covers; SAM does better
wherever its weights can be had.
"""

import json

import numpy as np
from PIL import Image

from langsplat_core.arrays import Array
from langsplat_core.progress import Progress
from langsplat_core.semantics.masks import LevelMasks
from langsplat_core.semantics.region_graph import RegionGraph

VERSION = 1
WORK_SIDE = 400  # px, longer side at which regions are found; contrasts below are per pixel of it
SUPERPIXELS = 700
COMPACTNESS = 0.1  # of SLIC, whose colours are scaled to [0, 1]
SMOOTHING = 0.12  # total variation weight on L/100: removes carpet, keeps edges
TYPICAL = 66.0  # L + 16 at L = 50, so that chromaticities below are of the size of a and b
CHROMA_FALL = 0.045
MERGE_COSTS = (6.0, 11.0, 19.0)  # colour difference plus contrast; chosen on photographs and renderings
MIN_FRACTIONS = (0.0008, 0.002, 0.004)  # of the picture's area


class GraphMasks:
    """A `MaskSource` that needs no weights."""

    name = "graph (no weights)"

    @property
    def key(self) -> str:
        """See `MaskSource`."""
        return json.dumps(["graph", VERSION, WORK_SIDE, MERGE_COSTS, MIN_FRACTIONS])

    def __call__(self, image: Array, progress: Progress) -> LevelMasks:
        """Masks of an image (H, W, 3) uint8; at every level they cover each pixel exactly once."""
        progress("finding regions", 0.0)
        levels = nested_partitions(image)
        masks = [labels == np.arange(labels.max() + 1)[:, None, None] for labels in levels]
        progress("finding regions", 1.0)
        subpart, part, whole = (np.ones(len(stack), np.float32) for stack in masks)
        return LevelMasks((masks[0], masks[1], masks[2]), (subpart, part, whole))


def nested_partitions(image: Array) -> Array:
    """(3, H, W) int32 regions of an image (H, W, 3) uint8, numbered from 0 at each level; every region is
    a union of regions of the level before. Deterministic."""
    from skimage.color import rgb2lab
    from skimage.restoration import denoise_tv_chambolle

    height, width = image.shape[:2]
    scale = min(1.0, WORK_SIDE / max(height, width))
    size = max(1, round(width * scale)), max(1, round(height * scale))
    small = np.asarray(Image.fromarray(image).resize(size, Image.Resampling.BOX))
    lab = 100 * denoise_tv_chambolle(rgb2lab(small) / 100, SMOOTHING, max_num_iter=60, channel_axis=-1)
    graph = RegionGraph(_superpixels(lab), _paint(lab))
    levels = []
    for cost, min_fraction in zip(MERGE_COSTS, MIN_FRACTIONS, strict=True):
        graph.merge_until(cost, min_fraction)
        levels.append(graph.partition())
    rows = ((np.arange(height) + 0.5) * size[1] / height).astype(int)
    columns = ((np.arange(width) + 0.5) * size[0] / width).astype(int)
    return np.stack(levels)[:, rows[:, None], columns].astype(np.int32)


def _paint(lab: Array) -> Array:
    """(H, W, 3) CIELAB -> (H, W, 3) colours of which shading changes only the first channel, lightness.

    In CIELAB both a, b and L + 16 are differences of cube roots, so all three scale alike with the light
    that falls on a surface: a / (L + 16) and b / (L + 16) hardly depend on it. Large chromas are compressed,
    since the eye tells those apart less well (the factor 0.045 is that of CIE 94), and since in deep shade
    the cube roots of CIELAB turn into straight lines.
    """
    lightness = np.maximum(lab[..., :1], 0)
    chromaticity = lab[..., 1:] * TYPICAL / (lightness + 16)
    chroma = np.linalg.norm(chromaticity, axis=-1, keepdims=True)
    compressed = np.log1p(CHROMA_FALL * chroma) / np.maximum(CHROMA_FALL * chroma, 1e-9)
    return np.concatenate([lightness, chromaticity * np.where(chroma > 0, compressed, 1)], axis=-1)


def _superpixels(lab: Array) -> Array:
    """(H, W) int labels 0..N-1."""
    from skimage.segmentation import slic

    labels = slic(
        lab * np.array([0.6, 1, 1]),
        n_segments=min(SUPERPIXELS, lab.shape[0] * lab.shape[1]),
        compactness=COMPACTNESS,
        max_num_iter=8,
        start_label=0,
        convert2lab=False,
    )
    return np.unique(labels, return_inverse=True)[1].reshape(labels.shape)
