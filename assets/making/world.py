"""Furnished rooms of three tiers of difficulty: what is in them, where, and what it is called."""

from dataclasses import dataclass, field
from itertools import islice
from typing import Literal, get_args

import numpy as np

from assets.making.kit import (
    COLOUR_SYNONYMS,
    COLOURS,
    Kit,
    Material,
    Piece,
    Thing,
    TriMesh,
    rotation_about,
)
from assets.making.objects import BRIGHT, FURNITURE, TABLE_TOP, furniture
from langsplat_core.arrays import Array

Tier = Literal["separate", "clutter", "occlusion"]  # objects apart, cluttered, packed with look-alikes
TIERS: tuple[Tier, ...] = get_args(Tier)

# Words: which phrases are right for an object, a part, a finer region, a colour, a material.

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
        area[substance or ""] = area.get(substance or "", 0.0) + _surface(p.mesh)
    main = max(area, key=lambda key: area[key])
    if area[main] < _MOST * sum(area.values()):
        main = ""
    return RegionLabel(level, word, thing.word, colour, thing.colour, hues, main, tuple(sorted(area)))


def _surface(mesh: TriMesh) -> float:
    """Return the area of a mesh, square metres."""
    a, b, c = np.moveaxis(mesh.vertices[mesh.triangles], 1, 0)
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)


# What is in a room, and where.

_CLEARANCE = 0.001  # metres under an object: a flat bottom in the very plane it stands on would flicker
_TRIES = 400  # places that are looked at for one object before it is left out
ENLARGED = 1.3  # small objects are shown larger than life, so that their parts are worth looking at
_HALF_TABLE = np.array([0.72, 0.545])  # metres, a little inside the table's edge
_RUG = np.array([1.15, 0.95])  # half its sides


@dataclass(frozen=True, eq=False)
class Placed:
    """A thing in the world."""

    thing: Thing
    turn: Array  # (3, 3)
    offset: Array  # (3,) metres
    scale: float = 1.0


def bounds(thing: Thing) -> tuple[Array, Array]:
    """Return (3,) lowest and highest coordinates of a thing in its own frame, metres."""
    low = np.min([piece.mesh.vertices.min(0) for piece in thing.pieces], axis=0)
    return low, np.max([piece.mesh.vertices.max(0) for piece in thing.pieces], axis=0)


def footprint(placed: Placed) -> Array:
    """Return (4, 2) corners of the upright box around a placed thing, seen from above, in world metres."""
    world: Array = (_base(placed.thing) * placed.scale) @ placed.turn.T + placed.offset
    return world[:, :2]


def _base(thing: Thing) -> Array:
    """Return (4, 3) corners, in order around, of the box around a thing in its own frame, at height 0."""
    low, high = bounds(thing)
    return np.array([(x, y, 0) for x, y in (low[:2], (high[0], low[1]), high[:2], (low[0], high[1]))])


def apart(one: Array, other: Array, gap: float) -> Array:
    """Return (...) bool: rectangles (..., 4, 2) keep a distance of `gap` from one rectangle (4, 2).

    The distance is along one of the four directions of their sides.
    """
    axes = np.concatenate(
        [np.diff(one[..., :3, :], axis=-2), np.diff(np.broadcast_to(other, one.shape)[..., :3, :], axis=-2)],
        axis=-2,
    )
    axes /= np.maximum(np.linalg.norm(axes, axis=-1, keepdims=True), 1e-12)
    a, b = one @ axes.swapaxes(-1, -2), other @ axes.swapaxes(-1, -2)  # (..., 4 corners, 4 axes)
    return np.asarray(((a.min(-2) - b.max(-2) > gap) | (b.min(-2) - a.max(-2) > gap)).any(-1))


@dataclass(eq=False)
class StandingArea:
    """A level rectangle that carries things, and what stands on it already."""

    centre: Array  # (3,) metres
    half: Array  # (2,) half its sides, along x and y
    gap: float  # metres kept free between footprints
    scale: float  # things are enlarged by this factor
    crowd: int = 1  # of so many free places the one nearest the middle is taken: more is tighter
    taken: list[Array] = field(default_factory=list)  # footprints (4, 2)

    def stand(self, thing: Thing, rng: np.random.Generator) -> Placed | None:
        """Put a thing down at a free place, turned at random; None where there is no room for it."""
        base, lowest = _base(thing)[:, :2] * self.scale, bounds(thing)[0][2]
        middle = base.mean(0)
        angles = rng.uniform(0, 360, _TRIES)
        turns = np.stack([rotation_about("z", angle) for angle in angles])
        spots = self.centre[:2] + rng.uniform(-self.half, self.half, (_TRIES, 2))
        corners = (base - middle) @ turns[:, :2, :2].swapaxes(1, 2) + spots[:, None]
        free = (np.abs(corners - self.centre[:2]) <= self.half).all((1, 2))
        for other in self.taken:
            free &= apart(corners, other, self.gap)
        rows = np.flatnonzero(free)[: self.crowd]
        if not len(rows):
            return None
        row = rows[np.linalg.norm(spots[rows] - self.centre[:2], axis=1).argmin()]
        self.taken.append(corners[row])
        height = self.centre[2] + _CLEARANCE - lowest * self.scale
        offset = np.array([*(spots[row] - turns[row, :2, :2] @ middle), height])
        return Placed(thing, turns[row], offset, self.scale)


