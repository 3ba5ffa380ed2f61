"""Words: which phrases are right for an object, a part, a finer region, a colour, a material."""

from dataclasses import dataclass
from itertools import chain

import numpy as np

from assets.making.kit import COLOUR_SYNONYMS, COLOURS, Piece, Thing
from assets.making.shapes import TriMesh
from langsplat_core.arrays import Array
from langsplat_core.scene import CANONICAL_PHRASES

# Word -> other words for the same.
OBJECT_SYNONYMS: dict[str, tuple[str, ...]] = {
    "mug": ("cup",), "teapot": ("tea pot",), "plate": ("dish",), "vase": ("flower vase",),
    "plant": ("potted plant",), "lamp": ("table lamp",), "clock": ("alarm clock",), "car": ("toy car",),
    "block": ("toy block",), "gift": ("present",), "duck": ("toy duck",), "house": ("toy house",),
    "robot": ("toy robot",), "pan": ("frying pan",), "wine glass": ("goblet",),
    "basket": ("wicker basket",), "cake": ("birthday cake",), "donut": ("doughnut",),
    "ice cream": ("icecream",), "burger": ("hamburger",), "train": ("locomotive",), "truck": ("lorry",),
    "airplane": ("plane", "aeroplane"), "boat": ("sailing boat",), "rocket": ("spaceship",),
    "teddy bear": ("teddy",), "rabbit": ("bunny",), "scissors": ("pair of scissors",),
    "umbrella": ("parasol",), "laptop": ("computer",), "headphones": ("headset",),
    "globe": ("world globe",), "guitar": ("acoustic guitar",), "hat": ("sun hat",), "shoe": ("sneaker",),
    "backpack": ("rucksack",), "windmill": ("mill",), "castle": ("fortress",), "sofa": ("couch",),
    "shelf": ("bookcase",), "cabinet": ("cupboard",), "rug": ("carpet",), "picture": ("wall picture",),
    "floor": ("ground",),
}  # fmt: skip
PART_SYNONYMS: dict[str, tuple[str, ...]] = {
    "shade": ("lampshade",), "bulb": ("light bulb",), "pole": ("stand",), "cap": ("bottle top",),
    "face": ("dial",), "leaves": ("leaf",), "leaf": ("leaves",), "petals": ("blossom",),
    "wheel": ("wheels",), "leg": ("legs",), "arm": ("arms",), "armrest": ("armrests",),
    "window": ("windows",), "wing": ("wings",), "fin": ("fins",), "sail": ("sails",), "ears": ("ear",),
    "paw": ("paws",), "eyes": ("eye",), "blade": ("blades",), "strings": ("string",), "strap": ("straps",),
    "keys": ("buttons",), "icing": ("frosting",), "slice": ("sponge",), "scoop": ("ice cream scoop",),
    "cone": ("waffle cone",), "funnel": ("smokestack",), "screen": ("monitor",), "blanket": ("quilt",),
    "bracket": ("arc",), "drumstick": ("stick",),
}  # fmt: skip
_TOYS = (
    "car", "block", "ball", "duck", "house", "robot", "train", "truck", "airplane", "boat", "rocket",
    "teddy bear", "rabbit", "penguin", "fish", "snail", "snowman", "windmill", "castle", "drum",
)  # fmt: skip
_GROUPS: dict[str, tuple[str, ...]] = {
    "fruit": ("orange", "apple", "banana"),
    "food": ("orange", "apple", "banana", "carrot", "cake", "donut", "ice cream", "burger"),
    "toy": _TOYS,
    "vehicle": ("car", "train", "truck", "airplane", "boat", "rocket"),
    "animal": ("duck", "teddy bear", "rabbit", "penguin", "fish", "snail"),
    "instrument": ("guitar", "drum"),
    "device": ("camera", "laptop", "headphones"),
    "clothing": ("hat", "shoe"),
    "furniture": ("table", "chair", "stool", "sofa", "bed", "shelf", "cabinet"),
}
CATEGORIES: dict[str, tuple[str, ...]] = {
    thing: tuple(kind for kind, things in _GROUPS.items() if thing in things)
    for things in _GROUPS.values()
    for thing in things
}  # object -> its categories
# Substances that people name: the word before a noun, then other words for the stuff itself.
MATERIALS: dict[str, tuple[str, ...]] = {
    "wood": ("wooden", "wood"),
    "metal": ("metal",),
    "glass": ("glass",),
    "cloth": ("cloth", "fabric"),
    "ceramic": ("ceramic", "porcelain"),
    "plastic": ("plastic",),
    "paper": ("paper",),
    "rubber": ("rubber",),
    "wax": ("wax",),
}
_MOST = 0.6  # share of its surface that a thing's material covers, or it has no single one
# Parts that are nearly the whole of their object, so that the object's word is not wrong for them.
BULK = frozenset(
    {
        "body", "cover", "peel", "skin", "surface", "box", "side", "floor", "wall", "rug", "top", "centre",
        "root", "sphere", "upper", "icing", "dough",
    }
)  # fmt: skip


