"""Colours of numbers and of queries."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib.resources import files
from types import MappingProxyType
from typing import Literal

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.config import ColourMap, Display, PictureConfig
from langsplat_core.io.hostile import opened
from langsplat_core.scene import LanguageField

# Turbo colour map: polynomial fit published by A. Mikhailov, Google (2019), coefficients by channel.
_TURBO_COEFFICIENTS = np.array(
    [
        [0.13572138, 4.61539260, -42.66032258, 132.13108234, -152.94239396, 59.28637943],
        [0.09140261, 2.19418839, 4.84296658, -14.18503333, 4.27729857, 2.82956604],
        [0.10667330, 12.64194608, -60.58204836, 110.36276771, -89.90310912, 27.34824973],
    ]
)
NODES = 256  # of a colour map; looked up with linear interpolation between them


def _turbo() -> Array:
    powers = np.linspace(0, 1, NODES)[:, None] ** np.arange(6)
    return np.rint(255 * np.clip(powers @ _TURBO_COEFFICIENTS.T, 0, 1)).astype(np.uint8)


def _published() -> dict[ColourMap, Array]:
    """Viridis and magma by N. Smith and S. van der Walt (2015) and cividis by J. Nunez, C. Anderton and
    R. Renslow (2018), as matplotlib has them: the rows of a small picture beside this file."""
    table = files(__package__).joinpath("colour_maps.png").read_bytes()
    with opened(table, "colour_maps.png") as picture:
        rows = np.asarray(picture.convert("RGB"))
    return {"viridis": rows[0], "cividis": rows[1], "magma": rows[2]}


# Name -> (NODES, 3) uint8, in the order of `config.ColourMap`.
COLOUR_MAPS: Mapping[ColourMap, Array] = MappingProxyType(
    {"turbo": _turbo(), **_published(), "grey": np.repeat(np.arange(NODES, dtype=np.uint8)[:, None], 3, 1)}
)
TURBO = COLOUR_MAPS["turbo"]

QUERY_COLOURS = np.array([[0.98, 0.45, 0.09], [0.13, 0.59, 0.95], [0.30, 0.80, 0.35]])  # per shown query
MAX_QUERIES = len(QUERY_COLOURS)  # shown at a time: one colour each, one channel of a texture each


def mapped(t: Array, name: ColourMap = "turbo") -> Array:
    """(...,) values in [0, 1] -> (..., 3) colours in [0, 1] of a colour map."""
    position = np.clip(t, 0, 1) * (NODES - 1)
    low = np.minimum(position.astype(int), NODES - 2)
    fraction = (position - low)[..., None]
    table = COLOUR_MAPS[name] / 255.0
    return table[low] * (1 - fraction) + table[low + 1] * fraction


# What can be shown: one table, one row per display.
#
# The panel's buttons and keys, the arguments, the channels that are rasterized, and the numbers by which the
# composite shader tells displays apart all come from here; the names are those of `config.Display`.

Extra = Literal["none", "latent", "relevancies", "depth"]  # what is rasterized beside colours and alpha


@dataclass(frozen=True)
class DisplayRow:
    """One display."""

    name: Display
    label: str  # on its button
    extra: Extra = "none"  # the further channel that it shows
    needs_field: bool = False  # shows the language field
    needs_query: bool = False  # shows answers


_ROWS = (
    DisplayRow("rgb", "Colours"),
    DisplayRow("depth", "Depth", "depth"),
    DisplayRow("alpha", "Alpha"),
    DisplayRow("relevancy", "Relevancy", "relevancies", needs_field=True, needs_query=True),
    DisplayRow("segmentation", "Segmentation", "relevancies", needs_field=True, needs_query=True),
    DisplayRow("latent", "Latent", "latent", needs_field=True),
)
DISPLAYS: Mapping[Display, DisplayRow] = MappingProxyType({row.name: row for row in _ROWS})  # in this order
NUMBERS: Mapping[Display, int] = MappingProxyType({name: number for number, name in enumerate(DISPLAYS)})


# Colours that show a language field's latents.


def latent_colours(field: LanguageField) -> Array:
    """(3, N, 3) float32 colours in [0, 1] of the latents at each level; grey where nothing was observed.

    A codeword has its own. Latents of 3 numbers are colours by themselves, others have their first three
    principal axes over all levels together (one basis for the scene, so that colours agree between views
    and levels); each axis is stretched between its 2 % and 98 % quantiles.
    """
    seen = field.known
    flat = field.latents.reshape(-1, field.latents.shape[2])
    colours = field.codec.colours(flat, seen.reshape(-1).astype(np.float64)).reshape(*seen.shape, 3)
    return np.where(seen[..., None], colours, np.float32(0.5)).astype(np.float32)


# From channels to a picture, in NumPy: the plain twin of the window's composite shader.
#
# A rasterizer delivers premultiplied channels (colours, latent colours, relevancies, depth sums) and alpha;
# `compose` turns them into what a person sees. Every step below exists once here and once in
# `compose.frag.glsl`; constants reach the shader by `shader_defines`, and a test compares the pictures.

HEAT_FADE = 0.35  # heat at which the heat map reaches its full opacity
SEGMENT_OPACITY = 0.6
LEAST_ALPHA = 1 / 255  # that colours are divided by; what is less is not seen in a picture of bytes

HeatRanges = tuple[tuple[float, float], ...]  # per query, the relevancies at which heat is 0 and 1


def shader_defines() -> dict[str, int | float]:
    """What the shader shares with this module: the displays' numbers and the constants."""
    numbers = {f"DISPLAY_{name.upper()}": number for name, number in NUMBERS.items()}
    return numbers | {
        "HEAT_FADE": HEAT_FADE,
        "SEGMENT_OPACITY": SEGMENT_OPACITY,
        "LEAST_ALPHA": LEAST_ALPHA,
        "MAX_QUERIES": MAX_QUERIES,
        "MAP_NODES": NODES,
    }


