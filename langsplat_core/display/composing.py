"""Composition of images from channels on the CPU: compiled kernels in float32.

`compose.frag.glsl` does the same on a graphics device; software OpenGL takes longer than the rasterizer.
"""

from typing import Any, NamedTuple

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.compiled import helper, kernel, shared_workers
from langsplat_core.config import PictureConfig
from langsplat_core.display import displays
from langsplat_core.display.displays import Channels, Drawing

_TABLES = {
    name: np.ascontiguousarray(table / np.float32(255)) for name, table in displays.COLOUR_MAPS.items()
}
_LABS = {name: displays.oklab(table).astype(np.float32) for name, table in _TABLES.items()}


class Style(NamedTuple):
    """A picture's settings as a kernel takes them, all numbers float32."""

    drawing: int  # a `Drawing`
    transparent: bool
    own_colours: bool
    threshold: Any
    gate: Any
    dim: Any
    heat_opacity: Any
    backdrop: Array  # (3,)
    limits: Array  # (MAX_QUERIES, 2) values drawn as 0 and as 1
    tints: Array  # (MAX_QUERIES, 3)
    table: Array  # (NODES, 3) the colour map; for heat, table and tints are in OKLab


def compose(channels: Channels, picture: PictureConfig, ranges: displays.Ranges = ()) -> Array:
    """Return (H, W, 3) uint8 image; with `picture.transparent` (H, W, 4), its colours not premultiplied.

    A display whose further channel is absent shows the plain colours. `ranges`: see `full_ranges`.
    """
    image = compose_upwards(channels, picture, ranges)[::-1]
    return np.ascontiguousarray(image if picture.transparent else image[..., :3])


def compose_upwards(channels: Channels, picture: PictureConfig, ranges: displays.Ranges = ()) -> Array:
    """Compose (H, W, 4) uint8 as OpenGL has it: row 0 at the bottom, opaque by default."""
    extra = channels.alpha[..., None] if channels.extra is None else channels.extra
    planes = tuple(np.asarray(plane, np.float32) for plane in (channels.rgb, channels.alpha, extra))
    drawing = displays.drawing_of(picture.display, channels.extra is not None)
    hot = drawing is Drawing.HEAT
    style = Style(
        drawing=int(drawing),
        transparent=picture.transparent,
        own_colours=picture.own_colours,
        threshold=np.float32(picture.threshold),
        gate=np.float32(picture.alpha_gate),
        dim=np.float32(picture.dim),
        heat_opacity=np.float32(picture.heat_opacity),
        backdrop=np.asarray((0, 0, 0) if picture.transparent else picture.background, np.float32),
        limits=displays.full_ranges(ranges).astype(np.float32),
        tints=(displays.oklab(displays.QUERY_COLOURS) if hot else displays.QUERY_COLOURS).astype(np.float32),
        table=(_LABS if hot else _TABLES)[picture.colour_map],
    )
    height, width = channels.alpha.shape
    image = np.empty((height, width, 4), np.uint8)
    shared_workers().run(_rows, height, image, planes, style)
    # Separate passes: they read neighbouring pixels, which would slow the pass above down.
    if hot:
        mark = np.float32(displays.HEAT_EDGE), style.gate, np.ones(3, np.float32), np.float32(0)
        shared_workers().run(_mark, height, image, planes[2], planes[1], mark)
    if channels.selected is not None:
        selected, colour = np.asarray(channels.selected, np.float32), np.array(displays.SELECTED, np.float32)
        mark = style.threshold, style.gate, colour, np.float32(displays.SELECTED_OPACITY)
        shared_workers().run(_mark, height, image, selected, planes[1], mark)
    return image


@helper
def _clip(value: Any) -> Any:
    return min(max(value, np.float32(0)), np.float32(1))


