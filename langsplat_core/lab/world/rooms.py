"""Furnished rooms of three tiers of difficulty: what is in them and where it stands."""

from dataclasses import dataclass
from itertools import islice

import numpy as np

from langsplat_core.lab.config import Tier
from langsplat_core.lab.world.appearance.colours import COLOURS
from langsplat_core.lab.world.geometry.shapes import rotation_about
from langsplat_core.lab.world.objects import furniture
from langsplat_core.lab.world.objects.catalogue import BRIGHT, FURNITURE, TABLE_TOP
from langsplat_core.lab.world.objects.kit import Kit, Thing
from langsplat_core.lab.world.placement import Placed, Surface, bounds, footprint

ENLARGED = 1.3  # small objects are shown larger than life, so that their parts are worth looking at
_HALF_TABLE = np.array([0.72, 0.545])  # metres, a little inside the table's edge
_RUG = np.array([1.15, 0.95])  # half its sides


@dataclass(frozen=True)
class _Plan:
    table: int  # objects to try to place on the table
    floor: int  # and around it
    gap: float  # metres between footprints
    crowd: int  # see Surface
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
    table = Surface(np.zeros(3), _HALF_TABLE, plan.gap, ENLARGED, plan.crowd)
    on_table = [table.stand(thing, rng) for thing in _wide_first(objects[: plan.table])]
    floor = Surface(np.array([0, 0, -furniture.TABLE_TOP]), np.array([1.5, 1.5]), 0.03, ENLARGED)
    floor.taken = [
        footprint(item) for item in room if item.thing.word not in ("floor", "rug", "wall", "picture")
    ]
    on_floor = [floor.stand(thing, rng) for thing in objects[plan.table :]]
    small = [_filled(item, kit) for item in on_table if item is not None]
    lying = [_on_rug(item) for item in on_floor if item is not None]
    return [*room, *(thing for group in small for thing in group), *lying]


def _area(thing: Thing) -> float:
    """Of the box around a thing as it stands in the room, seen from above, square metres."""
    low, high = bounds(thing)
    return float(np.prod((high - low)[:2])) * ENLARGED**2


def _wide_first(things: list[Thing]) -> list[Thing]:
    """Wide things find room only while there is some."""
    return sorted(things, key=lambda thing: -_area(thing))


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
    """The thing itself, and fruit in it where it is a bowl or a plate."""
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
    down = np.array([0, 0, -furniture.TABLE_TOP])
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
