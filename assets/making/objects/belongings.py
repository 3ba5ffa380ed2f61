"""Builders of tools, devices, instruments, clothes, model buildings and outdoor things.

Each takes a `Kit` and a colour word; front is -y, metres.
"""

import numpy as np

from assets.making.kit import (
    Kit,
    Piece,
    Thing,
    TriMesh,
    arc,
    ball,
    box,
    cone,
    cylinder,
    join,
    lathe,
    pillow,
    plate_of,
    ring,
    rod,
    rotation_about,
    sheet,
    slab,
    smooth_outline,
    tube,
)
from langsplat_core.arrays import Array


def scissors(kit: Kit, colour: str) -> Thing:
    """Lying open, grips towards +x."""
    n, open_by = kit.size(0.085, 0.1), kit.size(16, 26)
    steel, grip = kit.metal(), kit.plastic(colour)
    outline = np.array([(-n, -0.001), (-0.3 * n, -0.011), (0.25 * n, -0.011), (0.3 * n, 0.009), (0.0, 0.012)])
    oval = ring(0.024, 0.0075, 28, 10).stretched((1.35, 1, 1.05))
    pieces = []
    for k, side in enumerate((1, -1)):
        turn = rotation_about("z", side * open_by)
        flip = outline if side > 0 else outline[::-1] * (1, -1)
        blade = plate_of(flip, 0.004, (-0.1 * n, 0)).moved((0, 0, 0.003 + 0.0045 * k))
        eye = oval.moved((0.3 * n + 0.038, -side * 0.016, 0.0079))
        shank = rod((0.16 * n, 0, 0.0079), (0.3 * n + 0.014, -side * 0.012, 0.0079), 0.0075)
        pieces += [
            Piece("blade", "", blade.turned(turn), steel, k),
            Piece("handle", "", join([eye, shank]).turned(turn), grip, k),
        ]
    return Thing("scissors", colour, (*pieces, Piece("screw", "", cylinder(0.007, 0.014, 18), kit.metal())))


