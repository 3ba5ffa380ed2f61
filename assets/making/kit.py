"""Colours and their words, materials, labelled pieces of things, and the kit that builders work with.

Colour words are judged in CIE LCh (lightness, chroma, hue of CIE L*a*b*, D65). The borders follow where
English speakers change words in naming experiments (Berlin and Kay's eleven basic terms, beige and
turquoise added); near a border a colour has no certain word, and `colour_word` then answers None.
"""

from dataclasses import dataclass, replace
from typing import Literal, TypeVar, get_args

import numpy as np

from assets.making.shapes import TriMesh
from langsplat_core.arrays import Array

Texture = Literal[
    "plain", "speckled", "wood", "planks", "cloth", "metal", "pages", "tiles", "plaster", "leaf", "striped",
    "dotted", "rug", "painting", "peel",
]  # fmt: skip
TEXTURES = get_args(Texture)

# Decides highlight, relief and fine mottling.
Substance = Literal[
    "plastic", "ceramic", "glass", "metal", "wood", "cloth", "paper", "plaster", "leaf", "skin", "rubber",
    "wax",
]  # fmt: skip
Word = TypeVar("Word", bound=str)
COLOUR_SYNONYMS = {
    "gray": ("gray", "grey"),
    "turquoise": ("turquoise", "cyan"),
    "beige": ("beige", "tan"),
    "purple": ("purple", "violet"),
}
_WHITE = np.array([0.95047, 1.0, 1.08883])
_TO_XYZ = np.array(
    [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750], [0.0193339, 0.1191920, 0.9503041]]
)
# word -> (lightness from, to, chroma from, to, hue from, to in degrees); hues may run past 360
_BOXES: dict[str, tuple[float, float, float, float, float, float]] = {
    "red": (28, 56, 52, 120, 16, 44),
    "orange": (58, 80, 56, 120, 52, 74),
    "yellow": (72, 97, 54, 120, 82, 104),
    "green": (28, 85, 28, 120, 118, 166),
    "turquoise": (52, 88, 24, 80, 182, 220),
    "blue": (20, 64, 30, 130, 254, 298),
    "purple": (20, 56, 32, 120, 307, 334),
    "pink": (66, 86, 24, 70, -14, 18),
    "brown": (20, 46, 18, 44, 44, 76),
    "beige": (72, 88, 12, 26, 70, 94),
    "black": (2, 17, 0, 5, 0, 360),
    "gray": (36, 68, 0, 5, 0, 360),
    "white": (90, 99, 0, 5, 0, 360),
}
COLOURS = tuple(_BOXES)


def to_linear(display: Array) -> Array:
    """Return linear light of sRGB display values in [0, 1]."""
    display = np.asarray(display, np.float64)
    return np.where(display <= 0.04045, display / 12.92, ((display + 0.055) / 1.055) ** 2.4)


def to_display(linear: Array) -> Array:
    """Linear light (clipped to [0, 1]) -> sRGB display values."""
    linear = np.clip(linear, 0, 1)
    return np.where(linear <= 0.0031308, linear * 12.92, 1.055 * linear ** (1 / 2.4) - 0.055)


def to_lch(display: Array) -> Array:
    """(..., 3) sRGB in [0, 1] -> (..., 3) CIE lightness [0, 100], chroma, hue in degrees [0, 360)."""
    ratio = to_linear(display) @ _TO_XYZ.T / _WHITE
    f = np.where(ratio > 216 / 24389, np.cbrt(ratio), (24389 / 27 * ratio + 16) / 116)
    a, b = 500 * (f[..., 0] - f[..., 1]), 200 * (f[..., 1] - f[..., 2])
    return np.stack([116 * f[..., 1] - 16, np.hypot(a, b), np.degrees(np.arctan2(b, a)) % 360], -1)


def from_lch(lch: Array) -> Array:
    """Inverse of `to_lch`; colours outside sRGB come out beyond [0, 1] in linear light, unclipped."""
    hue = np.radians(lch[..., 2])
    fy = (lch[..., 0] + 16) / 116
    f = np.stack([fy + lch[..., 1] * np.cos(hue) / 500, fy, fy - lch[..., 1] * np.sin(hue) / 200], -1)
    ratio = np.where(f > 6 / 29, f**3, (116 * f - 16) * 27 / 24389)
    linear = (ratio * _WHITE) @ np.linalg.inv(_TO_XYZ).T
    return np.where(linear <= 0.0031308, linear * 12.92, 1.055 * np.abs(linear) ** (1 / 2.4) - 0.055)