def object_words(word: str) -> tuple[str, ...]:
    """Return an object's word and its synonyms."""
    return (word, *OBJECT_SYNONYMS.get(word, ()))


def part_words(word: str) -> tuple[str, ...]:
    """Return a part's word and its synonyms."""
    return (word, *PART_SYNONYMS.get(word, ()))


def colour_words(word: str) -> tuple[str, ...]:
    """Return a colour's word and its synonyms; none for ""."""
    return COLOUR_SYNONYMS.get(word, (word,)) if word else ()


def colour_phrases(word: str) -> list[str]:
    """Phrases that name nothing but a colour; none for ""."""
    return [form for hue in colour_words(word) for form in (hue, f"{hue} thing", f"something {hue}")]


def material_phrases(substance: str) -> list[str]:
    """Phrases that name nothing but a material; none for ""."""
    words = MATERIALS.get(substance, ())
    return [*words, *(form for word in words[:1] for form in (f"{word} thing", f"something {word}"))]


def material_whole_phrases(thing: str, substance: str) -> list[str]:
    """Return a material and an object, e.g. "wooden chair"; none for ""."""
    return [f"{word} {name}" for word in MATERIALS.get(substance, ())[:1] for name in object_words(thing)]


def material_part_phrases(part: str, thing: str, substance: str) -> list[str]:
    """Return a material and a part, e.g. "wooden leg", "wooden chair leg"; none for ""."""
    return [
        phrase
        for word in MATERIALS.get(substance, ())[:1]
        for phrase in (f"{word} {part}", f"{word} {thing} {part}")
    ]


def whole_phrases(thing: str, colour: str) -> list[str]:
    """Phrases right for a whole object, without the bare colour."""
    names = [*object_words(thing), *CATEGORIES.get(thing, ())]
    return [*names, *(f"{hue} {name}" for hue in colour_words(colour) for name in names)]


def part_phrases(part: str, thing: str, colour: str, thing_colour: str) -> list[str]:
    """Phrases right for a part of an object, without the bare colour."""
    names, owners = part_words(part), object_words(thing)
    phrases = [*names]
    phrases += [f"{owner} {name}" for owner in owners for name in names]
    phrases += [f"{name} of the {owner}" for owner in owners for name in names]
    phrases += [f"{hue} {name}" for hue in colour_words(colour) for name in names]
    phrases += [
        f"{name} of the {hue} {owner}"
        for name in names[:1]
        for hue in colour_words(thing_colour)
        for owner in owners
    ]
    return phrases


@dataclass(frozen=True)
class RegionLabel:
    """Words for one region. An empty word stands for "no single word fits"."""

    level: int  # 0 subpart, 1 part, 2 whole; -1 for pictures that show no object
    word: str  # the region's own word: the object's at level 2, else the part's
    thing: str  # the word of the object it belongs to
    colour: str  # of the region
    thing_colour: str  # of the whole object
    hues: tuple[str, ...]  # colour words of all its surfaces, the main one included
    material: str = ""  # key of MATERIALS: what most of it is made of
    materials: tuple[str, ...] = ()  # of all its surfaces, the main one included; "" where one has no word

    @property
    def names(self) -> tuple[str, ...]:
        """Phrases right for the region that name a thing or part."""
        if not self.thing:
            return ()
        if self.level == 2 or self.word == self.thing:
            names = whole_phrases(self.thing, self.colour)
            return (*names, *material_whole_phrases(self.thing, self.material))
        names = part_phrases(self.word, self.thing, self.colour, self.thing_colour)
        return (*names, *material_part_phrases(self.word, self.thing, self.material))

    @property
    def phrase(self) -> str:
        """The phrase that says most about the region, e.g. "handle of the red mug"; "" for no object."""
        if not self.thing:
            return ""
        if self.level == 2 or self.word == self.thing:
            return f"{self.colour} {self.thing}".strip()
        return f"{self.word} of the " + f"{self.thing_colour} {self.thing}".strip()

    @property
    def words(self) -> tuple[str, ...]:
        """Every phrase that is right for the region, its colour or material alone included."""
        alone = (*colour_words(self.colour), *MATERIALS.get(self.material, ()))
        return tuple(dict.fromkeys([*self.names, *alone]))


