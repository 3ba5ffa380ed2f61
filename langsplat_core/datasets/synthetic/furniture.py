"""The room around the table: floor, walls, rug, table, chair, picture. Lengths in metres, z up."""

from langsplat_core.datasets.synthetic.parts import Kit, Piece, Thing
from langsplat_core.datasets.synthetic.shapes import box, cylinder, join, rotation_about, sheet

TABLE_TOP = 0.72  # height of the table's upper face above the floor
ROOM = 4.6  # side of the square room
WALL_HEIGHT = 2.2


def table(kit: Kit, colour: str) -> Thing:
    w, d = 1.5, 1.15
    material = kit.wood(colour)
    leg = box(0.07, 0.07, TABLE_TOP - 0.04, 0.06)
    places = [(x * (w / 2 - 0.09), y * (d / 2 - 0.09), 0) for x in (-1, 1) for y in (-1, 1)]
    return Thing("table", colour, (
        Piece("top", "", box(w, d, 0.04, 0.014).moved((0, 0, TABLE_TOP - 0.04)), material),
        *(Piece("leg", "", leg.moved(place), material, k) for k, place in enumerate(places)),
    ))  # fmt: skip


def chair(kit: Kit, colour: str) -> Thing:
    wood = kit.wood(kit.pick("brown", colour))
    w, seat, top = 0.42, 0.46, 0.95
    legs = [
        box(0.04, 0.04, seat, 0.05).moved((x * (w / 2 - 0.03), y * (w / 2 - 0.03), 0))
        for x in (-1, 1)
        for y in (-1, 1)
    ]
    posts = [
        box(0.04, 0.035, top - seat, 0.05).moved((x * (w / 2 - 0.03), w / 2 - 0.02, seat)) for x in (-1, 1)
    ]
    slats = [box(w - 0.06, 0.02, 0.09, 0.04).moved((0, w / 2 - 0.02, seat + z)) for z in (0.16, 0.3, 0.42)]
    cushion = box(w - 0.05, w - 0.06, 0.035, 0.04).moved((0, -0.01, seat + 0.02))
    return Thing("chair", colour, (
        Piece("seat", "", box(w, w, 0.025, 0.04).moved((0, 0, seat)), wood),
        Piece("seat", "cushion", cushion, kit.paint(colour, "cloth", 0.02)),
        Piece("back", "", join(posts + slats), wood),
        *(Piece("leg", "", leg, wood, k) for k, leg in enumerate(legs)),
    ))  # fmt: skip


def stool(kit: Kit, colour: str) -> Thing:
    legs = [
        cylinder(0.018, 0.47, 14, 0.05).moved((0.12, 0, 0)).turned(rotation_about("z", 90 * k))
        for k in range(4)
    ]
    seat = cylinder(0.18, 0.05, 36, 0.03).moved((0, 0, 0.47))
    return Thing("stool", colour, (
        Piece("seat", "", seat, kit.paint(colour, "cloth", 0.02)),
        *(Piece("leg", "", leg, kit.wood(), k) for k, leg in enumerate(legs)),
    ))  # fmt: skip


def picture(kit: Kit, colour: str) -> Thing:
    """Hangs in the plane y = 0, facing -y, its lower edge at z = 0."""
    w, h, b = kit.size(0.6, 0.9), kit.size(0.45, 0.6), 0.04
    sides = [
        box(w, 0.03, b, 0.04), box(w, 0.03, b, 0.04).moved((0, 0, h - b)),
        box(b, 0.03, h, 0.04).moved((b / 2 - w / 2, 0, 0)),
        box(b, 0.03, h, 0.04).moved((w / 2 - b / 2, 0, 0)),
    ]  # fmt: skip
    canvas = sheet(w - b, h - b, 0.03).turned(rotation_about("x", 90)).moved((0, -0.008, h / 2))
    second = kit.other(colour, "blue", "green", "orange", "yellow", "turquoise")
    painting = kit.pattern(second, kit.other(second, "white", "beige", "pink", "brown"), "painting", 0.05)
    return Thing("picture", "", (
        Piece("frame", "", join(sides), kit.wood(colour)),
        Piece("painting", "", canvas, painting),
    ))  # fmt: skip


def shell(kit: Kit) -> list[Thing]:
    """Floor, rug and four walls of the room, centred at the origin; the ceiling is open."""
    floor = sheet(ROOM, ROOM, 0.06)
    ground = kit.paint(kit.pick("brown", "beige", "gray"), kit.pick("planks", "planks", "tiles"), 0.12, 9)
    rug = kit.pattern(
        kit.pick("blue", "red", "green", "purple", "turquoise"), kit.pick("white", "beige"), "rug", 0
    )
    words = kit.rng.permutation(["beige", "turquoise", "green", "blue", "pink", "yellow", "white", "gray"])[
        :4
    ]
    things = [
        Thing("floor", ground.word, (Piece("floor", "", floor, ground),)),
        Thing("rug", rug.word, (Piece("rug", "", box(2.3, 1.9, 0.012, 0.05), rug),)),
    ]
    for k, word in enumerate(words):
        upright = sheet(ROOM, WALL_HEIGHT, 0.1).turned(rotation_about("x", 90))
        wall = upright.moved((0, ROOM / 2, WALL_HEIGHT / 2)).turned(rotation_about("z", 90 * k))
        paint = kit.wall_paint(str(word))
        skirting = (
            box(ROOM, 0.02, 0.09, 0.1).moved((0, ROOM / 2 - 0.01, 0)).turned(rotation_about("z", 90 * k))
        )
        things.append(Thing("wall", paint.word, (
            Piece("wall", "", wall, paint),
            Piece("wall", "skirting", skirting, kit.paint("white", gloss=0.1)),
        )))  # fmt: skip
    return things