def colour_word(display: Array) -> str | None:
    """Return the word that certainly fits one sRGB colour (3,), or None near a border between words."""
    lightness, chroma, hue = to_lch(display)
    for word, (l0, l1, c0, c1, h0, h1) in _BOXES.items():
        if l0 <= lightness <= l1 and c0 <= chroma <= c1 and (hue - h0) % 360 <= h1 - h0:
            return word
    return None


def random_colour(word: str, rng: np.random.Generator) -> Array:
    """(3,) sRGB display values in [0, 1] that `word` certainly covers."""
    l0, l1, c0, c1, h0, h1 = _BOXES[word]
    for _ in range(1000):
        colour = from_lch(rng.uniform((l0, c0, h0), (l1, min(c1, 95), h1)))
        if colour.min() >= 0 and colour.max() <= 1:
            return colour
    raise ValueError(f"no displayable colour found for {word!r}")


@dataclass(frozen=True, eq=False)
class Material:
    """Appearance of a surface. Textures are functions of the point in the object's own frame."""

    word: str  # the colour word that fits, "" where none does
    colour: Array  # (3,) sRGB in [0, 1]
    second: Array  # (3,) sRGB in [0, 1]: grain, stripes, joints
    texture: Texture
    gloss: float  # strength of the highlight, [0, 1]
    substance: Substance | None = None  # what it is made of; None: no common word fits


@dataclass(frozen=True, eq=False)
class Piece:
    """One surface with its place in the hierarchy whole > part > subpart."""

    part: str  # word of the part, e.g. "handle"
    subpart: str  # word of the finer region, "" where the part has none
    mesh: TriMesh
    material: Material
    instance: int = 0  # tells equal parts of one object apart, e.g. four wheels


@dataclass(frozen=True, eq=False)
class Thing:
    """One object: a word, a main colour word and its pieces, standing on z = 0 around the origin."""

    word: str
    colour: str  # "" where no single colour names the whole
    pieces: tuple[Piece, ...]

    def centred(self) -> "Thing":
        """Return the same thing with the middle of its footprint's bounding box at the origin."""
        points = np.concatenate([p.mesh.vertices[:, :2] for p in self.pieces])
        x, y = -(points.min(0) + points.max(0)) / 2
        return replace(self, pieces=tuple(replace(p, mesh=p.mesh.moved((x, y, 0.0))) for p in self.pieces))


_MADE_OF: dict[str, Substance] = {
    "wood": "wood", "planks": "wood", "cloth": "cloth", "rug": "cloth", "metal": "metal", "pages": "paper",
}  # fmt: skip