def label_region(level: int, thing: Thing, piece: Piece) -> RegionLabel:
    """Label the region that `piece` represents at a level; a part's colour is its first piece's."""
    same_part = [p for p in thing.pieces if (p.part, p.instance) == (piece.part, piece.instance)]
    if level == 2:
        word, colour, inside = thing.word, thing.colour, list(thing.pieces)
    else:
        word = (piece.subpart or piece.part) if level == 0 else piece.part
        colour, inside = piece.material.word, [piece] if level == 0 else same_part
    hues = tuple(sorted({p.material.word for p in inside} | {colour} - {""}))
    area: dict[str, float] = {}
    for p in inside:
        substance = p.material.substance if p.material.substance in MATERIALS else ""
        area[substance or ""] = area.get(substance or "", 0.0) + _area(p.mesh)
    main = max(area, key=lambda key: area[key])
    if area[main] < _MOST * sum(area.values()):
        main = ""
    return RegionLabel(level, word, thing.word, colour, thing.colour, hues, main, tuple(sorted(area)))


def _area(mesh: TriMesh) -> float:
    """Square metres."""
    a, b, c = np.moveaxis(mesh.vertices[mesh.triangles], 1, 0)
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)


BOOK_KINDS = ("colour", "material", "object", "colour+object", "material+object", "part")


@dataclass(frozen=True, eq=False)
class PhraseBook:
    """All phrases of a training run and how each fits each distinct label."""

    phrases: tuple[str, ...]  # P; the four canonical phrases come first
    kinds: tuple[str, ...]  # (P) "canonical", one of BOOK_KINDS
    labels: tuple[RegionLabel, ...]  # U distinct labels
    fits: Array  # (U, P) int8: 1 right, 0 wrong, -1 neither (left out of the loss)


def phrase_book(labels: list[RegionLabel]) -> PhraseBook:
    """Return the phrases for a set of labels, and every object in every colour beside them."""
    distinct = tuple(dict.fromkeys(labels))
    kinds = _kinds(distinct)
    phrases = tuple(kinds)
    column = {phrase: k for k, phrase in enumerate(phrases)}
    fits = np.stack([_row(label, column) for label in distinct])
    return PhraseBook(phrases, tuple(kinds.values()), distinct, fits)


def _kinds(labels: tuple[RegionLabel, ...]) -> dict[str, str]:
    """Every phrase and its kind, the canonical ones first; a phrase of several kinds has the first."""
    kinds: dict[str, str] = dict.fromkeys(CANONICAL_PHRASES, "canonical")
    for colour in COLOURS:
        kinds.update(dict.fromkeys(colour_phrases(colour), "colour"))
    for material in sorted({label.material for label in labels if label.material}):
        kinds.update(dict.fromkeys(material_phrases(material), "material"))
    for thing in sorted({label.thing for label in labels if label.thing}):
        kinds.update({name: kinds.get(name, "object") for name in whole_phrases(thing, "")})
        for colour in COLOURS:
            for name in whole_phrases(thing, colour):
                kinds.setdefault(name, "colour+object")
    wholes = [label for label in labels if label.level == 2]
    for name in chain.from_iterable(material_whole_phrases(label.thing, label.material) for label in wholes):
        kinds.setdefault(name, "material+object")
    for name in chain.from_iterable(label.names for label in labels):
        kinds.setdefault(name, "part")
    return kinds


def _row(label: RegionLabel, column: dict[str, int]) -> Array:
    """(P,) int8 of one label: 1 right, 0 wrong, -1 neither."""
    row = np.zeros(len(column), np.int8)

    def mark(phrases: list[str] | tuple[str, ...], value: int) -> None:
        row[[column[phrase] for phrase in phrases if phrase in column]] = value

    if label.thing and label.level < 2 and label.word in BULK:
        for colour in ("", label.colour, label.thing_colour):  # the body of a mug may pass for a mug
            mark(whole_phrases(label.thing, colour), -1)
    if label.level == 2:
        for bulk in BULK:
            mark(part_phrases(bulk, label.thing, label.colour, label.colour), -1)
    unknown = COLOURS if not label.colour else label.hues
    for hue in unknown:
        mark(colour_phrases(hue), -1)
        if not label.colour:
            mark([f"{hue} {name}" for name in (*object_words(label.thing), label.word)], -1)
    known = label.materials and "" not in label.materials
    for material in label.materials if known else MATERIALS:
        mark(material_phrases(material), -1)
        mark(material_whole_phrases(label.thing, material), -1)
        mark(material_part_phrases(label.word, label.thing, material), -1)
    mark(label.names, 1)
    mark(colour_phrases(label.colour), 1)
    mark(material_phrases(label.material), 1)
    if label.level == -1 and not label.colour:
        mark(CANONICAL_PHRASES, 1)
    return row
