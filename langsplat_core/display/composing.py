"""`displays.compose` compiled, for machines whose OpenGL is software: there the shader takes longer than the
rasterizer. One pass over the pixels, float32, on all cores."""

from typing import Any, NamedTuple

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
_TABLES = {name: np.ascontiguousarray(table / np.float32(255)) for name, table in COLOUR_MAPS.items()}


class Look(NamedTuple):
    """How pixels are drawn: a picture's settings as a kernel takes them, all numbers float32."""

    way: int  # one of `WAYS`
    transparent: bool
    own_colours: bool
    threshold: Any
    gate: Any
    dim: Any
    heat_opacity: Any
    backdrop: Array  # (3,)
    limits: Array  # (MAX_QUERIES, 2) values drawn as 0 and as 1
    tints: Array  # (MAX_QUERIES, 3)
    table: Array  # (NODES, 3) the colour map


class Planes(NamedTuple):
    """The channels of an image as a kernel takes them, float32."""

    rgb: Array  # (H, W, 3)
    alpha: Array  # (H, W)
    extra: Array  # (H, W, C)


def composed(channels: Channels, picture: PictureConfig, ranges: Ranges = ()) -> Array:
    """(H, W, 4) uint8, row 0 at the bottom as OpenGL has it: what `compose` draws, within one step; opaque
    unless the picture is transparent."""
    extra = channels.rgb if channels.extra is None else channels.extra
    planes = Planes(*(np.asarray(plane, np.float32) for plane in (channels.rgb, channels.alpha, extra)))
    height, width = channels.alpha.shape
    image = np.empty((height, width, 4), np.uint8)
    shared_workers().run(_rows, height, image, planes, _look(channels, picture, ranges))
    return image


def _look(channels: Channels, picture: PictureConfig, ranges: Ranges) -> Look:
    is_plain = channels.extra is None and DISPLAYS[picture.display].channel is not None
    return Look(
        way=PLAIN if is_plain else WAYS[picture.display],
        transparent=picture.transparent,
        own_colours=picture.own_colours,
        threshold=np.float32(picture.threshold),
        gate=np.float32(picture.alpha_gate),
        dim=np.float32(picture.dim),
        heat_opacity=np.float32(picture.heat_opacity),
        backdrop=np.asarray((0, 0, 0) if picture.transparent else picture.background, np.float32),
        limits=np.array(full_ranges(ranges, MAX_QUERIES), np.float32).reshape(MAX_QUERIES, 2),
        tints=np.asarray(QUERY_COLOURS, np.float32),
        table=_TABLES[picture.colour_map],
    )


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
def _heat(shown: Array, base: Array, mean: Array, look: Look) -> None:
    heat = total = red = green = blue = np.float32(0)
    for j in range(len(mean)):
        low, high, tint = look.limits[j, 0], look.limits[j, 1], look.tints[j]
        own = _clip((mean[j] - low) / (high - low))
        heat, total = max(heat, own), total + own
        red, green, blue = red + own * tint[0], green + own * tint[1], blue + own * tint[2]
    if look.own_colours:
        share = 1 / max(total, np.float32(1e-9))
        shown[0], shown[1], shown[2] = red * share, green * share, blue * share
    else:
        _map(shown, heat, look.table)
    fade = heat if look.own_colours else _clip(heat / np.float32(HEAT_FADE))
    mix = look.heat_opacity * fade * fade * (3 - 2 * fade)  # smoothstep
    for k in range(3):
        shown[k] = base[k] * look.dim * (1 - mix) + shown[k] * mix


@helper
def _segment(shown: Array, base: Array, mean: Array, look: Look) -> None:
    winner = 0
    for j in range(1, len(mean)):
        if mean[j] > mean[winner]:
            winner = j
    low, high = look.limits[winner, 0], look.limits[winner, 1]
    opacity = np.float32(SEGMENT_OPACITY) * _clip((1 - low) / (high - low))
    inside = mean[winner] > look.threshold
    for k in range(3):
        mixed = base[k] * (1 - opacity) + look.tints[winner, k] * opacity
        shown[k] = mixed if inside else base[k] * look.dim


@helper
def _depth(shown: Array, depth: Any, is_open: bool, look: Look) -> None:
    near, far = look.limits[0, 0], look.limits[0, 1]
    _map(shown, 1 - _clip((depth - near) / max(far - near, np.float32(1e-9))), look.table)
    for k in range(3):
        shown[k] = shown[k] if is_open else look.backdrop[k]


@kernel
def _rows(first: int, last: int, image: Array, planes: Planes, look: Look) -> None:
    """Compose rows [first, last) of the planes, row 0 on top, into `image`."""
    height, width = planes.alpha.shape
    shown, base = np.empty(3, np.float32), np.empty(3, np.float32)
    values = np.empty(planes.extra.shape[2], np.float32)
    for y in range(first, last):
        for x in range(width):
            alpha = planes.alpha[y, x]
            is_open = alpha > look.gate
            scale = 1 / alpha if is_open else np.float32(0)
            share = 1 / max(alpha, np.float32(LEAST_ALPHA)) if look.transparent else np.float32(1)
            for k in range(3):
                own = planes.extra[y, x, k] if look.way == SUMS else planes.rgb[y, x, k]
                mixed = _clip(own * share + (1 - alpha) * look.backdrop[k])
                base[k] = alpha if look.way == ALPHA else mixed
                shown[k] = base[k]
            for k in range(len(values)):
                values[k] = planes.extra[y, x, k] * scale
            opacity = np.float32(1) if look.way == ALPHA or not look.transparent else alpha
            if look.way == HEAT:
                _heat(shown, base, values, look)
            elif look.way == SEGMENTS:
                _segment(shown, base, values, look)
            elif look.way == DEPTH:
                _depth(shown, values[0], is_open, look)
                opacity = np.float32(is_open or not look.transparent)
            for k in range(3):
                image[height - 1 - y, x, k] = np.uint8(np.float32(255) * _clip(shown[k]) + np.float32(0.5))
            image[height - 1 - y, x, 3] = np.uint8(np.float32(255) * opacity + np.float32(0.5))
