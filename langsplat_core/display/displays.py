"""Displays: one table of what can be shown, and the values per Gaussian that each shows.

A rasterizer delivers premultiplied channels (colours, and the one further channel of the display) and alpha,
of which one of six drawings makes what a person sees: on the CPU `composing`, on a graphics device
`compose.frag.glsl`. Buttons, keys, options, channels and drawings come from `DISPLAYS`.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from importlib.resources import files
from types import MappingProxyType
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.config import ColourMap, Display, HeatOf
from langsplat_core.io.hostile import opened
from langsplat_core.scene import NO_NODE, LanguageField

if TYPE_CHECKING:  # its module imports numba, which a program that only lists displays need not wait for
    from langsplat_core.query.answers import QueryResult

NODES = 256  # of a colour map; looked up with linear interpolation between them


def _colour_maps() -> dict[ColourMap, Array]:
    """Return (NODES, 3) uint8 by name, in the order of `config.ColourMap`.

    Inferno, viridis and magma are by N. Smith and S. van der Walt (2015), cividis by J. Nunez, C. Anderton
    and R. Renslow (2018), as matplotlib has them, turbo by A. Mikhailov, Google (2019, its polynomial fit),
    amber of one hue and even steps of lightness in OKLab: the rows of a small image beside this file.
    """
    with opened(files(__package__).joinpath("colour_maps.png").read_bytes(), "colour_maps.png") as image:
        rows = np.asarray(image.convert("RGB"))
    grey = np.repeat(np.arange(NODES, dtype=np.uint8)[:, None], 3, 1)
    return dict(zip(get_args(ColourMap), (*rows, grey), strict=True))


COLOUR_MAPS: Mapping[ColourMap, Array] = MappingProxyType(_colour_maps())

QUERY_COLOURS = np.array([[0.98, 0.45, 0.09], [0.13, 0.59, 0.95], [0.30, 0.80, 0.35]])  # per shown query
MAX_QUERIES = len(QUERY_COLOURS)  # shown at a time: one colour each, one channel of a texture each


def mapped(t: Array, name: ColourMap) -> Array:
    """Return (..., 3) colours in [0, 1] of a colour map at (...,) values, its ends beyond [0, 1]."""
    nodes = np.linspace(0, 1, NODES)
    return np.stack([np.interp(t, nodes, channel / 255) for channel in COLOUR_MAPS[name].T], -1)


def oklab(colours: Array) -> Array:
    """Return lightness, a and b in OKLab (B. Ottosson 2020) of (..., 3) colours in [0, 1].

    Squares stand for sRGB's curve, which is close and costs nothing.
    """
    return np.asarray(np.cbrt(np.square(colours) @ _CONES.T) @ _OKLAB.T)


_CONES = np.array(
    [[0.4122215, 0.5363325, 0.0514460], [0.2119035, 0.6806995, 0.1073970], [0.0883025, 0.2817188, 0.6299787]]
)
_OKLAB = np.array(
    [
        [0.2104543, 0.7936178, -0.0040720],
        [1.9779985, -2.4285922, 0.4505937],
        [0.0259040, 0.7827718, -0.8086758],
    ]
)


# Values per Gaussian that displays show.

Ranges = tuple[tuple[float, float], ...]  # per component of a channel, the values drawn as 0 and as 1
STRENGTH: Mapping[str, float] = MappingProxyType({"found": 1.0, "weak match": 0.5, "not here": 0.0})
NO_HEAT = (0.5, 1.0)  # range of a slot without heat, whose values are 0
HEAT_BASE = 0.3  # value of the coldest Gaussian of an answer, see `heats`


Answers = Sequence["QueryResult | None"]  # by colour slot; None: the slot has no answer


@dataclass(frozen=True, eq=False)
class Subject:
    """Source of a display's channels: a scene's Gaussians, language field and answers."""

    count: int  # Gaussians
    language: LanguageField | None = None
    answers: Answers = ()
    level: int | None = None  # index into scene.LEVELS; None: each answer's own level
    heat: HeatOf = "smooth"


def painted(answers: Answers) -> "dict[int, QueryResult]":
    """Return the answers that are drawn, those other than "not here", by their slots."""
    given = {slot: answer for slot, answer in enumerate(answers) if answer is not None}
    return {slot: answer for slot, answer in given.items() if STRENGTH[answer.verdict]}


def heats(subject: Subject) -> Array | None:
    """Return (N, Q) float32 heat per Gaussian and slot; None where no slot paints anything.

    Heat says in one number, as every channel costs time, where an answer is and how hot: from `HEAT_BASE` to
    1, over the answer's own range, for its members, and 0 for all others. For "everywhere", and for a chosen
    level, it is minus the relevancy of every Gaussian: negative values are not outlined.
    """

    def heat(one: "QueryResult") -> Array:
        values = one.relevancy[one.level if subject.level is None else subject.level]
        if subject.heat == "everywhere" or subject.level is not None:
            return -values
        if subject.heat == "smooth":
            values = one.smooth
        elif subject.heat == "node":
            values = one.even
        low, high = one.heat_range
        hot = HEAT_BASE + (1 - HEAT_BASE) * np.clip((values - low) / (high - low), 0, 1)
        return np.where(one.members, hot, 0)

    return _by_slot(subject, heat)


def members(subject: Subject) -> Array | None:
    """Return (N, Q) float32, 1 for Gaussians of each slot's answer; None where none paints anything."""
    return _by_slot(subject, lambda one: one.members)