def umbrella(kit: Kit, colour: str) -> Thing:
    """Open, standing on its hook: canopy above, shaft, bent handle."""
    r, h = kit.size(0.13, 0.15), kit.size(0.22, 0.25)
    second = kit.other(colour, "white", "yellow", "red", "blue", "black")
    wide = 8 * 5
    turn = np.linspace(0, 2 * np.pi, wide + 1)
    lift = np.linspace(0, 1, 9)
    scallop = 1 - 0.1 * np.abs(np.sin(4 * turn))
    radius = np.sin(lift * np.pi * 0.46)[:, None] * r * (1 - (1 - scallop) * lift[:, None] ** 2)
    height = h - 0.62 * r * (1 - np.cos(lift * np.pi * 0.46))[:, None] + 0 * turn
    grid = np.stack([radius * np.cos(turn), radius * np.sin(turn), height], -1)
    dome = lathe([(r * float(s), 0.0) for s in lift], wide, cell=1.0)
    outward = grid - (0, 0, h - r)
    normals = (outward / np.linalg.norm(outward, axis=-1, keepdims=True)).reshape(-1, 3)
    cells = dome.triangles[:, ::-1]
    points = grid.reshape(-1, 3)
    inside = TriMesh(points - 0.002 * normals, cells[:, ::-1], -normals)
    wedge = (np.arange(wide * 8).reshape(8, wide) % wide // 5 % 2).ravel()
    odd = np.concatenate([wedge, wedge]) == 1
    rib = [rod((0, 0, h - 0.06), rotation_about("z", 45 * k) @ (0.6 * r, 0, h - 0.25 * r), 0.0018, around=6)
           for k in range(8)]  # fmt: skip
    hook = tube(np.concatenate([arc((0.022, 0.03), 0.022, 340, 180, 12),
                                [[0, 0, 0.05], [0, 0, 0.075]]]), 0.0075, 12)  # fmt: skip
    canopy = kit.cloth(colour)
    return Thing("umbrella", colour, (
        Piece("canopy", "", join([TriMesh(points, cells[~odd], normals), inside]), canopy),
        Piece("canopy", "panels", TriMesh(points, cells[odd], normals), kit.cloth(kit.pick(colour, second))),
        Piece("shaft", "", join([rod((0, 0, 0.07), (0, 0, h + 0.02), 0.0045), *rib]), kit.metal()),
        Piece("handle", "", hook, kit.wood(kit.pick("brown", "beige"))),
    ))  # fmt: skip


def camera(kit: Kit, colour: str) -> Thing:
    w, h, d = kit.size(0.13, 0.15), kit.size(0.08, 0.09), 0.045
    trim = kit.paint(kit.other(colour, "black", "gray", "brown"), "rug", 0.1, substance="plastic")
    upright = rotation_about("x", 90)
    middle = (0.01, -d / 2 + 0.006, 0.47 * h)
    barrel = lathe([(0.033, 0.0), (0.033, 0.022), (0.029, 0.023), (0.029, 0.04), (0.025, 0.042),
                    (0.023, 0.034), (0, 0.03)], 32)  # fmt: skip
    glass = ball(0.022, 22).stretched((1, 1, 0.4)).moved((0, 0, 0.029))
    hump = pillow(0.05, 0.8 * d, 0.03, 6, 20).moved((0.01, 0, h - 0.01))
    flash = box(0.026, 0.006, 0.012).moved((0.01, -0.4 * d, h + 0.001))
    button = cylinder(0.009, 0.012, 18).moved((-0.36 * w, 0, h))
    dial = cylinder(0.013, 0.009, 20).moved((0.36 * w, 0, h))
    grip = pillow(w * 1.01, d * 1.03, h * 0.5, 9, 32).moved((0, 0, 0.2 * h))
    return Thing("camera", colour, (
        Piece("body", "", join([pillow(w, d, h, 9, 32), hump]), kit.plastic(colour)),
        Piece("body", "grip", grip, trim),
        Piece("lens", "", barrel.turned(upright).moved(middle), kit.steel(kit.pick("black", "gray"))),
        Piece("lens", "lens glass", glass.turned(upright).moved(middle),
              kit.glass(kit.pick("blue", "purple"))),
        Piece("button", "", button, kit.plastic(kit.other(colour, "red", "orange")), 0),
        Piece("button", "", dial, kit.metal(), 1),
        Piece("flash", "", flash, kit.glass("white")),
    ))  # fmt: skip


def laptop(kit: Kit, colour: str) -> Thing:
    w, d, t = kit.size(0.2, 0.23), kit.size(0.14, 0.155), 0.01
    shell = kit.steel(colour)
    base = box(w, d, t)
    keys = [
        box(0.82 * w / 11, 0.085 * d, 0.003).moved(((i - 5) * 0.9 * w / 11, 0.32 * d - j * 0.115 * d, t))
        for j in range(5) for i in range(11)
    ]  # fmt: skip
    pad = box(0.3 * w, 0.22 * d, 0.001).moved((0, -0.32 * d, t))
    lean = rotation_about("x", -kit.size(12, 28))
    hinge = (0.0, d / 2, t)
    panel = box(w, 0.007, 0.95 * d)
    glass = sheet(0.92 * w, 0.84 * d, 0.012).spun("x", 90).moved((0, -0.0042, 0.49 * d))
    second = kit.pick("blue", "turquoise", "purple", "green")
    picture = kit.pattern(second, kit.other(second, "white", "pink", "orange"), "painting", 0.5)
    ink = kit.plastic(kit.other(colour, "black", "white", "gray"))
    logo = cylinder(0.012, 0.001, 20).spun("x", -90).moved((0, 0.0036, 0.5 * d))
    return Thing("laptop", colour, (
        Piece("base", "", base, shell),
        Piece("base", "touchpad", pad, kit.metal()),
        Piece("keyboard", "", join([box(0.94 * w, 0.62 * d, 0.0008).moved((0, 0.09 * d, t))]),
              kit.plastic("black")),
        Piece("keyboard", "keys", join(keys), ink),
        Piece("screen", "", panel.turned(lean).moved(hinge), shell),
        Piece("screen", "display", glass.turned(lean).moved(hinge), picture),
        Piece("screen", "logo", logo.turned(lean).moved(hinge), ink),
    ))  # fmt: skip


def headphones(kit: Kit, colour: str) -> Thing:
    """Standing on the two ear cups, headband above."""
    r, h = kit.size(0.065, 0.075), kit.size(0.055, 0.06)
    coat = kit.plastic(colour)
    foam = kit.paint(kit.other(colour, "black", "gray", "brown"), "cloth", 0.02)
    path = np.concatenate([[[r, 0, h * 0.7]], arc((0, h + 0.4 * r), r, 0, 180, 24), [[-r, 0, h * 0.7]]])
    band = tube(path, 0.0105, 12).stretched((1, 1.9, 1))
    padding = tube(arc((0, h + 0.4 * r), r - 0.011, 30, 150, 14), 0.008, 10).stretched((1, 2, 1))
    pieces = []
    for k, x in enumerate((-1, 1)):
        turn = rotation_about("y", x * 90)
        cup = pillow(0.09, 0.09, 0.03, 4, 28)
        soft = ring(0.03, 0.013, 28, 12).moved((0, 0, -0.004))
        place = (x * (r - 0.006), 0, 0.047)
        pieces += [
            Piece("ear cup", "", cup.turned(turn).moved(place), coat, k),
            Piece("ear cup", "ear pad", soft.turned(turn).moved(place), foam, k),
        ]
    return Thing("headphones", colour, (
        Piece("headband", "", band, coat), Piece("headband", "padding", padding, foam), *pieces,
    ))  # fmt: skip


def globe(kit: Kit, colour: str) -> Thing:
    """Seas of the main colour, land in another, in a tilted arc on a foot."""
    r = kit.size(0.075, 0.09)
    tilt, up = rotation_about("y", 23), 1.75 * r
    sea = ball(r, 44)
    land = kit.other(colour, "green", "brown", "beige", "yellow", "white")
    seed = kit.rng.normal(0, 1, (3, 9))
    wave = sum(np.cos(sea.normals @ (2.3 * seed[:, k]) + 2 * k) for k in range(9))
    dry = np.greater(wave, np.quantile(wave, 0.68))[sea.triangles].sum(1) >= 2
    parts = [
        TriMesh(sea.vertices, sea.triangles[keep], sea.normals).turned(tilt).moved((0, 0, up))
        for keep in (~dry, dry)
    ]
    bow = tube(arc((0, 0), 1.16 * r, -90, 90, 24), 0.007, 10).turned(tilt).moved((0, 0, up))
    pins = [
        rod(tilt @ (0, 0, s * 0.95 * r) + (0, 0, up), tilt @ (0, 0, s * 1.2 * r) + (0, 0, up), 0.0045)
        for s in (-1, 1)
    ]
    foot = lathe(
        [(0, 0), (0.68 * r, 0), (0.66 * r, 0.014), (0.25 * r, 0.028), (0.12 * r, 0.06), (0.1 * r, 0.6 * r)],
        32,
    )
    metal = kit.steel(kit.pick("yellow", "gray"))
    return Thing("globe", colour, (
        Piece("sphere", "", parts[0], kit.paint(colour, gloss=0.5)),
        Piece("sphere", "land", parts[1], kit.paint(land, gloss=0.4)),
        Piece("bracket", "", join([bow, *pins]), metal),
        Piece("foot", "", foot, kit.wood(kit.pick("brown", "black"))),
    ))  # fmt: skip


def guitar(kit: Kit, colour: str) -> Thing:
    """Lying on its back, neck towards +y."""
    n = kit.size(0.3, 0.34)
    half = [(0.0, -0.28), (0.13, -0.255), (0.175, -0.16), (0.125, -0.045), (0.085, 0.02), (0.115, 0.09),
            (0.085, 0.15), (0.0, 0.165)]  # fmt: skip
    outline = smooth_outline(half + [(-x, y) for x, y in half[-2:0:-1]], 64) * n + (0, -0.2 * n)
    inner = (outline - (0, -0.25 * n)) * 0.95 + (0, -0.25 * n)
    board = plate_of(outline, 0.034, (0, -0.25 * n))
    front = plate_of(inner, 0.002, (0, -0.25 * n)).moved((0, 0, 0.0335))
    hole = cylinder(0.052 * n, 0.0015, 28).moved((0, -0.2 * n, 0.0355))
    rose = ring(0.056 * n, 0.003, 32, 8).moved((0, -0.2 * n, 0.0355))
    neck = box(0.05 * n, 0.5 * n, 0.012).moved((0, 0.15 * n, 0.032))
    head = box(0.075 * n, 0.12 * n, 0.012).moved((0, 0.45 * n, 0.03))
    pegs = [rod((x * 0.03 * n, y * n, 0.036), (x * 0.065 * n, y * n, 0.036), 0.005)
            for x in (-1, 1) for y in (0.42, 0.455, 0.49)]  # fmt: skip
    bridge = box(0.13 * n, 0.022 * n, 0.008).moved((0, -0.36 * n, 0.035))
    lines = [rod((x * 0.011 * n, -0.36 * n, 0.0455), (x * 0.009 * n, 0.44 * n, 0.0455), 0.0009, around=5)
             for x in (-1.5, -0.5, 0.5, 1.5)]  # fmt: skip
    dark = kit.wood(kit.other(colour, "brown", "black"))
    return Thing("guitar", colour, (
        Piece("body", "", join([board]), kit.wood(colour)),
        Piece("body", "front", front,
              kit.paint(kit.other(colour, "beige", "orange", "brown", "white"), "wood", 0.4)),
        Piece("body", "hole", join([hole, rose]), kit.paint("black")),
        Piece("body", "bridge", bridge, dark),
        Piece("neck", "", neck, dark),
        Piece("head", "", head, dark),
        Piece("head", "pegs", join(pegs), kit.metal()),
        Piece("strings", "", join(lines), kit.metal()),
    ))  # fmt: skip


def drum(kit: Kit, colour: str) -> Thing:
    r, h = kit.size(0.075, 0.09), kit.size(0.095, 0.115)
    hoop = kit.plastic(kit.other(colour, "red", "yellow", "blue", "white", "black"))
    hoops = [ring(r * 1.01, 0.0075, 40, 8).moved((0, 0, z)) for z in (0.008, h)]
    cords = []
    for k in range(8):
        low, high, after = (rotation_about("z", 22.5 * (2 * k + s)) @ (1.025 * r, 0, 0) for s in (0, 1, 2))
        cords += [rod(low + (0, 0, 0.012), high + (0, 0, h - 0.004), 0.0026, around=5),
                  rod(high + (0, 0, h - 0.004), after + (0, 0, 0.012), 0.0026, around=5)]  # fmt: skip
    sticks = []
    for k, s in enumerate((-1, 1)):
        turn = rotation_about("z", s * kit.size(18, 35) + 90)
        stick = join(
            [rod((-1.2 * r, 0, 0), (0.75 * r, 0, 0), 0.0055), ball(0.0125, 14).moved((0.8 * r, 0, 0))]
        )
        sticks.append(stick.turned(turn).moved((s * 0.2 * r, 0, h + 0.021 + 0.0 * k)))
    skin = cylinder(0.985 * r, 0.004, 40, 0.03).moved((0, 0, h - 0.001))
    return Thing("drum", colour, (
        Piece("body", "", lathe([(0, 0.002), (r, 0.002), (r, h)], 40, 0.02), kit.plastic(colour)),
        Piece("body", "cord", join(cords), kit.paint(kit.other(colour, "white", "yellow"))),
        Piece("hoop", "", join(hoops), hoop),
        Piece("drumhead", "", skin, kit.paint(kit.other(colour, "white", "beige"), gloss=0.1)),
        Piece("drumstick", "", sticks[0], kit.wood(kit.pick("brown", "beige")), 0),
        Piece("drumstick", "", sticks[1], kit.wood(kit.pick("brown", "beige")), 1),
    ))  # fmt: skip


def hat(kit: Kit, colour: str) -> Thing:
    """A sun hat with a wide brim and a band."""
    r = kit.size(0.07, 0.08)
    brim = lathe(
        [(1.0 * r, 0.012), (1.95 * r, 0.004), (2.0 * r, 0.008), (1.95 * r, 0.011), (1.0 * r, 0.02)], 48
    )
    turn = np.arctan2(brim.vertices[:, 1], brim.vertices[:, 0])
    far = np.clip(np.hypot(brim.vertices[:, 0], brim.vertices[:, 1]) / r - 1, 0, 1)
    wave = 0.012 * (1 + np.cos(2 * turn + kit.size(0, 6))) * far
    bent = TriMesh(brim.vertices + np.stack([0 * wave, 0 * wave, wave], 1), brim.triangles, brim.normals)
    crown = lathe([(1.02 * r, 0.014), (0.97 * r, 0.05), (0.85 * r, 0.082), (0.5 * r, 0.1), (0, 0.104)], 40)
    band = lathe([(1.045 * r, 0.018), (1.02 * r, 0.042)], 40)
    loops = [
        ball(0.5, 14).stretched((0.03, 0.012, 0.02)).spun("y", s * 25).moved((s * 0.015, 0, 0))
        for s in (-1, 1)
    ]
    bow = join([*loops, ball(0.008, 10)]).moved((0, -1.07 * r, 0.03))
    straw = kit.paint(colour, "cloth", 0.02)
    ribbon = kit.cloth(kit.other(colour, "red", "blue", "black", "white", "purple", "green"))
    return Thing("hat", colour, (
        Piece("brim", "", bent, straw),
        Piece("crown", "", crown, straw),
        Piece("band", "", band, ribbon),
        Piece("band", "bow", bow, ribbon),
    ))  # fmt: skip


def shoe(kit: Kit, colour: str) -> Thing:
    """A trainer, toe towards -x."""
    n = kit.size(0.18, 0.2)
    around = [(-0.5, 0.02), (-0.36, -0.19), (-0.1, -0.17), (0.2, -0.13), (0.46, -0.14), (0.5, 0),
              (0.46, 0.14), (0.2, 0.13), (-0.1, 0.17), (-0.36, 0.17)]  # fmt: skip
    outline = smooth_outline(around, 60) * n
    sole = plate_of(outline, 0.022)
    place = np.linspace(0, 1, 15)
    along = n * (-0.47 + 0.95 * place)
    top = 0.02 + n * np.interp(place, [0, 0.12, 0.35, 0.6, 0.8, 1], [0.03, 0.15, 0.23, 0.42, 0.43, 0.46])
    half = n * np.interp(place, [0, 0.1, 0.3, 0.6, 0.9, 1], [0.03, 0.12, 0.16, 0.125, 0.125, 0.07])
    angle = np.linspace(0, np.pi, 17)
    across = half[:, None] * np.sign(np.cos(angle)) * np.abs(np.cos(angle)) ** 0.6
    rise = 0.012 + (top[:, None] - 0.012) * np.sin(angle) ** 0.7
    lid = np.stack([np.repeat(along[:, None], 17, 1), across, rise], -1)
    grid = lathe([(1.0, float(k)) for k in range(15)], 16, cell=10.0).triangles
    points = lid.reshape(-1, 3)
    upper = TriMesh(points, grid, _outward(points, (0.05 * n, 0, 0.02)))
    hole = ball(0.5, 22).stretched((0.36 * n, 0.19 * n, 0.03)).spun("y", -5)
    hole = hole.moved((0.25 * n, 0, 0.02 + 0.425 * n))
    collar = ring(0.5, 0.09, 28, 10).stretched((0.36 * n, 0.2 * n, 0.12))
    collar = collar.moved((0.25 * n, 0, 0.022 + 0.42 * n))
    laces = [rod((x * n, -0.07 * n, 0.03 + z * n), (x * n, 0.07 * n, 0.03 + z * n), 0.0055)
             for x, z in ((-0.18, 0.2), (-0.115, 0.235), (-0.05, 0.285), (0.015, 0.335))]  # fmt: skip
    cap = ball(0.5, 20).stretched((0.26 * n, 0.31 * n, 0.2 * n)).moved((-0.34 * n, 0, 0.03))
    coat = kit.cloth(colour)
    white = kit.paint(kit.other(colour, "white", "white", "gray", "black"), gloss=0.2, substance="rubber")
    hook = smooth_outline([(-0.1, 0.1), (0.06, 0.12), (0.22, 0.26), (0.04, 0.18)], 24) * n
    stripe = plate_of(hook, 0.003, (0.04 * n, 0.15 * n)).spun("x", 90)
    swoosh = [stripe.moved((0.06 * n, y * (0.135 * n) + 0.002, 0.0)) for y in (-1, 1)]
    return Thing("shoe", colour, (
        Piece("sole", "", sole, white),
        Piece("upper", "", join([upper, collar]), coat),
        Piece("upper", "toe", cap, kit.paint(kit.pick("white", colour), gloss=0.2, substance="rubber")),
        Piece("upper", "opening", hole, kit.cloth(kit.other(colour, "black", "gray"))),
        Piece("upper", "stripe", join(swoosh),
              kit.plastic(kit.other(colour, "white", "yellow", "black", "red"))),
        Piece("laces", "", join(laces), kit.cloth(kit.other(colour, "white", "yellow", "black"))),
    ))  # fmt: skip


def _outward(points: Array, centre: tuple[float, float, float]) -> Array:
    away = points - np.array(centre)
    return away / np.linalg.norm(away, axis=1, keepdims=True)


def backpack(kit: Kit, colour: str) -> Thing:
    w, d, h = kit.size(0.13, 0.15), 0.08, kit.size(0.18, 0.21)
    coat = kit.cloth(colour)
    second = kit.cloth(kit.other(colour, "yellow", "blue", "red", "gray", "black", "green"))
    pocket = pillow(0.78 * w, 0.055, 0.46 * h, 5, 28).moved((0, -0.46 * d - 0.012, 0.02))
    flap = pillow(w * 1.03, d * 1.08, 0.26 * h, 4, 30).moved((0, -0.004, 0.76 * h))
    zipper = rod((-0.27 * w, -0.46 * d - 0.04, 0.38 * h), (0.27 * w, -0.46 * d - 0.04, 0.38 * h), 0.004)
    loop = tube(arc((0, 1.0 * h), 0.026, 0, 180, 14), 0.006, 10)
    buckle = box(0.022, 0.008, 0.03).moved((0, -0.56 * d, 0.7 * h))
    line = np.array([(0, 0.4, 0.94), (0, 0.85, 0.8), (0, 1.0, 0.5), (0, 0.8, 0.2), (0, 0.42, 0.08)]) * (
        1,
        d,
        h,
    )
    fine = np.linspace(0, 4, 17)
    path = np.stack([np.interp(fine, np.arange(5), line[:, c]) for c in range(3)], 1)
    straps = [tube(path, 0.009, 10).stretched((1.7, 1, 1)).moved((x * 0.27 * w, 0, 0)) for x in (-1, 1)]
    return Thing("backpack", colour, (
        Piece("body", "", pillow(w, d, h, 5, 32), coat),
        Piece("flap", "", flap, second),
        Piece("flap", "buckle", buckle, kit.steel(kit.pick("gray", "yellow"))),
        Piece("pocket", "", pocket, kit.cloth(kit.pick(colour, second.word))),
        Piece("pocket", "zip", zipper, kit.steel(kit.pick("gray", "yellow"))),
        Piece("strap", "", join(straps), second),
        Piece("handle", "", loop, second),
    ))  # fmt: skip


def snowman(kit: Kit, colour: str) -> Thing:
    """White; `colour` is the scarf's and the hat's."""
    r = kit.size(0.06, 0.07)
    snow = kit.paint("white", "peel", 0.1, 8)
    up = (0.92 * r, 2.3 * r, 3.3 * r)
    coal = kit.paint("black", gloss=0.5)
    snowballs = [ball(r, 26).moved((0, 0, up[0])), ball(0.75 * r, 24).moved((0, 0, up[1]))]
    buttons = [ball(0.08 * r, 10).moved((0, -0.72 * r, z * r)) for z in (2.05, 2.35)]
    buttons.append(ball(0.08 * r, 10).moved((0, -0.93 * r, 1.25 * r)))
    eyes = [ball(0.075 * r, 10).moved((x * 0.2 * r, -0.5 * r, up[2] + 0.14 * r)) for x in (-1, 1)]
    nose = cone(0.09 * r, 0.55 * r, around=14).spun("x", 90).moved((0, -0.48 * r, up[2]))
    scarf_paint = kit.cloth(kit.other(colour, "red", "blue", "green", "yellow", "purple"))
    tail = slab([(0.0, 0), (0.26 * r, 0), (0.26 * r, 0.85 * r), (0.0, 0.85 * r)], 0.16 * r)
    tail = tail.spun("x", -14).moved((0.2 * r, -0.84 * r, 1.95 * r))
    scarf = join([ring(0.5 * r, 0.16 * r, 28, 12).moved((0, 0, 2.86 * r)), tail])
    brim = cylinder(0.66 * r, 0.06 * r, 28).moved((0, 0, up[2] + 0.46 * r))
    top = cylinder(0.42 * r, 0.6 * r, 28).moved((0, 0, up[2] + 0.5 * r))
    ribbon = cylinder(0.435 * r, 0.14 * r, 28).moved((0, 0, up[2] + 0.53 * r))
    twigs = []
    for x in (-1, 1):
        end = np.array([x * 1.5 * r, -0.1 * r, 2.9 * r])
        twigs += [rod((x * 0.6 * r, 0, 2.3 * r), end, 0.006, 0.004),
                  rod(end * (0.85, 1, 0.95), end + (0.0, 0, 0.3 * r), 0.0035)]  # fmt: skip
    felt = kit.cloth(colour)
    return Thing("snowman", "white", (
        Piece("body", "", join(snowballs), snow),
        Piece("body", "buttons", join(buttons), coal),
        Piece("head", "", ball(0.55 * r, 22).moved((0, 0, up[2])), snow),
        Piece("head", "eyes", join(eyes), coal),
        Piece("head", "nose", nose, kit.paint("orange")),
        Piece("scarf", "", scarf, scarf_paint),
        Piece("hat", "", join([brim, top]), felt),
        Piece("hat", "ribbon", ribbon, scarf_paint),
        Piece("arm", "", join(twigs), kit.paint("brown", "wood", 0.1)),
    ))  # fmt: skip


def windmill(kit: Kit, colour: str) -> Thing:
    r, h = kit.size(0.058, 0.066), kit.size(0.15, 0.18)
    tower = cone(r, h, 0.66 * r, 28)
    roof = lathe([(0.84 * r, h - 0.004), (0.5 * r, h + 0.035), (0, h + 0.062)], 28)
    hub = np.array([0.0, -0.88 * r, h - 0.012])
    turn = kit.size(0, 90)
    arms, sails = [], []
    for k in range(4):
        spin = rotation_about("y", turn + 90 * k)
        arms.append(box(0.007, 0.006, 0.125).turned(spin).moved(hub))
        sails.append(box(0.034, 0.003, 0.088).moved((0.019, 0, 0.034)).turned(spin).moved(hub))
    axle = rod(hub + (0, 0.3 * r, 0), hub - (0, 0.008, 0), 0.009)
    door = box(0.036, 0.008, 0.058).moved((0, -0.96 * r, 0))
    pane = box(0.024, 0.01, 0.026).moved((0, -0.85 * r, 0.54 * h))
    panes = [pane.spun("z", angle) for angle in (0, 90, 180, 270)]
    return Thing("windmill", colour, (
        Piece("tower", "", tower, kit.paint(colour, "plaster", 0.05)),
        Piece("tower", "door", door, kit.wood(kit.other(colour, "brown", "green", "red"))),
        Piece("tower", "window", join(panes), kit.glass(kit.other(colour, "turquoise", "blue"))),
        Piece("roof", "", roof, kit.paint(kit.other(colour, "red", "brown", "blue", "gray"))),
        Piece("sail", "", join(sails), kit.cloth(kit.other(colour, "white", "beige", "red", "yellow"))),
        Piece("sail", "arm", join([*arms, axle]), kit.wood()),
    ))  # fmt: skip


def castle(kit: Kit, colour: str) -> Thing:
    a, h = kit.size(0.075, 0.085), kit.size(0.07, 0.085)
    stone = kit.paint(colour, "plaster", 0.05, 20)
    walls, teeth, towers = [], [], []
    for k in range(4):
        turn = rotation_about("z", 90 * k)
        walls.append(box(2 * a, 0.016, h).moved((0, -a, 0)).turned(turn))
        teeth += [
            box(0.015, 0.017, 0.014).moved((x * a, -a, h)).turned(turn) for x in (-0.52, -0.17, 0.17, 0.52)
        ]
        towers.append(cylinder(0.027, 1.3 * h, 20, 0.03).moved((-a, -a, 0)).turned(turn))
    crown = [cylinder(0.03, 0.012, 24).moved((-a, -a, 1.3 * h)).spun("z", 90 * k) for k in range(4)]
    roofs = [
        cone(0.034, 0.062, around=20).moved((-a, -a, 1.3 * h + 0.012)).spun("z", 90 * k) for k in range(4)
    ]
    top = 1.3 * h + 0.07
    pole = [rod((-a, -a, top - 0.01), (-a, -a, top + 0.036), 0.002, around=6),
            slab([(0, 0), (0.03, 0.009), (0, 0.018)], 0.003).moved((-a, -a, top + 0.018))]  # fmt: skip
    flags = [join(pole).spun("z", 180 * k) for k in range(2)]
    arch = [(-0.02, 0.0), (0.02, 0.0), (0.02, 0.03), (0.014, 0.044), (0.0, 0.05), (-0.014, 0.044),
            (-0.02, 0.03)]  # fmt: skip
    gate = slab(arch, 0.006).moved((0, -a - 0.009, 0))
    keep = box(0.08, 0.08, 1.5 * h).moved((0, 0.01, 0))
    keep_teeth = [box(0.016, 0.016, 0.014).moved((x * 0.032, 0.01 + y * 0.032, 1.5 * h))
                  for x in (-1, 0, 1) for y in (-1, 0, 1) if x or y]  # fmt: skip
    return Thing("castle", colour, (
        Piece("wall", "", join([*walls, *teeth, keep, *keep_teeth]), stone),
        Piece("wall", "gate", gate, kit.wood(kit.other(colour, "brown", "black"))),
        Piece("tower", "", join([*towers, *crown]), stone),
        Piece("tower", "roof", join(roofs), kit.paint(kit.other(colour, "red", "blue", "purple", "green"))),
        Piece("tower", "flag", join(flags), kit.cloth(kit.other(colour, "yellow", "red", "blue"))),
    ))  # fmt: skip


def cactus(kit: Kit, colour: str) -> Thing:
    """Green, with two arms, flowers and spines, in a pot of the given colour."""
    r, h = kit.size(0.03, 0.036), kit.size(0.15, 0.19)
    pot = lathe([(0, 0), (0.05, 0), (0.062, 0.062)], 32, 0.02)
    lip = lathe([(0.066, 0.06), (0.067, 0.075), (0.058, 0.075), (0.056, 0.06)], 32, 0.006)
    soil = lathe([(0.058, 0.066), (0, 0.068)], 28)
    trunk = rod((0, 0, 0.06), (0, 0, 0.06 + h - r), r, around=28)
    angle = np.arctan2(trunk.vertices[:, 1], trunk.vertices[:, 0])
    ribbed = trunk.vertices * np.stack([1 + 0.14 * np.cos(9 * angle)] * 2 + [np.ones_like(angle)], 1)
    arms = []
    for x in (-1, 1):
        low, reach = kit.size(0.35, 0.6) * h, 0.052
        bend = np.array(
            [(0.5 * r, 0, 0), (0.75 * reach, 0, 0.002), (reach, 0, 0.014), (reach + 0.002, 0, 0.055)]
        )
        fine = np.linspace(0, 3, 10)
        line = np.stack([np.interp(fine, np.arange(4), bend[:, c]) for c in range(3)], 1) * (x, 1, 1)
        tip = line[-1]
        arms += [
            tube(line, 0.55 * r, 16).moved((0, 0, 0.06 + low)),
            ball(0.55 * r, 16).moved(tip + (0, 0, 0.06 + low)),
        ]
    spines = []
    for _ in range(44):
        turn, z = np.radians(kit.size(0, 360)), kit.size(0.075, 0.05 + h - r)
        out = np.array([np.cos(turn), np.sin(turn), 0.0])
        start = out * r * (1 + 0.14 * np.cos(9 * turn)) + (0, 0, z)
        tip = start + out * 0.009 + (0, 0, 0.003)
        spines.append(tube(np.stack([start, tip]), np.array([0.001, 1e-4]), 4))
    petals = [ball(0.012, 8).stretched((1, 0.6, 0.4)).moved((0.011, 0, 0)).spun("z", 60 * k)
              for k in range(6)]  # fmt: skip
    bloom = join([*petals, ball(0.007, 8)]).moved((0, 0, 0.06 + h))
    green = kit.paint("green", "plain", 0.15, substance="leaf")
    shaft = TriMesh(ribbed, trunk.triangles, trunk.normals)
    return Thing("cactus", "green", (
        Piece("pot", "", join([pot, lip]), kit.paint(colour, "speckled", 0.2, substance="ceramic")),
        Piece("soil", "", soil, kit.paint("brown", "rug", 0.0, substance="skin")),
        Piece("body", "", shaft, green),
        Piece("body", "spines", join(spines), kit.paint("white")),
        Piece("arm", "", join(arms), green),
        Piece("flower", "", bloom, kit.paint(kit.pick("pink", "red", "yellow", "purple"))),
    ))  # fmt: skip
