"""Builders of tools, devices and instruments. Each takes a `Kit` and a colour word; front is -y, metres."""

import numpy as np

from langsplat_core.lab.world.geometry.shapes import (
    Mesh,
    arc,
    ball,
    box,
    cylinder,
    join,
    lathe,
    rotation_about,
    sheet,
    tube,
)
from langsplat_core.lab.world.geometry.solids import pillow, plate_of, ring, rod, smooth_outline
from langsplat_core.lab.world.objects.kit import Kit, Piece, Thing


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
    inside = Mesh(points - 0.002 * normals, cells[:, ::-1], -normals)
    wedge = (np.arange(wide * 8).reshape(8, wide) % wide // 5 % 2).ravel()
    odd = np.concatenate([wedge, wedge]) == 1
    rib = [rod((0, 0, h - 0.06), rotation_about("z", 45 * k) @ (0.6 * r, 0, h - 0.25 * r), 0.0018, around=6)
           for k in range(8)]  # fmt: skip
    hook = tube(
        np.concatenate([arc((0.022, 0.03), 0.022, 340, 180, 12)[:, :], [[0, 0, 0.05], [0, 0, 0.075]]]),
        0.0075,
        12,
    )
    canopy = kit.cloth(colour)
    return Thing("umbrella", colour, (
        Piece("canopy", "", join([Mesh(points, cells[~odd], normals), inside]), canopy),
        Piece("canopy", "panels", Mesh(points, cells[odd], normals), kit.cloth(kit.pick(colour, second))),
        Piece("shaft", "", join([rod((0, 0, 0.07), (0, 0, h + 0.02), 0.0045), *rib]), kit.metal()),
        Piece("handle", "", hook, kit.wood(kit.pick("brown", "beige"))),
    ))  # fmt: skip


def camera(kit: Kit, colour: str) -> Thing:
    w, h, d = kit.size(0.13, 0.15), kit.size(0.08, 0.09), 0.045
    trim = kit.paint(kit.other(colour, "black", "gray", "brown"), "rug", 0.1, substance="plastic")
    upright = rotation_about("x", 90)
    middle = (0.01, -d / 2 + 0.006, 0.47 * h)
    barrel = lathe(
        [
            (0.033, 0.0),
            (0.033, 0.022),
            (0.029, 0.023),
            (0.029, 0.04),
            (0.025, 0.042),
            (0.023, 0.034),
            (0, 0.03),
        ],
        32,
    )
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
    glass = sheet(0.92 * w, 0.84 * d, 0.012).turned(rotation_about("x", 90)).moved((0, -0.0042, 0.49 * d))
    second = kit.pick("blue", "turquoise", "purple", "green")
    picture = kit.pattern(second, kit.other(second, "white", "pink", "orange"), "painting", 0.5)
    ink = kit.plastic(kit.other(colour, "black", "white", "gray"))
    logo = cylinder(0.012, 0.001, 20).turned(rotation_about("x", -90)).moved((0, 0.0036, 0.5 * d))
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
        Mesh(sea.vertices, sea.triangles[keep], sea.normals).turned(tilt).moved((0, 0, up))
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
    half = [
        (0.0, -0.28),
        (0.13, -0.255),
        (0.175, -0.16),
        (0.125, -0.045),
        (0.085, 0.02),
        (0.115, 0.09),
        (0.085, 0.15),
        (0.0, 0.165),
    ]
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