@helper
def _map(shown: Array, t: Any, table: Array) -> None:
    position = _clip(t) * np.float32(displays.NODES - 1)
    low = min(int(position), displays.NODES - 2)
    part = position - np.float32(low)
    for k in range(3):
        shown[k] = table[low, k] * (1 - part) + table[low + 1, k] * part


@helper
def _shade(shown: Array, base: Array) -> None:
    """Turn a colour of OKLab into RGB, with most of the lightness of `base`: its luminance's cube root."""
    red, green, blue = base[0] * base[0], base[1] * base[1], base[2] * base[2]
    own = np.cbrt(np.float32(0.2126) * red + np.float32(0.7152) * green + np.float32(0.0722) * blue)
    lightness, a, b = own + np.float32(displays.HEAT_LIGHTNESS) * (shown[0] - own), shown[1], shown[2]
    long = lightness + np.float32(0.3963378) * a + np.float32(0.2158038) * b
    middle = lightness - np.float32(0.1055613) * a - np.float32(0.0638542) * b
    short = lightness - np.float32(0.0894842) * a - np.float32(1.2914855) * b
    long, middle, short = long * long * long, middle * middle * middle, short * short * short
    red = np.float32(4.0767417) * long - np.float32(3.3077116) * middle + np.float32(0.2309699) * short
    green = np.float32(-1.2684380) * long + np.float32(2.6097574) * middle - np.float32(0.3413194) * short
    blue = np.float32(-0.0041961) * long - np.float32(0.7034186) * middle + np.float32(1.7076147) * short
    shown[0], shown[1], shown[2] = np.sqrt(_clip(red)), np.sqrt(_clip(green)), np.sqrt(_clip(blue))


@helper
def _query_of(mean: Array, y: int, x: int, least: Any) -> int:
    """Return the query that a pixel shows.

    Queries with at least `least` alternate in stripes; else it is the query of largest magnitude.
    """
    count = found = 0
    for j in range(len(mean)):
        count += mean[j] >= least
        if abs(mean[j]) > abs(mean[found]):
            found = j
    left = (x + y) // displays.STRIPE_PX % count if count > 1 else -1
    for j in range(len(mean)):
        if mean[j] >= least:
            if left == 0:
                found = j
            left -= 1
    return found


@helper
def _heat(shown: Array, base: Array, mean: Array, y: int, x: int, style: Style) -> None:
    slot = _query_of(mean, y, x, np.float32(displays.HEAT_EDGE))
    value, low, high = mean[slot], style.limits[slot, 0], style.limits[slot, 1]
    heat = _clip((value - low) / (high - low))
    cover = _clip(
        heat / np.float32(displays.HEAT_FADE) if value < 0 else value / np.float32(displays.HEAT_BASE)
    )
    mix = style.heat_opacity * cover * cover * (3 - 2 * cover)  # smoothstep
    if style.own_colours:
        mix *= np.float32(0.5) + np.float32(0.5) * heat
        for k in range(3):
            shown[k] = style.tints[slot, k]
    if mix > 0:
        if not style.own_colours:
            _map(shown, heat, style.table)
        _shade(shown, base)
    for k in range(3):
        shown[k] = base[k] * style.dim * (1 - mix) + shown[k] * mix


@helper
def _segment(shown: Array, base: Array, mean: Array, y: int, x: int, style: Style) -> None:
    winner = _query_of(mean, y, x, style.threshold)
    low, high = style.limits[winner, 0], style.limits[winner, 1]
    opacity = np.float32(displays.SEGMENT_OPACITY) * _clip((1 - low) / (high - low))
    inside = mean[winner] > style.threshold
    for k in range(3):
        mixed = base[k] * (1 - opacity) + style.tints[winner, k] * opacity
        shown[k] = mixed if inside else base[k] * style.dim


@helper
def _depth(shown: Array, depth: Any, is_open: bool, style: Style) -> None:
    near, far = style.limits[0, 0], style.limits[0, 1]
    _map(shown, 1 - _clip((depth - near) / max(far - near, np.float32(1e-9))), style.table)
    for k in range(3):
        shown[k] = shown[k] if is_open else style.backdrop[k]