def _by_slot(subject: Subject, values_of: Callable[["QueryResult"], Array]) -> Array | None:
    drawn = painted(subject.answers)
    if not drawn:
        return None
    values = np.zeros((subject.count, len(subject.answers)), np.float32)
    for slot, answer in drawn.items():
        values[:, slot] = values_of(answer)
    return values


def _heat_ends(
    answer: "QueryResult", scale: tuple[float, float] | None, everywhere: bool
) -> tuple[float, float]:
    """Return the values of `heats` at the ends of `scale`, in relevancies, or of the answer's own range."""
    low, high = answer.heat_range
    coldest, hottest = scale or answer.heat_range
    if everywhere:
        return -coldest, -hottest
    first, last = (HEAT_BASE + (1 - HEAT_BASE) * (end - low) / (high - low) for end in (coldest, hottest))
    return first, last


def latents(subject: Subject) -> Array | None:
    """Return (N, 3) colours of the latents at a level; None without a language field or level."""
    if subject.language is None or subject.level is None:
        return None
    return np.asarray(subject.language.colours[subject.level])


GOLDEN = 0.6180339887  # step of hue, in turns, between consecutive nodes: it keeps their colours apart
UNLIKE = 0.35, 0.6, 0.85  # brightnesses, which tell nodes of one hue apart


