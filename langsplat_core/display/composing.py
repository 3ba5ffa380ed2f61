"""`displays.compose` compiled, for machines whose OpenGL is software: there the shader takes longer than the
rasterizer. One pass over the pixels, float32, on all cores."""

from typing import Any

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
    "rgb": PLAIN,
    "latent": SUMS,
    "tree": SUMS,
    "depth": DEPTH,
    "alpha": ALPHA,
    "relevancy": HEAT,
    "segmentation": SEGMENTS,
}
# Places in the numbers that a kernel is given.
THRESHOLD, GATE, DIM, HEAT_OPACITY, BACKDROP = range(5)
LIMITS = BACKDROP + 3
TINTS = LIMITS + 2 * MAX_QUERIES
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
    backdrop = np.zeros(3) if picture.transparent else np.asarray(picture.background)
    gates = np.array([picture.threshold, picture.alpha_gate, picture.dim, picture.heat_opacity])
    limits = np.array(full_ranges(ranges, MAX_QUERIES))
    looks = np.concatenate([gates, backdrop, limits.ravel(), QUERY_COLOURS.ravel()]).astype(np.float32)
    table = _TABLES[picture.colour_map]
    flags = way, picture.transparent, picture.own_colours
    arrays = (np.asarray(a, np.float32) for a in (channels.rgb, channels.alpha, extra))
    shared_workers().run(_rows, height, image, *arrays, *flags, looks, table)
    return image


@helper
def _clip(value: Any) -> Any:
    return min(max(value, np.float32(0)), np.float32(1))


@helper
def _map(shown: Array, t: Any, table: Array) -> None:
    position = _clip(t) * np.float32(NODES - 1)
    low = min(int(position), NODES - 2)
    part = position - np.float32(low)
    for k in range(3):
        shown[k] = table[low, k] * (1 - part) + table[low + 1, k] * part


@helper
def _heat(shown: Array, base: Array, mean: Array, own_colours: bool, looks: Array, table: Array) -> None:
    heat = total = red = green = blue = np.float32(0)
    for j in range(len(mean)):
        low, high, tint = looks[LIMITS + 2 * j], looks[LIMITS + 2 * j + 1], TINTS + 3 * j
        own = _clip((mean[j] - low) / (high - low))
        heat, total = max(heat, own), total + own
        red, green, blue = (
            red + own * looks[tint],
            green + own * looks[tint + 1],
            blue + own * looks[tint + 2],
        )
    if own_colours:
        share = 1 / max(total, np.float32(1e-9))
        shown[0], shown[1], shown[2] = red * share, green * share, blue * share
    else:
        _map(shown, heat, table)
    fade = heat if own_colours else _clip(heat / np.float32(HEAT_FADE))
    mix = looks[HEAT_OPACITY] * fade * fade * (3 - 2 * fade)  # smoothstep
    for k in range(3):
        shown[k] = base[k] * looks[DIM] * (1 - mix) + shown[k] * mix


@helper
def _segment(shown: Array, base: Array, mean: Array, looks: Array) -> None:
    winner = 0
    for j in range(1, len(mean)):
        if mean[j] > mean[winner]:
            winner = j
    low, high = looks[LIMITS + 2 * winner], looks[LIMITS + 2 * winner + 1]
    opacity = np.float32(SEGMENT_OPACITY) * _clip((1 - low) / (high - low))
    inside = mean[winner] > looks[THRESHOLD]
    for k in range(3):
        mixed = base[k] * (1 - opacity) + looks[TINTS + 3 * winner + k] * opacity
        shown[k] = mixed if inside else base[k] * looks[DIM]


@kernel
def _rows(
    first: int,
    last: int,
    image: Array,
    rgb: Array,
    alphas: Array,
    extra: Array,
    way: int,
    transparent: bool,
    own_colours: bool,
    looks: Array,
    table: Array,
) -> None:
    height, width = alphas.shape
    shown, base = np.empty(3, np.float32), np.empty(3, np.float32)
    values = np.empty(extra.shape[2], np.float32)
    for y in range(first, last):
        for x in range(width):
            alpha = alphas[y, x]
            is_open = alpha > looks[GATE]
            scale = 1 / alpha if is_open else np.float32(0)
            share = 1 / max(alpha, np.float32(LEAST_ALPHA)) if transparent else np.float32(1)
            for k in range(3):
                own = extra[y, x, k] if way == SUMS else rgb[y, x, k]
                base[k] = alpha if way == ALPHA else _clip(own * share + (1 - alpha) * looks[BACKDROP + k])
                shown[k] = base[k]
            for k in range(len(values)):
                values[k] = extra[y, x, k] * scale
            opacity = np.float32(1) if way == ALPHA or not transparent else alpha
            if way == HEAT:
                _heat(shown, base, values, own_colours, looks, table)
            elif way == SEGMENTS:
                _segment(shown, base, values, looks)
            elif way == DEPTH:
                near, far = looks[LIMITS], looks[LIMITS + 1]
                _map(shown, 1 - _clip((values[0] - near) / max(far - near, np.float32(1e-9))), table)
                opacity = np.float32(is_open or not transparent)
                for k in range(3):
                    shown[k] = shown[k] if is_open else looks[BACKDROP + k]
            for k in range(3):
                image[height - 1 - y, x, k] = np.uint8(np.float32(255) * _clip(shown[k]) + np.float32(0.5))
            image[height - 1 - y, x, 3] = np.uint8(np.float32(255) * opacity + np.float32(0.5))
