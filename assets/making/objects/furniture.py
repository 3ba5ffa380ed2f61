"""Builders of the room around the table: floor, walls, rug, furniture, picture. Metres, z up."""

from assets.making.kit import Kit, Piece, Thing, ball, box, cylinder, join, pillow, sheet

TABLE_HEIGHT = 0.72  # height of the table's upper face above the floor
ROOM = 4.6  # side of the square room
WALL_HEIGHT = 2.2


def table(kit: Kit, colour: str) -> Thing:
    w, d = 1.5, 1.15
    material = kit.wood(colour)
    leg = box(0.07, 0.07, TABLE_HEIGHT - 0.04, 0.06)
    places = [(x * (w / 2 - 0.09), y * (d / 2 - 0.09), 0) for x in (-1, 1) for y in (-1, 1)]
    return Thing("table", colour, (
        Piece("top", "", box(w, d, 0.04, 0.014).moved((0, 0, TABLE_HEIGHT - 0.04)), material),
        *(Piece("leg", "", leg.moved(place), material, k) for k, place in enumerate(places)),
    ))  # fmt: skip


def chair(kit: Kit, colour: str) -> Thing:
    wood = kit.wood(kit.pick("brown", colour))
    w, seat, top = 0.42, 0.46, 0.95
    legs = [box(0.04, 0.04, seat, 0.05).moved((x * (w / 2 - 0.03), y * (w / 2 - 0.03), 0))
            for x in (-1, 1) for y in (-1, 1)]  # fmt: skip
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
    legs = [cylinder(0.018, 0.47, 14, 0.05).moved((0.12, 0, 0)).spun("z", 90 * k) for k in range(4)]
    seat = cylinder(0.18, 0.05, 36, 0.03).moved((0, 0, 0.47))
    return Thing("stool", colour, (
        Piece("seat", "", seat, kit.paint(colour, "cloth", 0.02)),
        *(Piece("leg", "", leg, kit.wood(), k) for k, leg in enumerate(legs)),
    ))  # fmt: skip


def sofa(kit: Kit, colour: str) -> Thing:
    w, d = kit.size(1.3, 1.6), 0.72
    coat = kit.cloth(colour)
    base = box(w - 0.1, d - 0.06, 0.2, 0.08).moved((0, 0, 0.1))
    seats = [
        pillow(w / 2 - 0.16, d - 0.2, 0.17, 5, 24).moved((x * (w / 4 - 0.08), -0.05, 0.27)) for x in (-1, 1)
    ]
    back = pillow(w - 0.08, 0.24, 0.62, 5, 28).moved((0, d / 2 - 0.12, 0.2))
    arm = pillow(0.2, d, 0.48, 4, 24)
    legs = [cylinder(0.025, 0.1, 10, 0.05).moved((x * (w / 2 - 0.14), y * (d / 2 - 0.1), 0))
            for x in (-1, 1) for y in (-1, 1)]  # fmt: skip
    square = pillow(0.36, 0.14, 0.36, 3, 24).spun("x", -18)
    throw = [square.moved((x * (w / 2 - 0.38), 0.06, 0.43)) for x in (-1, 1)]
    second = kit.cloth(kit.other(colour, "yellow", "white", "red", "turquoise", "orange", "pink"))
    return Thing("sofa", colour, (
        Piece("seat", "", join([base, *seats]), coat),
        Piece("back", "", back, coat),
        *(Piece("armrest", "", arm.moved((x * (w / 2 - 0.1), 0, 0.1)), coat, x) for x in (-1, 1)),
        *(Piece("cushion", "", one, second, k) for k, one in enumerate(throw)),
        *(Piece("leg", "", leg, kit.wood(), k) for k, leg in enumerate(legs)),
    ))  # fmt: skip


def bed(kit: Kit, colour: str) -> Thing:
    """The head end is at +y."""
    w, n = kit.size(0.9, 1.2), kit.size(1.7, 1.9)
    wood = kit.wood(kit.pick("brown", "beige"))
    posts = [box(0.06, 0.06, 0.3, 0.06).moved((x * (w / 2 - 0.03), y * (n / 2 - 0.03), 0))
             for x in (-1, 1) for y in (-1, 1)]  # fmt: skip
    head = join([box(w, 0.05, 0.75, 0.1).moved((0, n / 2, 0.1)),
                 pillow(w + 0.06, 0.08, 0.07, 5, 20).moved((0, n / 2, 0.83))])  # fmt: skip
    foot = box(w, 0.05, 0.36, 0.1).moved((0, -n / 2, 0.1))
    frame = box(w, n, 0.16, 0.15).moved((0, 0, 0.14))
    mattress = pillow(w - 0.04, n - 0.06, 0.2, 8, 32).moved((0, 0, 0.28))
    quilt = pillow(w + 0.05, 0.66 * n, 0.27, 7, 36).moved((0, -0.15 * n, 0.26))
    fold = pillow(w + 0.06, 0.12 * n, 0.05, 4, 28).moved((0, 0.14 * n, 0.49))
    heads = [pillow(w * 0.42, 0.3, 0.14, 3, 24).moved((x * w * 0.23, n / 2 - 0.2, 0.46)) for x in (-1, 1)]
    white = kit.cloth(kit.other(colour, "white", "beige"))
    return Thing("bed", colour, (
        Piece("frame", "", join([frame, *posts]), wood),
        Piece("headboard", "", head, wood),
        Piece("footboard", "", foot, wood),
        Piece("mattress", "", mattress, kit.cloth("white")),
        Piece("blanket", "", quilt, kit.cloth(colour)),
        Piece("blanket", "fold", fold, white),
        *(Piece("pillow", "", one, white, k) for k, one in enumerate(heads)),
    ))  # fmt: skip


