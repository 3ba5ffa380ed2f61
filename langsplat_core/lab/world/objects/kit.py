"""What objects are made of: materials, labelled pieces, and the kit that builders work with."""

from dataclasses import dataclass, replace
from typing import Literal, TypeVar

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.lab.world.appearance.colours import colour_word, from_lch, random_colour, to_lch
from langsplat_core.lab.world.geometry.shapes import Mesh

Texture = Literal[
    "plain", "speckled", "wood", "planks", "cloth", "metal", "pages", "tiles", "plaster", "leaf", "striped",
    "dotted", "rug", "painting", "peel",
]  # fmt: skip

Substance = Literal[
    "plastic",
    "ceramic",
    "glass",
    "metal",
    "wood",
    "cloth",
    "paper",
    "plaster",
    "leaf",
    "skin",
    "rubber",
    "wax",
]  # what it is made of: decides highlight, relief and fine mottling

Word = TypeVar("Word", bound=str)


@dataclass(frozen=True, eq=False)
class Material:
    """How a surface looks. Textures are functions of the point in the object's own frame."""

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
    mesh: Mesh
    material: Material
    instance: int = 0  # tells equal parts of one object apart, e.g. four wheels


@dataclass(frozen=True, eq=False)
class Thing:
    """One object: a word, a main colour word and its pieces, standing on z = 0 around the origin."""

    word: str
    colour: str  # "" where no single colour names the whole
    pieces: tuple[Piece, ...]

    @property
    def radius(self) -> float:
        """Of the footprint's enclosing circle about the origin, metres."""
        return max(float(np.linalg.norm(p.mesh.vertices[:, :2], axis=1).max()) for p in self.pieces)

    @property
    def height(self) -> float:
        """Of the highest vertex, metres."""
        return max(float(p.mesh.vertices[:, 2].max()) for p in self.pieces)

    def centred(self) -> "Thing":
        """The same thing with the middle of its footprint's bounding box at the origin."""
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
        """A length between two bounds."""
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
        """A material of a named colour; the second colour is the first one `shift` lightness darker.

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
        """A pale, muted version of a colour; it keeps its word only where it still fits."""
        lch = to_lch(random_colour(word, self.rng))
        colour = np.clip(from_lch(np.array([70 + 0.2 * lch[0], 0.4 * lch[1], lch[2]])), 0, 1)
        return Material(colour_word(colour) or "", colour, darker(colour, 4), "plaster", 0.0)

    def metal(self) -> Material:
        """Grey metal."""
        return self.steel("gray")


def darker(colour: Array, by: float) -> Array:
    """The same hue `by` units of CIE lightness darker (negative: lighter), clipped to what can be shown."""
    lch = to_lch(colour)
    return np.clip(from_lch(np.array([np.clip(lch[0] - by, 3, 98), lch[1] * 0.95, lch[2]])), 0, 1)