def full_ranges(heat_ranges: HeatRanges, count: int) -> HeatRanges:
    """`heat_ranges` for `count` queries: those without one spread their heat over all of [0, 1]."""
    return (*heat_ranges[:count], *[(0.0, 1.0)] * (count - len(heat_ranges)))


@dataclass(frozen=True, eq=False)
class Channels:
    """What one camera sees, as rasterized: every colour-like channel is premultiplied by alpha."""

    rgb: Array  # (H, W, 3)
    alpha: Array  # (H, W) in [0, 1]
    latent: Array | None = None  # (H, W, 3) latent colours
    relevancies: Array | None = None  # (H, W, Q), Q <= MAX_QUERIES; or which Gaussians are members, 0 or 1
    depth_sum: Array | None = None  # (H, W) sum of weight * camera z, world units
    depth_range: tuple[float, float] = (0.0, 1.0)  # near and far end of the depth display, world units

    def extra(self, name: Extra) -> Array | None:
        """The further channel of that name, if it is there."""
        return {"latent": self.latent, "relevancies": self.relevancies, "depth": self.depth_sum}.get(name)


@dataclass(frozen=True, eq=False)
class _Sheet:
    """What a display draws from."""

    channels: Channels
    extra: Array  # (H, W, ...) the display's further channel; alpha for displays without one
    picture: PictureConfig
    heat_ranges: HeatRanges

    def uncovered(self) -> Array:
        """(H, W, 3) what shows of the background."""
        if self.picture.transparent:
            return np.zeros_like(self.channels.rgb)
        return (1 - self.channels.alpha)[..., None] * np.asarray(self.picture.background)

    def colours(self) -> Array:
        """(H, W, 3) in [0, 1], the scene over the background."""
        return np.clip(self.of_scene(self.channels.rgb) + self.uncovered(), 0, 1)

    def of_scene(self, total: Array) -> Array:
        """(H, W, 3) premultiplied sums as they enter the picture: where that is transparent its colours are
        the scene's own, undiluted, as PNG wants them."""
        return (
            total / np.maximum(self.channels.alpha, LEAST_ALPHA)[..., None]
            if self.picture.transparent
            else total
        )

    def relevancy(self) -> Array:
        """(H, W, Q) in [0, 1]."""
        return gated_mean(self.extra, self.channels.alpha, self.picture.alpha_gate)


def gated_mean(total: Array, alpha: Array, gate: float) -> Array:
    """Weighted sums (H, W, Q) / alpha where alpha exceeds `gate`, else 0: nothing there means nothing."""
    open_ = alpha > gate
    return np.where(open_[..., None], total / np.where(open_, alpha, 1)[..., None], 0)