@dataclass(frozen=True)
class _Plan:
    table: int  # objects to try to place on the table
    floor: int  # and around it
    gap: float  # metres between footprints
    crowd: int  # see StandingArea
    classes: int  # different classes among them; 0: all different
    largest: float = 1.0  # square metres of an object's footprint


_PLANS: dict[Tier, _Plan] = {
    "separate": _Plan(8, 0, 0.07, 1, 0),
    "clutter": _Plan(17, 5, 0.012, 2, 0),
    "occlusion": _Plan(34, 6, 0.003, 6, 9, 0.032),
}


def furnished(seed: int, tier: Tier) -> list[Placed]:
    """Everything in the room of a seed; the origin is the middle of the table's top."""
    rng = np.random.default_rng((seed, 17))
    kit, plan = Kit(rng), _PLANS[tier]
    room = _large_things(kit)
    objects = _chosen(kit, plan)
    table = StandingArea(np.zeros(3), _HALF_TABLE, plan.gap, ENLARGED, plan.crowd)
    wide_first = sorted(objects[: plan.table], key=_area, reverse=True)  # while there is room for them
    on_table = [table.stand(thing, rng) for thing in wide_first]
    floor = StandingArea(np.array([0, 0, -furniture.TABLE_HEIGHT]), np.array([1.5, 1.5]), 0.03, ENLARGED)
    floor.taken = [
        footprint(item) for item in room if item.thing.word not in ("floor", "rug", "wall", "picture")
    ]
    on_floor = [floor.stand(thing, rng) for thing in objects[plan.table :]]
    small = [_filled(item, kit) for item in on_table if item is not None]
    lying = [_on_rug(item) for item in on_floor if item is not None]
    return [*room, *(thing for group in small for thing in group), *lying]


def _area(thing: Thing) -> float:
    """Footprint of the box around a thing as it stands in the room, square metres."""
    low, high = bounds(thing)
    return float(np.prod((high - low)[:2])) * ENLARGED**2


