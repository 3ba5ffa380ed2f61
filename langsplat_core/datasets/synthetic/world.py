"""A furnished room with small objects on a table: geometry, materials, and the names of everything."""

from dataclasses import dataclass

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.datasets.synthetic import furniture
from langsplat_core.datasets.synthetic.captions import Label, label_region
from langsplat_core.datasets.synthetic.catalogue import BRIGHT, SMALL
from langsplat_core.datasets.synthetic.colours import COLOURS
from langsplat_core.datasets.synthetic.parts import Kit, Material, Piece, Thing
from langsplat_core.datasets.synthetic.placement import Placed
from langsplat_core.datasets.synthetic.rooms import ENLARGED, Tier, furnished
from langsplat_core.datasets.synthetic.shapes import rotation_about

ALWAYS = ("mug", "lamp", "bowl")  # every room has these


@dataclass(frozen=True, eq=False)
class World:
    """All surfaces of a room in one set of arrays. The origin is the middle of the table's top, z up."""

    vertices: Array  # (V, 3) float32 world points, metres
    normals: Array  # (V, 3) float32 unit
    local: Array  # (V, 3) float32 the same vertices in their object's frame, where textures live
    triangles: Array  # (T, 3) int32
    piece_of: Array  # (T,) int32 row of `materials` and `ids`
    materials: tuple[Material, ...]
    frames: Array  # (P, 3, 3) rotation of every piece from its object's frame into the world
    ids: Array  # (P, 3) int32 label ids of every piece: subpart, part, whole
    labels: tuple[Label, ...]  # indexed by id
    solid: Array  # (T,) bool: surfaces that an outline of the room's objects should cover (not the room)


def _small_things(rng: np.random.Generator, count: int, palette: tuple[str, ...]) -> list[Thing]:
    """`count` objects for the table; colours repeat as rarely as the choice allows."""
    kit = Kit(rng)
    rest = [name for name in SMALL if name not in ALWAYS]
    names = [*ALWAYS, *rng.choice(rest, count - len(ALWAYS), replace=False)]
    used: dict[str, int] = {}
    things = []
    for name in names:
        builder, own = SMALL[str(name)]
        words = [word for word in own if word in palette] or own
        fewest = min(used.get(word, 0) for word in words)
        colour = kit.pick(*[word for word in words if used.get(word, 0) == fewest])
        used[colour] = used.get(colour, 0) + 1
        things.append(builder(kit, colour))
    return things


def _on_table(things: list[Thing], rng: np.random.Generator) -> list[Placed]:
    """Places without overlap of footprints, tall things towards the rim; what finds no place is left out."""
    half = np.array([0.68, 0.5])
    placed: list[Placed] = []
    taken: list[tuple[Array, float]] = []
    for thing in sorted(things, key=lambda thing: -thing.radius):
        radius = thing.radius * ENLARGED
        for _ in range(400):
            spot = rng.uniform(-half + radius * 0.8, half - radius * 0.8)
            if all(np.linalg.norm(spot - at) > radius + r + 0.012 for at, r in taken):
                taken.append((spot, radius))
                turn = rotation_about("z", rng.uniform(0, 360))
                placed.append(Placed(thing, turn, np.array([*spot, 0.0]), ENLARGED))
                break
    return placed


def _fill_bowls(placed: list[Placed], rng: np.random.Generator) -> list[Placed]:
    """Fruit inside every bowl and on every plate."""
    kit, fruit = Kit(rng), []
    for host in placed:
        if host.thing.word not in ("bowl", "plate"):
            continue
        name = kit.pick("orange", "orange", "apple")
        builder, words = SMALL[name]
        count = 3 if host.thing.word == "bowl" else 1
        colour, start = kit.pick(*words), rng.uniform(0, 360)
        for k in range(count):
            reach = 0.058 if count > 1 else 0.0
            at = rotation_about("z", start + 120 * k) @ (reach * ENLARGED, 0, 0.0)
            lift = 0.032 if host.thing.word == "bowl" else 0.013
            tilt = rotation_about("z", rng.uniform(0, 360)) @ rotation_about("x", rng.uniform(-12, 12))
            fruit.append(
                Placed(builder(kit, colour), tilt, host.offset + at + (0, 0, lift * ENLARGED), ENLARGED)
            )
    return fruit


def _room(rng: np.random.Generator) -> list[Placed]:
    kit, down = Kit(rng), np.array([0, 0, -furniture.TABLE_TOP])
    placed = [Placed(thing, np.eye(3), down) for thing in furniture.shell(kit)]
    placed.append(Placed(furniture.table(kit, kit.pick("brown", "beige")), np.eye(3), down))
    around = rng.permutation(4) * 90.0
    seats = (furniture.chair(kit, kit.pick(*BRIGHT)), furniture.stool(kit, kit.pick(*BRIGHT)))
    for seat, angle in zip(seats, around, strict=False):
        turn = rotation_about("z", angle)
        placed.append(Placed(seat, turn, turn @ (rng.uniform(-0.2, 0.2), 0.95, 0) + down))
    for angle in around[:3]:
        turn = rotation_about("z", angle)
        at = turn @ (rng.uniform(-0.9, 0.9), furniture.ROOM / 2 - 0.03, rng.uniform(0.2, 0.55))
        placed.append(Placed(furniture.picture(kit, kit.pick("brown", "black", "white")), turn, at))
    return placed


def build_world(seed: int, objects: int = 12, palette: tuple[str, ...] = COLOURS) -> World:
    """The room of a seed: the same arguments always give the same room, object for object.

    objects: how many to try to place on the table, at least 3; palette: colour words for them to prefer.
    """
    rng = np.random.default_rng((seed, 7))
    room = _room(rng)
    table = _on_table(_small_things(rng, objects, palette), rng)
    return assemble([*room, *table, *_fill_bowls(table, rng)])


def build_room(seed: int, tier: Tier = "clutter") -> World:
    """The furnished room of a seed: the same arguments always give the same room, object for object.

    tier: "separate" objects at a distance, "clutter" on the table and the floor, or "occlusion": packed
    tightly, with look-alikes (the same class in other colours, the same colour on other classes).
    """
    return assemble(furnished(seed, tier))


def assemble(placed: list[Placed]) -> World:
    """One set of arrays from placed things; ids count up through wholes, parts and subparts."""
    columns: dict[str, list[Array]] = {key: [] for key in ("v", "n", "l", "t", "p")}
    labels: list[Label] = []
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