def compose(channels: Channels, picture: PictureConfig, heat_ranges: HeatRanges = ()) -> Array:
    """(H, W, 3) uint8 picture; with `picture.transparent` (H, W, 4), its colours not premultiplied. Where a
    display's further channel is absent it shows the plain colours.

    heat_ranges: per query, the relevancies at which its heat is 0 and 1; see `full_ranges`.
    """
    wanted = DISPLAYS[picture.display].extra
    extra = channels.alpha if wanted == "none" else channels.extra(wanted)
    draw = _colours if extra is None else _DRAW[picture.display]
    sheet = _Sheet(channels, channels.alpha if extra is None else extra, picture, heat_ranges)
    drawn = draw(sheet)
    if picture.transparent:
        drawn = np.concatenate([drawn, _opacity(sheet, draw)[..., None]], -1)
    return np.rint(255 * np.clip(drawn, 0, 1)).astype(np.uint8)


def _opacity(sheet: _Sheet, draw: Callable[[_Sheet], Array]) -> Array:
    """(H, W) alpha of a transparent picture: the scene's; the display of alpha itself is opaque, and depth
    is there or not."""
    alpha = sheet.channels.alpha
    if draw is _depth:
        return np.asarray(alpha > sheet.picture.alpha_gate, alpha.dtype)
    return np.ones_like(alpha) if draw is _alpha else alpha


def _colours(sheet: _Sheet) -> Array:
    return sheet.colours()


def _latent(sheet: _Sheet) -> Array:
    return sheet.of_scene(sheet.extra) + sheet.uncovered()


def _heat(sheet: _Sheet) -> Array:
    """One query by the colour map. Several by their own colours: where they overlap, the mean of the colours,
    weighted by heat, as opaque as the hottest of them."""
    picture, relevancy = sheet.picture, sheet.relevancy()
    count = relevancy.shape[-1]
    low, high = np.transpose(full_ranges(sheet.heat_ranges, count))
    heats = np.clip((relevancy - low) / (high - low), 0, 1)
    heat = heats.max(-1)
    if picture.own_colours:
        fade, total = heat, np.maximum(heats.sum(-1, keepdims=True), 1e-9)
        colours = heats / total @ QUERY_COLOURS[:count]
    else:
        fade, colours = np.clip(heat / HEAT_FADE, 0, 1), mapped(heat, picture.colour_map)
    mix = (picture.heat_opacity * fade * fade * (3 - 2 * fade))[..., None]  # smoothstep
    return sheet.colours() * picture.dim * (1 - mix) + colours * mix


def _segments(sheet: _Sheet) -> Array:
    """The query that has most of a pixel, in its colour, as opaque as its value of 1 is hot."""
    picture, relevancy, colours = sheet.picture, sheet.relevancy(), sheet.colours()
    low, high = np.transpose(full_ranges(sheet.heat_ranges, relevancy.shape[-1]))
    opacity = SEGMENT_OPACITY * np.clip((1 - low) / (high - low), 0, 1)
    winner = relevancy.argmax(-1)
    inside = (relevancy.max(-1) > picture.threshold)[..., None]
    mix = opacity[winner][..., None]
    return np.where(inside, colours * (1 - mix) + QUERY_COLOURS[winner] * mix, colours * picture.dim)


def _depth(sheet: _Sheet) -> Array:
    alpha, gate = sheet.channels.alpha, sheet.picture.alpha_gate
    near, far = sheet.channels.depth_range
    depth = gated_mean(sheet.extra[..., None], alpha, gate)[..., 0]
    t = np.clip((depth - near) / max(far - near, 1e-9), 0, 1)
    backdrop = np.zeros(3) if sheet.picture.transparent else np.asarray(sheet.picture.background)
    return np.where((alpha > gate)[..., None], mapped(1 - t, sheet.picture.colour_map), backdrop)


def _alpha(sheet: _Sheet) -> Array:
    return np.repeat(sheet.channels.alpha[..., None], 3, -1)


_DRAW: Mapping[Display, Callable[[_Sheet], Array]] = MappingProxyType(
    {
        "rgb": _colours,
        "latent": _latent,
        "relevancy": _heat,
        "segmentation": _segments,
        "depth": _depth,
        "alpha": _alpha,
    }
)