@kernel
def _rows(first: int, last: int, image: Array, planes: tuple[Array, Array, Array], style: Style) -> None:
    """Compose rows [first, last) of (H, W, 3) colours, (H, W) alpha and (H, W, C) values into `image`."""
    rgb, alphas, extra = planes
    height, width = alphas.shape
    shown, base = np.empty(3, np.float32), np.empty(3, np.float32)
    values = np.empty(extra.shape[2], np.float32)
    for y in range(first, last):
        for x in range(width):
            alpha = alphas[y, x]
            is_open = alpha > style.gate
            scale = 1 / alpha if is_open else np.float32(0)
            share = 1 / max(alpha, np.float32(displays.LEAST_ALPHA)) if style.transparent else np.float32(1)
            for k in range(3):
                own = extra[y, x, k] if style.drawing == Drawing.SUMS else rgb[y, x, k]
                mixed = _clip(own * share + (1 - alpha) * style.backdrop[k])
                base[k] = alpha if style.drawing == Drawing.ALPHA else mixed
                shown[k] = base[k]
            for k in range(len(values)):
                values[k] = extra[y, x, k] * scale
            opacity = np.float32(1) if style.drawing == Drawing.ALPHA or not style.transparent else alpha
            if style.drawing == Drawing.HEAT:
                _heat(shown, base, values, y, x, style)
            elif style.drawing == Drawing.SEGMENTS:
                _segment(shown, base, values, y, x, style)
            elif style.drawing == Drawing.DEPTH:
                _depth(shown, values[0], is_open, style)
                opacity = np.float32(is_open or not style.transparent)
            for k in range(3):
                image[height - 1 - y, x, k] = np.uint8(np.float32(255) * _clip(shown[k]) + np.float32(0.5))
            image[height - 1 - y, x, 3] = np.uint8(np.float32(255) * opacity + np.float32(0.5))


@helper
def _inside(layer: Array, alphas: Array, y: int, x: int, slot: int, least: Any, gate: Any) -> bool:
    alpha = alphas[y, x]
    return bool(alpha > gate and layer[y, x, slot] >= least * alpha)


@helper
def _on_edge(layer: Array, alphas: Array, y: int, x: int, least: Any, gate: Any) -> bool:
    """Return True for a pixel where some component is at least `least`, near one where it is not."""
    for slot in range(layer.shape[2]):
        if not _inside(layer, alphas, y, x, slot, least, gate):
            continue
        above, below = max(y - displays.EDGE_PX, 0), min(y + displays.EDGE_PX, len(alphas) - 1)
        left, right = max(x - displays.EDGE_PX, 0), min(x + displays.EDGE_PX, alphas.shape[1] - 1)
        if not (
            _inside(layer, alphas, above, x, slot, least, gate)
            and _inside(layer, alphas, below, x, slot, least, gate)
            and _inside(layer, alphas, y, left, slot, least, gate)
            and _inside(layer, alphas, y, right, slot, least, gate)
        ):
            return True
    return False


@kernel
def _mark(
    first: int, last: int, image: Array, layer: Array, alphas: Array, mark: tuple[Any, Any, Array, Any]
) -> None:
    """Tint and outline, in rows [first, last), the pixels where a layer (H, W, C) is at least mark[0]."""
    least, gate, colour, opacity = mark
    height, width = alphas.shape
    for y in range(first, last):
        for x in range(width):
            mix = opacity
            if _on_edge(layer, alphas, y, x, least, gate):
                mix = np.float32(1)
            elif opacity == 0 or not _inside(layer, alphas, y, x, 0, least, gate):
                continue
            for k in range(3):
                shown = np.float32(image[height - 1 - y, x, k])
                mixed = shown + mix * (np.float32(255) * colour[k] - shown)
                image[height - 1 - y, x, k] = np.uint8(mixed + np.float32(0.5))