class Kit:
    """Random choices and material recipes for one object."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng

    def size(self, low: float, high: float) -> float:
        """Return a length between two bounds."""
        return float(self.rng.uniform(low, high))

    def pick(self, *words: Word) -> Word:
        """One of several words."""
        return words[int(self.rng.integers(len(words)))]

    def other(self, word: str, *words: str) -> str:
        """One of `words` that is not `word`."""
        return self.pick(*[candidate for candidate in words if candidate != word])

    def paint(
        self,
        word: str,
        texture: Texture = "plain",
        gloss: float = 0.3,
        shift: float = 14,
        substance: Substance | None = None,
    ) -> Material:
        """Return a material of a named colour; the second colour is the first one `shift` lightness darker.

        Cloth, metal and wooden textures are of those materials unless `substance` says otherwise.
        """
        colour = random_colour(word, self.rng)
        made_of = substance or _MADE_OF.get(texture)
        return Material(word, colour, darker(colour, shift), texture, gloss, made_of)

    def plastic(self, word: str) -> Material:
        """Smooth and shiny, as toys are."""
        return self.paint(word, "plain", 0.5, substance="plastic")

    def glass(self, word: str) -> Material:
        """Coloured, with the strongest highlights; light does not pass."""
        return self.paint(word, "plain", 0.95, 8, substance="glass")

    def cloth(self, word: str) -> Material:
        """Woven and dull."""
        return self.paint(word, "cloth", 0.02)

    def steel(self, word: str) -> Material:
        """Metal of any colour: brushed, with strong highlights."""
        return self.paint(word, "metal", 0.9, 10)

    def pattern(self, word: str, second: str, texture: Texture, gloss: float = 0.2) -> Material:
        """Two named colours; `word` covers most of the surface."""
        colours = random_colour(word, self.rng), random_colour(second, self.rng)
        return Material(word, *colours, texture, gloss, _MADE_OF.get(texture))

    def wood(self, word: str = "brown") -> Material:
        """Wooden surface of a colour."""
        return self.paint(word, "wood", 0.12, 12)

    def wall_paint(self, word: str) -> Material:
        """Return a pale, muted version of a colour; it keeps its word only where it still fits."""
        lch = to_lch(random_colour(word, self.rng))
        colour = np.clip(from_lch(np.array([70 + 0.2 * lch[0], 0.4 * lch[1], lch[2]])), 0, 1)
        return Material(colour_word(colour) or "", colour, darker(colour, 4), "plaster", 0.0)

    def metal(self) -> Material:
        """Grey metal."""
        return self.steel("gray")


def darker(colour: Array, by: float) -> Array:
    """Return the same hue `by` units of CIE lightness darker, clipped to what can be shown."""
    lch = to_lch(colour)
    return np.clip(from_lch(np.array([np.clip(lch[0] - by, 3, 98), lch[1] * 0.95, lch[2]])), 0, 1)


@dataclass(frozen=True)
class Finish:
    """One substance. Highlights stay weak: a scene of few Gaussians cannot follow mirrors."""

    mirror: float  # reflectance straight on, [0, 1]
    sharpness: float  # exponent of the highlight
    diffuse: float = 1.0  # share of the colour that scatters light
    tint: float = 0.0  # share of the highlight that takes the surface's colour


FINISHES: dict[str, Finish] = {
    "plastic": Finish(0.04, 60),
    "ceramic": Finish(0.055, 150),
    "glass": Finish(0.09, 200, 0.9),
    "metal": Finish(0.45, 35, 0.55, 0.7),
    "wood": Finish(0.03, 25),
    "cloth": Finish(0.0, 4),
    "paper": Finish(0.01, 8),
    "plaster": Finish(0.0, 4),
    "leaf": Finish(0.035, 22),
    "skin": Finish(0.04, 28),
    "rubber": Finish(0.02, 10),
    "wax": Finish(0.03, 18),
}
_BY_TEXTURE = {
    "wood": "wood", "planks": "wood", "cloth": "cloth", "rug": "cloth", "metal": "metal", "pages": "paper",
    "painting": "paper", "leaf": "leaf", "peel": "skin", "plaster": "plaster", "tiles": "ceramic",
}  # fmt: skip
# How strongly a pattern is also carved: change of the light per unit of the pattern's weight.
_RELIEF = {
    "wood": 0.1, "planks": 0.2, "cloth": 0.3, "tiles": 0.22, "rug": 0.5, "plaster": 0.12, "leaf": 0.35,
    "peel": 0.5, "pages": 0.15, "striped": 0.2, "painting": 0.1, "metal": 0.05,
}  # fmt: skip


def finish_of(material: Material) -> Finish:
    """Finish of the substance a material is made of, or else of the one its texture and gloss suggest."""
    by_gloss = "glass" if material.gloss >= 0.85 else "ceramic" if material.gloss >= 0.5 else "plastic"
    if material.gloss < 0.2:
        by_gloss = "paper"
    return FINISHES[material.substance or _BY_TEXTURE.get(material.texture, by_gloss)]


def material_table(materials: tuple[Material, ...]) -> tuple[Array, Array]:
    """Return the (P,) int32 pattern of every piece, and a (P, 12) float32 table of numbers.

    Its columns are colour, second colour (sRGB), mirror, sharpness, diffuse, tint, relief, 0.
    """
    kinds = np.array([TEXTURES.index(m.texture) for m in materials], np.int32)
    rows = np.zeros((len(materials), 12), np.float32)
    for row, material in zip(rows, materials, strict=True):
        finish = finish_of(material)
        mirror = finish.mirror * min(1.0, 0.25 + 1.5 * material.gloss)
        row[:3], row[3:6] = material.colour, material.second
        row[6:11] = mirror, finish.sharpness, finish.diffuse, finish.tint, _RELIEF.get(material.texture, 0)
    return kinds, rows


def mean_reflectance(materials: tuple[Material, ...]) -> Array:
    """(P, 3) linear reflectance of every piece on average, for light that bounces off it."""
    return np.array([to_linear(0.75 * m.colour + 0.25 * m.second) * finish_of(m).diffuse for m in materials])
