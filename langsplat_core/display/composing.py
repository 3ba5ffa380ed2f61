"""`displays.compose` compiled: an image of bytes from channels, for machines whose OpenGL is software, where the
shader takes longer than the rasterizer. One pass over the pixels, float32, on all cores."""

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.compiled import helper, kernel, shared_workers
from langsplat_core.config import PictureConfig
from langsplat_core.display.displays import (
    COLOUR_MAPS,
    DISPLAYS,
    HEAT_FADE,
    LEAST_ALPHA,
    MAX_QUERIES,
    NODES,
    QUERY_COLOURS,
    SEGMENT_OPACITY,
    Channels,
    Ranges,
    full_ranges,
)

PLAIN, SUMS, DEPTH, ALPHA, HEAT, SEGMENTS = range(6)  # ways to draw a pixel
WAYS = {
    **{"rgb": PLAIN, "latent": SUMS, "tree": SUMS, "depth": DEPTH, "alpha": ALPHA},
    **{"relevancy": HEAT, "segmentation": SEGMENTS},
}
_TABLES = {name: np.ascontiguousarray(table / np.float32(255)) for name, table in COLOUR_MAPS.items()}


def composed(channels: Channels, picture: PictureConfig, ranges: Ranges = ()) -> Array:
    """(H, W, 4) uint8, row 0 at the bottom as OpenGL has it: what `compose` draws, within one step; opaque
    unless the picture is transparent."""
    way = WAYS[picture.display]
    if channels.extra is None and DISPLAYS[picture.display].channel is not None:
        way = PLAIN
    extra = channels.rgb if channels.extra is None else channels.extra
    height, width = channels.alpha.shape
    image = np.empty((height, width, 4), np.uint8)
    numbers = np.array(
        [picture.heat_opacity, picture.dim, picture.threshold, picture.alpha_gate, *picture.background],
        np.float32,
    )
    limits = np.array(full_ranges(ranges, MAX_QUERIES), np.float32)
    flags = (picture.transparent, picture.own_colours)
    tables = _TABLES[picture.colour_map], QUERY_COLOURS.astype(np.float32)
    arrays = (np.asarray(a, np.float32) for a in (channels.rgb, channels.alpha, extra))
    shared_workers().run(_rows, height, image, *arrays, way, numbers, limits, *flags, *tables)
    return image


@helper
def _clip(value: float) -> float:
    return min(max(value, np.float32(0)), np.float32(1))


@helper
def _mapped(table: Array, t: float, k: int) -> float:
    position = _clip(t) * np.float32(NODES - 1)
    low = min(int(position), NODES - 2)
    part = position - np.float32(low)
    return table[low, k] * (1 - part) + table[low + 1, k] * part


@kernel
def _rows(
    first: int,
    last: int,
    image: Array,
    rgb: Array,
    alphas: Array,
    extra: Array,
    way: int,
    numbers: Array,
    limits: Array,
    transparent: bool,
    own_colours: bool,
    table: Array,
    tints: Array,
) -> None:
    height, width, count = alphas.shape[0], alphas.shape[1], extra.shape[2]
    heat_opacity, dim, threshold, gate = numbers[0], numbers[1], numbers[2], numbers[3]
    shown = np.empty(4, np.float32)
    heats = np.zeros(MAX_QUERIES, np.float32)
    for y in range(first, last):
        for x in range(width):
            alpha = alphas[y, x]
            uncovered = np.float32(0) if transparent else 1 - alpha
            share = max(alpha, np.float32(LEAST_ALPHA)) if transparent else np.float32(1)
            scale = 1 / alpha if alpha > gate else np.float32(0)
            shown[3] = alpha
            if way == SUMS:
                for k in range(3):
                    shown[k] = extra[y, x, k] / share + uncovered * numbers[4 + k]
            elif way == DEPTH:
                near, far = limits[0, 0], limits[0, 1]
                t = _clip((extra[y, x, 0] * scale - near) / max(far - near, np.float32(1e-9)))
                shown[3] = np.float32(alpha > gate)
                for k in range(3):
                    back = np.float32(0) if transparent else numbers[4 + k]
                    shown[k] = _mapped(table, 1 - t, k) if alpha > gate else back
            elif way == ALPHA:
                shown[:3] = alpha
                shown[3] = np.float32(1)
            else:
                for k in range(3):
                    shown[k] = _clip(rgb[y, x, k] / share + uncovered * numbers[4 + k])
            if way == HEAT:
                heat, total = np.float32(0), np.float32(0)
                for j in range(count):
                    low, high = limits[j, 0], limits[j, 1]
                    heats[j] = _clip((extra[y, x, j] * scale - low) / (high - low))
                    heat, total = max(heat, heats[j]), total + heats[j]
                fade = heat if own_colours else _clip(heat / np.float32(HEAT_FADE))
                mix = heat_opacity * fade * fade * (3 - 2 * fade)  # smoothstep
                for k in range(3):
                    hot = np.float32(0)
                    if not own_colours:
                        hot = _mapped(table, heat, k)
                    else:
                        for j in range(count):
                            hot += heats[j] * tints[j, k]
                        hot /= max(total, np.float32(1e-9))
                    shown[k] = shown[k] * dim * (1 - mix) + hot * mix
            elif way == SEGMENTS:
                winner = 0
                for j in range(1, count):
                    if extra[y, x, j] > extra[y, x, winner]:
                        winner = j
                low, high = limits[winner, 0], limits[winner, 1]
                opacity = np.float32(SEGMENT_OPACITY) * _clip((1 - low) / (high - low))
                inside = extra[y, x, winner] * scale > threshold
                for k in range(3):
                    mixed = shown[k] * (1 - opacity) + tints[winner, k] * opacity
                    shown[k] = mixed if inside else shown[k] * dim
            for k in range(3):
                image[height - 1 - y, x, k] = np.uint8(np.float32(255) * _clip(shown[k]) + np.float32(0.5))
            opacity_out = _clip(shown[3]) if transparent else np.float32(1)
            image[height - 1 - y, x, 3] = np.uint8(np.float32(255) * opacity_out + np.float32(0.5))