def nodes(subject: Subject) -> Array | None:
    """Return (N, 3) colours of the tree's nodes at a level, grey where there is none; None without a tree."""
    if subject.language is None or subject.language.tree is None or subject.level is None:
        return None
    found, of = np.unique(subject.language.tree.at(subject.level), return_inverse=True)
    hue = (np.arange(len(found)) * GOLDEN)[:, None] + np.array([0, 1 / 3, 2 / 3])
    tint = np.clip(np.abs(6 * (hue % 1) - 3) - 1, 0, 1)  # saturated red, green and blue of a hue
    light = np.array(UNLIKE)[np.arange(len(found)) // 3 % 3, None]
    colours = np.where(found[:, None] == NO_NODE, 0.5, light * (0.25 + 0.75 * tint) / 0.85)
    return np.asarray(colours.astype(np.float32)[of.reshape(-1)])


# From channels to an image: `composing` draws it on the CPU, `compose.frag.glsl` on a graphics device.

HEAT_FADE = 0.35  # heat at which the heat map of everything reaches its full opacity
HEAT_LIGHTNESS = 0.4  # share of the heat map's own lightness; the rest is the image's, whose shading stays
HEAT_EDGE = 0.25  # value of `heats` from which a pixel is in an answer, somewhat less than half of its light
EDGE_PX = 2  # width of the line around answers and selections, pixels
STRIPE_PX = 6  # width of the stripes where several answers are, pixels
SEGMENT_OPACITY = 0.6
SELECTED = (1.0, 0.15, 0.85)  # unlike the colours of queries and of heat, and rare in photographs
SELECTED_OPACITY = 0.5  # the rest is what is shown, so that shapes and heat stay readable
LEAST_ALPHA = 1 / 255  # least alpha that colours are divided by; less is invisible in an image of bytes


@dataclass(frozen=True, eq=False)
class Channels:
    """Rasterized view of one camera: every colour-like channel is premultiplied by alpha."""

    rgb: Array  # (H, W, 3)
    alpha: Array  # (H, W) in [0, 1]
    extra: Array | None = None  # (H, W, C) the display's further channel, C <= 3
    selected: Array | None = None  # (H, W, 1) 1 for what is selected


class Drawing(IntEnum):
    """Kind of drawing of a pixel; each is a branch of the kernel in `composing` and an expression in GLSL."""

    COLOURS = 0  # over the background
    SUMS = 1  # the same with the further channel in place of the colours
    DEPTH = 2  # mean of the further channel by the colour map, near to far; the background where alpha is low
    ALPHA = 3  # opaque grey
    HEAT = 4  # one query by the colour map, several by their own colours, striped where they overlap
    SEGMENTS = 5  # the query that has most of a pixel, in its colour, striped where several have half of it


# Each of type vec4 in the variables of `main` in `compose.frag.glsl`; the fourth is a transparent image's.
_GLSL = {
    Drawing.COLOURS: "vec4(base, c.a)",
    Drawing.SUMS: "vec4(sums.rgb / share + uncovered, c.a)",
    Drawing.DEPTH: "depth_map(sums.rg)",
    Drawing.ALPHA: "vec4(vec3(c.a), 1.0)",
    Drawing.HEAT: "vec4(on_edge(extra, place, HEAT_EDGE) ? vec3(1.0) : heat_map(base, mean, place), c.a)",
    Drawing.SEGMENTS: "vec4(segments(base, mean, place), c.a)",
}


def full_ranges(ranges: Ranges) -> Array:
    """Return (MAX_QUERIES, 2) `ranges` of a channel's components; all of [0, 1] for those without one."""
    return np.array([*ranges, *[(0.0, 1.0)] * MAX_QUERIES][:MAX_QUERIES])


# One row per display, in the order of buttons and keys.


@dataclass(frozen=True)
class DisplayRow:
    """A way of showing a scene, with what it needs to be drawn."""

    name: Display
    label: str  # on its button
    drawing: Drawing
    channel: Callable[[Subject], Array | None] | Literal["depth"] | None = None  # (N, 1 to 3), or camera z
    uses_map: bool = False  # it shows numbers by the colour map
    by_level: bool = False  # it has a button for each semantic level
    needs_query: bool = False  # shows answers

    @property
    def needs_field(self) -> bool:
        """True where it shows the language field."""
        return self.needs_query or self.by_level

    def ranges(
        self, answers: Answers, scale: tuple[float, float] | None = None, everywhere: bool = False
    ) -> Ranges:
        """Return the range of each slot, half of which weak matches reach; () where no answers are shown.

        scale: that of heat, in relevancies, by default each answer's own; everywhere: heat is of everything.
        """
        if not self.needs_query:
            return ()
        ranges = [NO_HEAT] * len(answers)
        for slot, answer in painted(answers).items():
            hot = self.drawing is Drawing.HEAT
            low, high = _heat_ends(answer, scale, everywhere) if hot else (0.0, 1.0)
            ranges[slot] = low, low + (high - low) / STRENGTH[answer.verdict]
        return tuple(ranges)


_ROWS = (
    DisplayRow("rgb", "Colours", Drawing.COLOURS),
    DisplayRow("depth", "Depth", Drawing.DEPTH, "depth", uses_map=True),
    DisplayRow("alpha", "Alpha", Drawing.ALPHA),
    DisplayRow("relevancy", "Relevancy", Drawing.HEAT, heats, uses_map=True, needs_query=True),
    DisplayRow("segmentation", "Segmentation", Drawing.SEGMENTS, members, needs_query=True),
    DisplayRow("latent", "Latent", Drawing.SUMS, latents, by_level=True),
    DisplayRow("tree", "Tree", Drawing.SUMS, nodes, by_level=True),
)
DISPLAYS: Mapping[Display, DisplayRow] = MappingProxyType({row.name: row for row in _ROWS})


def drawing_of(display: Display, has_channel: bool) -> Drawing:
    """Return the drawing of a display: plain colours if the further channel that it needs is missing."""
    row = DISPLAYS[display]
    return row.drawing if has_channel or row.channel is None else Drawing.COLOURS


def shader_defines() -> dict[str, int | float | str]:
    """Return constants that the shader shares with this module, and all drawings as one expression."""
    shown = "".join(f"display == {drawing.value} ? ({glsl}) : " for drawing, glsl in _GLSL.items())
    return {
        "HEAT_FADE": HEAT_FADE,
        "HEAT_LIGHTNESS": HEAT_LIGHTNESS,
        "HEAT_BASE": HEAT_BASE,
        "HEAT_EDGE": HEAT_EDGE,
        "EDGE_PX": EDGE_PX,
        "STRIPE_PX": STRIPE_PX,
        "SELECTED": f"vec3{SELECTED}",
        "SELECTED_OPACITY": SELECTED_OPACITY,
        "SEGMENT_OPACITY": SEGMENT_OPACITY,
        "LEAST_ALPHA": LEAST_ALPHA,
        "MAX_QUERIES": MAX_QUERIES,
        "MAP_NODES": NODES,
        "SHOWN": f"({shown}vec4(base, c.a))",
    }