def shelf(kit: Kit, colour: str) -> Thing:
    """A bookcase against the wall at +y, open to the front, with rows of books."""
    w, d, h = kit.size(0.65, 0.85), 0.26, kit.size(1.2, 1.5)
    wood = kit.wood(colour)
    sides = [box(0.03, d, h, 0.09).moved((x * (w / 2 - 0.015), 0, 0)) for x in (-1, 1)]
    boards = [box(w - 0.06, d, 0.025, 0.09).moved((0, 0, 0.04 + k * (h - 0.07) / 4)) for k in range(5)]
    back = box(w, 0.012, h, 0.1).moved((0, d / 2 - 0.006, 0))
    rows: list[Piece] = []
    for k in range(4):
        x, blocks = -w / 2 + 0.05, []
        while x < w / 2 - 0.16:
            thick, tall = kit.size(0.045, 0.085), kit.size(0.62, 0.86) * (h - 0.07) / 4
            blocks.append((x + thick / 2, thick, tall))
            x += thick + 0.004
        for i, hue in enumerate(
            kit.rng.choice(["red", "blue", "green", "yellow", "purple", "orange", "white"], 3, replace=False)
        ):
            some = [
                box(t, 0.19, tall, 0.1).moved((at, -0.01, 0.065 + k * (h - 0.07) / 4))
                for at, t, tall in blocks[i::3]
            ]
            if some:
                rows.append(
                    Piece("books", "", join(some), kit.paint(str(hue), "plain", 0.15, substance="paper"), k)
                )
    return Thing("shelf", colour, (
        Piece("board", "", join(boards), wood),
        Piece("side", "", join(sides), wood),
        Piece("back", "", back, wood),
        *rows,
    ))  # fmt: skip


def cabinet(kit: Kit, colour: str) -> Thing:
    """A drawer above two doors, all with knobs."""
    w, d, h = kit.size(0.6, 0.75), 0.4, kit.size(0.75, 0.85)
    coat = kit.wood(colour)
    front = kit.paint(kit.pick(colour, "white", "beige"), "wood", 0.15, 8)
    brass = kit.steel(kit.pick("yellow", "gray", "black"))
    feet = [cylinder(0.025, 0.08, 12, 0.05).moved((x * (w / 2 - 0.05), y * (d / 2 - 0.05), 0))
            for x in (-1, 1) for y in (-1, 1)]  # fmt: skip
    body = box(w, d, h - 0.11, 0.07).moved((0, 0, 0.08))
    lid = box(w + 0.05, d + 0.04, 0.03, 0.07).moved((0, -0.01, h - 0.03))
    door = box(w / 2 - 0.03, 0.02, 0.62 * h, 0.06)
    panel = box(w / 2 - 0.11, 0.008, 0.62 * h - 0.08, 0.06)
    knob = ball(0.022, 14)
    pieces = []
    for k, x in enumerate((-1, 1)):
        at = (x * (w / 4 - 0.007), -d / 2 - 0.01, 0.1)
        pieces += [
            Piece(
                "door",
                "",
                join([door.moved(at), panel.moved((at[0], at[1] - 0.013, at[2] + 0.04))]),
                front,
                k,
            ),
            Piece("door", "knob", knob.moved((x * 0.045, -d / 2 - 0.04, 0.1 + 0.36 * h)), brass, k),
        ]
    drawer = box(w - 0.04, 0.02, 0.17 * h, 0.06).moved((0, -d / 2 - 0.01, h - 0.03 - 0.19 * h))
    pulls = [knob.moved((x * w / 4, -d / 2 - 0.04, h - 0.03 - 0.105 * h)) for x in (-1, 1)]
    return Thing("cabinet", colour, (
        Piece("body", "", join([body, lid]), coat),
        Piece("drawer", "", drawer, front),
        Piece("drawer", "knob", join(pulls), brass),
        Piece("leg", "", join(feet), coat),
        *pieces,
    ))  # fmt: skip


def picture(kit: Kit, colour: str) -> Thing:
    """Hangs in the plane y = 0, facing -y, its lower edge at z = 0."""
    w, h, b = kit.size(0.6, 0.9), kit.size(0.45, 0.6), 0.04
    sides = [
        box(w, 0.03, b, 0.04), box(w, 0.03, b, 0.04).moved((0, 0, h - b)),
        box(b, 0.03, h, 0.04).moved((b / 2 - w / 2, 0, 0)),
        box(b, 0.03, h, 0.04).moved((w / 2 - b / 2, 0, 0)),
    ]  # fmt: skip
    canvas = sheet(w - b, h - b, 0.03).spun("x", 90).moved((0, -0.008, h / 2))
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
        upright = sheet(ROOM, WALL_HEIGHT, 0.1).spun("x", 90)
        wall = upright.moved((0, ROOM / 2, WALL_HEIGHT / 2)).spun("z", 90 * k)
        paint = kit.wall_paint(str(word))
        skirting = box(ROOM, 0.02, 0.09, 0.1).moved((0, ROOM / 2 - 0.01, 0)).spun("z", 90 * k)
        things.append(Thing("wall", paint.word, (
            Piece("wall", "", wall, paint),
            Piece("wall", "skirting", skirting, kit.paint("white", gloss=0.1)),
        )))  # fmt: skip
    return things
