"""Words for regions: which phrases are right for an object, a part, a finer region, a colour."""

from dataclasses import dataclass

from langsplat_core.datasets.synthetic import colours
from langsplat_core.datasets.synthetic.parts import Piece, Thing

OBJECT_SYNONYMS: dict[str, tuple[str, ...]] = {
    "mug": ("mug", "cup"),
    "teapot": ("teapot", "tea pot"),
    "plant": ("plant", "potted plant"),
    "lamp": ("lamp", "table lamp"),
    "car": ("car", "toy car"),
    "block": ("block", "toy block"),
    "gift": ("gift", "present"),
    "duck": ("duck", "toy duck"),
    "house": ("house", "toy house"),
    "robot": ("robot", "toy robot"),
    "rug": ("rug", "carpet"),
    "picture": ("picture", "wall picture"),
    "floor": ("floor", "ground"),
}
PART_SYNONYMS: dict[str, tuple[str, ...]] = {
    "shade": ("shade", "lampshade"),
    "pole": ("pole", "stand"),
    "cap": ("cap", "bottle top"),
    "face": ("face", "dial"),
    "leaves": ("leaves", "leaf"),
    "petals": ("petals", "blossom"),
    "wheel": ("wheel", "wheels"),
    "leg": ("leg", "legs"),
    "window": ("window", "windows"),
}
KINDS: dict[str, str] = {
    **dict.fromkeys(("orange", "apple", "banana"), "fruit"),
    **dict.fromkeys(("car", "block", "ball", "duck", "house", "robot"), "toy"),
    **dict.fromkeys(("table", "chair", "stool"), "furniture"),
}  # object -> the kind of thing it is
# Parts that are nearly the whole of their object, so that the object's word is not wrong for them.
BULK = frozenset(
    {"body", "cover", "peel", "skin", "surface", "box", "side", "floor", "wall", "rug", "top", "centre"}
)


def object_words(word: str) -> tuple[str, ...]:
    """An object's word and its synonyms."""
    return OBJECT_SYNONYMS.get(word, (word,))


def part_words(word: str) -> tuple[str, ...]:
    """A part's word and its synonyms."""
    return PART_SYNONYMS.get(word, (word,))


def colour_words(word: str) -> tuple[str, ...]:
    """A colour's word and its synonyms; none for ""."""
    return colours.SYNONYMS.get(word, (word,)) if word else ()


def colour_phrases(word: str) -> list[str]:
    """Phrases that name nothing but a colour; none for ""."""
    return [form for hue in colour_words(word) for form in (hue, f"{hue} thing", f"something {hue}")]


def whole_phrases(thing: str, colour: str) -> list[str]:
    """Phrases right for a whole object, without the bare colour."""
    names = [*object_words(thing), *([KINDS[thing]] if thing in KINDS else [])]
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
class Label:
    """What one region shows. An empty word stands for "no single word fits"."""

    level: int  # 0 subpart, 1 part, 2 whole; -1 for pictures that show no object
    word: str  # the region's own word: the object's at level 2, else the part's
    thing: str  # the word of the object it belongs to
    colour: str  # of the region
    thing_colour: str  # of the whole object
    hues: tuple[str, ...]  # colour words of all its surfaces, the main one included

    @property
    def names(self) -> tuple[str, ...]:
        """Phrases right for the region that name a thing or part."""
        if not self.thing:
            return ()
        if self.level == 2 or self.word == self.thing:
            return tuple(whole_phrases(self.thing, self.colour))
        return tuple(part_phrases(self.word, self.thing, self.colour, self.thing_colour))

    @property
    def words(self) -> tuple[str, ...]:
        """Every phrase that is right for the region, its colour alone included."""
        return tuple(dict.fromkeys([*self.names, *colour_words(self.colour)]))


def label_region(level: int, thing: Thing, piece: Piece) -> Label:
    """The label of the region that `piece` represents at a level; a part's colour is its first piece's."""
    same_part = [p for p in thing.pieces if (p.part, p.instance) == (piece.part, piece.instance)]
    if level == 2:
        word, colour, inside = thing.word, thing.colour, list(thing.pieces)
    else:
        word = (piece.subpart or piece.part) if level == 0 else piece.part
        colour, inside = piece.material.word, [piece] if level == 0 else same_part
    hues = tuple(sorted({p.material.word for p in inside} | {colour} - {""}))
    return Label(level, word, thing.word, colour, thing.colour, hues)