def _chosen(kit: Kit, plan: _Plan) -> list[Thing]:
    """Objects of a plan; colours repeat as rarely as possible, or, with few classes, as often."""
    count = plan.table + plan.floor
    names = [str(name) for name in kit.rng.permutation(list(TABLE_TOP))]
    alike = plan.classes > 0
    if alike:
        small = (
            name for name in names if _area(TABLE_TOP[name][0](kit, TABLE_TOP[name][1][0])) < plan.largest
        )
        names = list(islice(small, plan.classes)) * (count // plan.classes + 1)
    shared = [str(word) for word in kit.rng.permutation(BRIGHT)[:4]]
    used: dict[str, int] = {}
    things = []
    for name in names[:count]:
        builder, own = TABLE_TOP[name]
        words = [word for word in own if word in (shared if alike else BRIGHT)] or list(own)
        words += [word for word in own if word not in words][: max(3 - len(words), 0)]
        # With look-alikes an object's neighbours in class differ in colour, not the room's objects at large.
        key = name if alike else ""
        fewest = min(used.get(key + word, 0) for word in words)
        colour = kit.pick(*[word for word in words if used.get(key + word, 0) == fewest])
        used[key + colour] = used.get(key + colour, 0) + 1
        things.append(builder(kit, colour))
    return things


def _filled(host: Placed, kit: Kit) -> list[Placed]:
    """Return the thing itself, and fruit in it where it is a bowl or a plate."""
    if host.thing.word not in ("bowl", "plate"):
        return [host]
    builder, words = TABLE_TOP[kit.pick("orange", "apple")]
    bowl = host.thing.word == "bowl"
    colour, start, result = kit.pick(*words), kit.size(0, 360), [host]
    for k in range(3 if bowl else 1):
        at = rotation_about("z", start + 120 * k) @ (0.058 if bowl else 0.0, 0, 0.032 if bowl else 0.013)
        tilt = rotation_about("z", kit.size(0, 360)) @ rotation_about("x", kit.size(-12, 12))
        result.append(Placed(builder(kit, colour), tilt, host.offset + at * host.scale, host.scale))
    return result


def _on_rug(item: Placed) -> Placed:
    """Lifted by the rug's thickness where it stands on it, even with one edge."""
    corners = np.abs(footprint(item)) - _RUG
    lift = 0.012 if (corners.max(1) < 0).any() else 0.0
    return Placed(item.thing, item.turn, item.offset + (0, 0, lift), item.scale)


def _large_things(kit: Kit) -> list[Placed]:
    """Floor, walls, rug, table, seats around it, furniture along the walls, pictures above."""
    down = np.array([0, 0, -furniture.TABLE_HEIGHT])
    placed = [Placed(thing, np.eye(3), down) for thing in furniture.shell(kit)]
    placed.append(Placed(furniture.table(kit, kit.pick("brown", "beige")), np.eye(3), down))
    around = kit.rng.permutation(4) * 90.0
    seats = (furniture.chair(kit, kit.pick(*BRIGHT)), furniture.stool(kit, kit.pick(*BRIGHT)))
    for seat, angle in zip(seats, around, strict=False):
        turn = rotation_about("z", angle)
        reach = 0.98 if angle % 180 == 90 else 0.82
        own = turn @ rotation_about("z", kit.size(-18, 18))
        placed.append(Placed(seat, own, turn @ (kit.size(-0.2, 0.2), reach, 0) + down))
    for name, angle in zip(("sofa", "shelf", "cabinet"), kit.rng.permutation(4) * 90.0, strict=False):
        builder, words = FURNITURE[name]
        thing = builder(kit, kit.pick(*[word for word in words if word in COLOURS]))
        turn, (_, high) = rotation_about("z", angle), bounds(thing)
        at = np.array([kit.size(-1.0, 1.0), furniture.ROOM / 2 - 0.03 - high[1], 0])
        placed.append(Placed(thing, turn, turn @ at + down))
        if name != "shelf":
            placed.append(_hung(kit, turn, kit.size(-0.7, 0.7), kit.size(0.3, 0.5)))
    return placed


def _hung(kit: Kit, turn: np.ndarray, along: float, height: float) -> Placed:
    at = turn @ (along, furniture.ROOM / 2 - 0.03, height)
    return Placed(furniture.picture(kit, kit.pick("brown", "black", "white")), turn, at)


@dataclass(frozen=True, eq=False)
class World:
    """A room: all its surfaces in one set of arrays. The origin is the middle of the table's top, z up."""

    vertices: Array  # (V, 3) float32 world points, metres
    normals: Array  # (V, 3) float32 unit
    local: Array  # (V, 3) float32 the same vertices in their object's frame, where textures live
    triangles: Array  # (T, 3) int32
    piece_of: Array  # (T,) int32 row of `materials` and `ids`
    materials: tuple[Material, ...]
    frames: Array  # (P, 3, 3) rotation of every piece from its object's frame into the world
    ids: Array  # (P, 3) int32 label ids of every piece: subpart, part, whole
    labels: tuple[RegionLabel, ...]  # indexed by id
    solid: Array  # (T,) bool: surfaces that an outline of the room's objects should cover (not the room)


def build_room(seed: int, tier: Tier = "clutter") -> World:
    """Return the furnished room of a seed: the same arguments always give the same room, object for object.

    tier: "separate" objects at a distance, "clutter" on the table and the floor, or "occlusion": packed
    tightly, with look-alikes (the same class in other colours, the same colour on other classes).
    """
    return assemble(furnished(seed, tier))


def assemble(placed: list[Placed]) -> World:
    """Return the room of placed things; ids count up through wholes, parts and subparts."""
    columns: dict[str, list[Array]] = {key: [] for key in ("v", "n", "l", "t", "p")}
    labels: list[RegionLabel] = []
    known: dict[tuple[object, ...], int] = {}
    ids: list[list[int]] = []
    materials: list[Material] = []
    frames: list[Array] = []
    offset = 0

    def number(key: tuple[object, ...], level: int, thing: Thing, piece: Piece) -> int:
        if key not in known:
            known[key] = len(labels)
            labels.append(label_region(level, thing, piece))
        return known[key]

    for index, item in enumerate(placed):
        for piece in item.thing.pieces:
            part = (index, piece.part, piece.instance)
            ids.append([
                number((*part, piece.subpart), 0, item.thing, piece),
                number(part, 1, item.thing, piece),
                number((index,), 2, item.thing, piece),
            ])  # fmt: skip
            mesh = piece.mesh.stretched((item.scale,) * 3).turned(item.turn).moved(item.offset)
            columns["v"].append(mesh.vertices)
            columns["n"].append(mesh.normals)
            columns["l"].append(piece.mesh.vertices)
            columns["t"].append(mesh.triangles + offset)
            columns["p"].append(np.full(len(mesh.triangles), len(materials)))
            materials.append(piece.material)
            frames.append(item.turn)
            offset += len(mesh.vertices)
    whole_words = [labels[row[2]].word for row in ids]
    solid = np.array([word not in ("floor", "wall") for word in whole_words])
    piece_of = np.concatenate(columns["p"]).astype(np.int32)
    return World(
        np.concatenate(columns["v"]).astype(np.float32),
        np.concatenate(columns["n"]).astype(np.float32),
        np.concatenate(columns["l"]).astype(np.float32),
        np.concatenate(columns["t"]).astype(np.int32),
        piece_of,
        tuple(materials),
        np.stack(frames),
        np.array(ids, np.int32),
        tuple(labels),
        solid[piece_of],
    )
