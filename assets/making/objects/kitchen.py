"""Builders of tableware, small household things and food.

Each takes a `Kit` and a colour word; front is -y, metres.
"""

import numpy as np

from assets.making.kit import (
    Kit,
    Material,
    Piece,
    Thing,
    TriMesh,
    arc,
    ball,
    box,
    cylinder,
    join,
    lathe,
    pillow,
    ring,
    rod,
    rotation_about,
    sheet,
    tube,
)
from langsplat_core.arrays import Array


def mug(kit: Kit, colour: str) -> Thing:
    r, h = kit.size(0.055, 0.07), kit.size(0.12, 0.16)
    coat = kit.paint(colour, kit.pick("plain", "plain", "speckled"), 0.5, substance="ceramic")
    wall = lathe([(0, 0), (r * 0.94, 0), (r, 0.008), (r, h - 0.014)], 36)
    inside = lathe([(r - 0.008, h), (r - 0.009, 0.012), (0, 0.012)], 36)
    edge = lathe([(r, h - 0.014), (r + 0.002, h - 0.003), (r - 0.003, h + 0.002), (r - 0.008, h)], 36, 0.003)
    loop = tube(arc((r - 0.004, h * 0.52), h * 0.3, -82, 82), 0.0105)
    return Thing("mug", colour, (
        Piece("body", "", join([wall, inside]), coat),
        Piece("body", "rim", edge,
              kit.paint(kit.pick(colour, "white", "brown"), gloss=0.5, substance="ceramic")),
        Piece("handle", "", loop, coat),
    ))  # fmt: skip


def teapot(kit: Kit, colour: str) -> Thing:
    r = kit.size(0.085, 0.1)
    coat = kit.paint(colour, kit.pick("plain", "speckled"), 0.6, substance="ceramic")
    profile = [(r * s, r * z) for s, z in ((0, 0), (0.62, 0), (0.9, 0.25), (1, 0.62), (0.9, 1.0), (0.5, 1.3))]
    band = [(r * 1.006, r * 0.55), (r * 1.008, r * 0.7)]
    lid = lathe([(0.52 * r, 1.29 * r), (0.4 * r, 1.42 * r), (0.12 * r, 1.5 * r), (0, 1.5 * r)])
    line = np.array([(-0.8, 0, 0.5), (-1.25, 0, 0.68), (-1.5, 0, 1.0), (-1.72, 0, 1.28)])
    spout = tube(line * r, np.array([0.3, 0.2, 0.14, 0.12]) * r)
    knob = ball(0.16 * r, 16).moved((0, 0, 1.58 * r))
    handle = tube(arc((0.86 * r, 0.72 * r), 0.48 * r, -78, 78), 0.0105)
    return Thing("teapot", colour, (
        Piece("body", "", lathe(profile, 40), coat),
        Piece("body", "band", lathe(band, 40),
              kit.paint(kit.other(colour, "white", "yellow", "blue"), substance="ceramic")),
        Piece("spout", "", spout, coat),
        Piece("handle", "", handle, coat),
        Piece("lid", "", lid, coat),
        Piece("lid", "knob", knob, kit.paint(kit.pick(colour, "black"), substance="ceramic")),
    ))  # fmt: skip


def bottle(kit: Kit, colour: str) -> Thing:
    r, h = kit.size(0.042, 0.055), kit.size(0.24, 0.3)
    glass = kit.paint(colour, "plain", 0.9, substance="glass")
    s = h * 0.62
    body = lathe([(0, 0), (r, 0.004), (r, s), (r * 0.8, s + 0.025), (r * 0.42, s + 0.05)], 32)
    neck = lathe([(r * 0.42, s + 0.05), (r * 0.38, h - 0.02)], 24)
    cap = lathe([(r * 0.48, h - 0.022), (r * 0.48, h + 0.012), (0, h + 0.014)], 24)
    label = lathe([(r * 1.012, s * 0.3), (r * 1.012, s * 0.75)], 32)
    return Thing("bottle", colour, (
        Piece("body", "", body, glass),
        Piece("body", "label", label, kit.paint(kit.other(colour, "white", "beige", "yellow"), "pages", 0.0)),
        Piece("neck", "", neck, glass),
        Piece("cap", "", cap,
              kit.paint(kit.other(colour, "red", "white", "black", "blue", "yellow"), substance="plastic")),
    ))  # fmt: skip


def bowl(kit: Kit, colour: str) -> Thing:
    r = kit.size(0.12, 0.15)
    coat = kit.paint(colour, kit.pick("plain", "speckled"), 0.5, substance="ceramic")
    out = lathe([(0, 0), (0.4 * r, 0), (0.45 * r, 0.01), (0.8 * r, 0.26 * r), (0.98 * r, 0.56 * r)], 44)
    inside = lathe([(0.93 * r, 0.56 * r), (0.76 * r, 0.28 * r), (0.42 * r, 0.06 * r), (0, 0.05 * r)], 44)
    rim = lathe([(0.98 * r, 0.56 * r), (r, 0.6 * r), (0.96 * r, 0.61 * r), (0.93 * r, 0.56 * r)], 44, 0.004)
    return Thing("bowl", colour, (
        Piece("body", "", join([out, inside]), coat),
        Piece("body", "rim", rim, kit.paint(kit.pick(colour, "blue", "white"), substance="ceramic")),
    ))  # fmt: skip


def vase(kit: Kit, colour: str) -> Thing:
    r, h = kit.size(0.055, 0.07), kit.size(0.17, 0.21)
    profile = ((0, 0), (0.6, 0), (1, 0.3), (0.95, 0.5), (0.5, 0.8), (0.42, 0.88))
    lip = [(0.42 * r, 0.88 * h), (0.6 * r, h), (0.52 * r, h), (0.36 * r, 0.86 * h)]
    coat = kit.paint(colour, kit.pick("plain", "speckled"), 0.6, substance="ceramic")
    bloom = kit.other("green", "red", "yellow", "pink", "purple", "orange", "white")
    petal_paint, pieces = kit.paint(bloom, gloss=0.05, substance="leaf"), []
    for k in range(3):
        lean = rotation_about("z", 120 * k + kit.size(0, 60))
        stalk = np.array([(0, 0, h * 0.8), (0.015, 0, h + 0.05), (0.045, 0, h + 0.13)]) @ lean.T
        head = stalk[-1] + (0, 0, 0.005)
        petals = [
            ball(0.022, 10).stretched((1, 0.7, 0.35)).moved((0.024, 0, 0)).spun("z", 60 * j) for j in range(6)
        ]
        pieces += [Piece("flower", "stem", tube(stalk, 0.0035, 8),
                         kit.paint("green", gloss=0.1, substance="leaf"), k),
                   Piece("flower", "petals", join(petals).moved(head), petal_paint, k)]  # fmt: skip
    return Thing("vase", colour, (
        Piece("body", "", lathe([(a * r, b * h) for a, b in profile], 36), coat),
        Piece("body", "rim", lathe(lip, 36, 0.006), coat),
        *pieces,
    ))  # fmt: skip


def plant(kit: Kit, colour: str) -> Thing:
    r, h = kit.size(0.065, 0.08), kit.size(0.1, 0.13)
    pot = lathe([(0, 0), (0.68 * r, 0), (0.95 * r, h * 0.85)], 36)
    rim = lathe([(r * 1.06, h * 0.84), (1.08 * r, h), (0.94 * r, h), (0.9 * r, h * 0.86)], 36, 0.006)
    soil = lathe([(0.92 * r, h * 0.88), (0, h * 0.9)], 30)
    leaves = []
    for k in range(int(kit.rng.integers(14, 20))):
        length, tilt = kit.size(0.07, 0.11), kit.size(15, 75)
        blade = ball(0.5, 12).stretched((length, length * 0.42, 0.008)).moved((length * 0.62, 0, 0))
        turn = rotation_about("z", 137.5 * k) @ rotation_about("y", -tilt)
        leaves.append(blade.turned(turn).moved((0, 0, h + 0.012 + 0.004 * k)))
    return Thing("plant", "green", (
        Piece("pot", "", pot, (clay := kit.paint(colour, "speckled", 0.1, substance="ceramic"))),
        Piece("pot", "rim", rim, clay),
        Piece("soil", "", soil, kit.paint("brown", "rug", 0.0, substance="skin")),
        Piece("leaves", "", join(leaves), kit.paint("green", "leaf", 0.25, substance="leaf")),
    ))  # fmt: skip


def lamp(kit: Kit, colour: str) -> Thing:
    h, r = kit.size(0.26, 0.34), kit.size(0.09, 0.115)
    foot = kit.paint(kit.other(colour, "black", "gray", "brown", "white"), gloss=0.5, substance="ceramic")
    shade = [(r, h - 0.13), (0.62 * r, h + 0.02)]
    inside = [(0.6 * r, h + 0.02), (r * 0.98, h - 0.13)]
    trim = [(r * 1.01, h - 0.131), (r * 0.978, h - 0.112)]
    cloth = kit.paint(colour, "cloth", 0.05)
    bulb = join(
        [ball(0.028, 18).moved((0, 0, h - 0.062)), cylinder(0.012, 0.03, 14).moved((0, 0, h - 0.115))]
    )
    glow = Material("white", np.array([0.97, 0.97, 0.96]), np.ones(3), "plain", 0.6, "glass")
    base = lathe([(0, 0), (0.65 * r, 0), (0.62 * r, 0.015), (0.2 * r, 0.03), (0, 0.032)])
    return Thing("lamp", colour, (
        Piece("base", "", base, foot),
        Piece("pole", "", cylinder(0.009, h - 0.07, 14).moved((0, 0, 0.02)), kit.metal()),
        Piece("shade", "", join([lathe(shade, 40), lathe(inside, 40)]), cloth),
        Piece("shade", "bulb", bulb, glow),
        Piece("shade", "trim", lathe(trim, 40), kit.paint(kit.other(colour, "white", "brown", "black"))),
    ))  # fmt: skip


def book(kit: Kit, colour: str) -> Thing:
    w, d, t = kit.size(0.15, 0.18), kit.size(0.21, 0.25), kit.size(0.03, 0.045)
    cover = kit.paint(colour, "cloth", 0.15)
    boards = join([box(w, d, 0.004), box(w, d, 0.004).moved((0, 0, t - 0.004))])
    spine = box(0.005, d, t).moved((-w / 2, 0, 0))
    title = box(w * 0.6, d * 0.14, 0.0012).moved((0, d * 0.2, t))
    return Thing("book", colour, (
        Piece("cover", "", boards, cover),
        Piece("cover", "spine", spine, cover),
        Piece("cover", "title", title, kit.paint(kit.other(colour, "yellow", "white"), "pages", 0.0)),
        Piece("pages", "", box(w - 0.012, d - 0.012, t - 0.008).moved((0.002, 0, 0.004)),
              kit.paint(kit.pick("white", "beige"), "pages", 0.0)),
    ))  # fmt: skip


def clock(kit: Kit, colour: str) -> Thing:
    r = kit.size(0.085, 0.105)
    upright = rotation_about("x", 90)
    dial = lathe([(r * 0.86, 0), (0, 0)], 44).turned(upright).moved((0, -0.022, r + 0.012))
    ring = lathe([(r, -0.02), (r, 0.02), (r * 0.93, 0.032), (r * 0.86, 0.024), (r * 0.86, 0.0)], 44)
    back = lathe([(0, -0.02), (r, -0.02)], 44)
    bars = [box(0.01, 0.004, r * 0.5), box(0.008, 0.004, r * 0.72).spun("y", kit.size(60, 150))]
    marks = [box(0.008, 0.003, 0.014).moved((0, 0, r * 0.66)).spun("y", 30 * k) for k in range(12)]
    feet = [ball(0.016, 12).moved((x * r, 0, 0.014)) for x in (-0.55, 0.55)]
    case, ink = kit.paint(colour, gloss=0.5, substance="plastic"), kit.paint(kit.pick("black", "red"))
    face = kit.paint(kit.other(colour, "white", "beige"), gloss=0.1, substance="paper")
    front = (0.0, -0.026, r + 0.012)
    return Thing("clock", colour, (
        Piece("case", "", join([ring, back]).turned(upright).moved((0, 0, r + 0.012)), case),
        Piece("case", "feet", join(feet), case),
        Piece("face", "", join([dial, join(marks).moved((0, -0.0235, r + 0.012))]), face),
        Piece("face", "hands", join(bars).moved(front), ink),
    ))  # fmt: skip


def plate(kit: Kit, colour: str) -> Thing:
    r = kit.size(0.12, 0.145)
    rim = lathe([(0.68 * r, 0.012), (r, 0.026), (0.99 * r, 0.029), (0.66 * r, 0.016)], 44)
    return Thing("plate", colour, (
        Piece("centre", "", lathe([(0.66 * r, 0.016), (0.6 * r, 0.012), (0, 0.012)], 40),
              kit.paint(colour, substance="ceramic")),
        Piece("rim", "", rim,
              kit.paint(kit.other(colour, "blue", "white", "yellow", "red"), substance="ceramic")),
    ))  # fmt: skip


def candle(kit: Kit, colour: str) -> Thing:
    """In a saucer-shaped holder with a finger ring."""
    r, h = kit.size(0.019, 0.024), kit.size(0.13, 0.17)
    low = 0.022
    dish = lathe([(0, 0), (0.042, 0), (0.064, 0.018), (0.062, 0.021), (0.04, 0.008), (0, 0.008)], 36)
    cup = lathe([(1.3 * r, 0.008), (1.3 * r, low + 0.016), (1.02 * r, low + 0.016)], 24)
    finger = ring(0.017, 0.0045, 22, 10).spun("x", 90).moved((0.08, 0, 0.026))
    stick = lathe([(r, 0.01), (r, low + h - 0.008), (0.8 * r, low + h), (0.3 * r, low + h - 0.006),
                   (0, low + h - 0.007)], 24)  # fmt: skip
    drips = []
    for k in range(5):
        spot = rotation_about("z", 72 * k + kit.size(0, 40)) @ (0.98 * r, 0, low + h - 0.01)
        drips.append(rod(spot, spot - (0, 0, kit.size(0.012, 0.045)), 0.0035, 0.005, 10))
    wick = rod((0, 0, low + h - 0.008), (0.002, 0, low + h + 0.006), 0.0018, around=8)
    flame = lathe([(0.0, 0.0), (0.007, 0.006), (0.0095, 0.014), (0.006, 0.028), (0, 0.042)], 18)
    brass = kit.steel(kit.pick("yellow", "gray"))
    return Thing("candle", colour, (
        Piece("holder", "", join([dish, cup]), brass),
        Piece("holder", "ring", finger, brass),
        Piece("stick", "", join([stick, *drips]), kit.paint(colour, gloss=0.25, substance="wax")),
        Piece("wick", "", wick, kit.paint("black", gloss=0.0)),
        Piece("flame", "", flame.moved((0.002, 0, low + h)),
              kit.paint(kit.pick("yellow", "orange"), gloss=0.0)),
    )).centred()  # fmt: skip


def pan(kit: Kit, colour: str) -> Thing:
    """A frying pan with a fried egg in it; the handle points to +x."""
    r, h = kit.size(0.1, 0.115), 0.036
    outer = lathe([(0, 0), (0.82 * r, 0), (r, h)], 44)
    inside = lathe([(0.98 * r, h), (0.8 * r, 0.006), (0, 0.006)], 44)
    lip = lathe([(r, h), (1.02 * r, h + 0.003), (0.98 * r, h)], 44, 0.004)
    grip = rod((1.3 * r, 0, h + 0.014), (2.35 * r, 0, h + 0.04), 0.0105, 0.013)
    neck = rod((0.97 * r, 0, h - 0.004), (1.34 * r, 0, h + 0.015), 0.007)
    egg = lathe([(0.42 * r, 0.007), (0.4 * r, 0.012), (0.2 * r, 0.015), (0, 0.016)], 36)
    turn = np.arctan2(egg.vertices[:, 1], egg.vertices[:, 0])
    wobble = 1 + 0.14 * np.sin(3 * turn + kit.size(0, 6)) + 0.07 * np.sin(5 * turn)
    white = TriMesh(egg.vertices * np.stack([wobble, wobble, 1 + 0 * turn], 1), egg.triangles, egg.normals)
    spot = (kit.size(-0.2, 0.2) * r, kit.size(-0.2, 0.2) * r, 0.0)
    yolk = ball(0.16 * r, 18).stretched((1, 1, 0.55)).moved((0, 0, 0.016))
    return Thing("pan", colour, (
        Piece("body", "", outer, kit.steel(colour)),
        Piece("body", "inside", join([inside, lip]),
              kit.paint(kit.other(colour, "black", "gray"), "metal", 0.4)),
        Piece("handle", "", grip, kit.wood(kit.pick("brown", "black"))),
        Piece("handle", "joint", neck, kit.metal()),
        Piece("egg", "", white.moved(spot), kit.paint("white", gloss=0.35, substance="skin")),
        Piece("egg", "yolk", yolk.moved(spot),
              kit.paint(kit.pick("yellow", "orange"), gloss=0.6, substance="skin")),
    )).centred()  # fmt: skip


def goblet(kit: Kit, colour: str) -> Thing:
    """A wine glass of coloured glass with something in it."""
    r, h = kit.size(0.042, 0.05), kit.size(0.16, 0.19)
    stem = 0.46 * h
    foot = lathe([(0, 0), (0.95 * r, 0), (0.95 * r, 0.004), (0.25 * r, 0.012), (0, 0.014)], 32)
    pole = lathe([(0.16 * r, 0.01), (0.1 * r, 0.4 * stem), (0.12 * r, 0.8 * stem), (0.3 * r, stem)], 18)
    b = h - stem
    shell = lathe([(0.2 * r, stem), (0.75 * r, stem + 0.16 * b), (r, stem + 0.48 * b), (0.8 * r, h)], 36)
    inside = lathe([(0.76 * r, h), (0.95 * r, stem + 0.5 * b), (0.94 * r, stem + 0.44 * b)], 36)
    drink = lathe([(0.95 * r, stem + 0.56 * b), (0, stem + 0.56 * b)], 32)
    rim = ring(0.78 * r, 0.02 * r + 0.0012, 36, 8).moved((0, 0, h))
    glass = kit.glass(colour)
    return Thing("wine glass", colour, (
        Piece("body", "", join([shell, inside]), glass),
        Piece("body", "rim", rim,
              kit.paint(kit.pick(colour, "yellow", "white"), gloss=0.9, substance="glass")),
        Piece("body", "drink", drink,
              kit.paint(kit.other(colour, "red", "yellow", "purple", "orange"), gloss=0.6)),
        Piece("stem", "", pole, glass),
        Piece("foot", "", foot, glass),
    ))  # fmt: skip


def basket(kit: Kit, colour: str) -> Thing:
    """Woven, with a high handle; bread and eggs would fit, here it holds balls of wool."""
    r, h = kit.size(0.085, 0.095), kit.size(0.075, 0.085)
    wicker = kit.paint(kit.pick("beige", "brown"), "striped", 0.05, 22)
    rows = []
    for k in range(7):
        s = k / 6
        size = r * (0.78 + 0.22 * s)
        rope = ring(size, 0.0076, 36, 7).moved((0, 0, 0.007 + s * (h - 0.01)))
        rows.append(rope)
    body = join([*rows, cylinder(0.77 * r, 0.006, 32, 0.03)])
    braid = ring(1.02 * r, 0.0095, 36, 8).moved((0, 0, h + 0.003))
    arch = tube(np.concatenate([[[1.0 * r, 0, h - 0.015]], arc((0, h), 1.0 * r, 0, 180, 22),
                                [[-1.0 * r, 0, h - 0.015]]]), 0.0085, 10).stretched((1, 1.3, 1))  # fmt: skip
    wool = [ball(0.44 * r, 18).moved(rotation_about("z", 120 * k + 30) @ (0.45 * r, 0, 0) + (0, 0, 0.72 * h))
            for k in range(3)]  # fmt: skip
    hues = [word for word in ("red", "blue", "green", "purple", "yellow", "pink", "white") if word != colour]
    return Thing("basket", wicker.word, (
        Piece("body", "", body, wicker),
        Piece("body", "rim", braid, wicker),
        Piece("handle", "", arch, wicker),
        Piece("wool", "", wool[0], kit.cloth(colour), 0),
        Piece("wool", "", join(wool[1:]), kit.cloth(kit.pick(*hues)), 1),
    ))  # fmt: skip


def orange(kit: Kit, colour: str) -> Thing:
    r = kit.size(0.045, 0.055)
    stub = cylinder(0.007, 0.006, 10).moved((0, 0, 1.9 * r))
    fruit = ball(r).stretched((1, 1, 0.96)).moved((0, 0, 0.96 * r))
    return Thing("orange", "orange", (
        Piece("peel", "", fruit, kit.paint("orange", "peel", 0.3)),
        Piece("stem", "", stub, kit.paint("green")),
    ))  # fmt: skip


def apple(kit: Kit, colour: str) -> Thing:
    r = kit.size(0.048, 0.056)
    profile = ((0, 0.12), (0.35, 0.02), (0.8, 0.35), (1, 1.0), (0.9, 1.5), (0.55, 1.8), (0.2, 1.74), (0, 1.6))
    fruit = lathe([(a * r, b * r) for a, b in profile], 32)
    stalk = tube(np.array([(0, 0, 1.58), (0.05, 0, 1.85), (0.16, 0, 2.1)]) * r, 0.0035, 8)
    blade = ball(0.5, 14).stretched((0.04, 0.018, 0.005)).spun("y", -25)
    return Thing("apple", colour, (
        Piece("skin", "", fruit, kit.paint(colour, "speckled", 0.5)),
        Piece("stem", "", stalk, kit.paint("brown")),
        Piece("leaf", "", blade.moved((0.025, 0, 1.98 * r)), kit.paint("green", "leaf")),
    ))  # fmt: skip


def banana(kit: Kit, colour: str) -> Thing:
    bend, skin = kit.size(0.1, 0.13), kit.paint("yellow", "speckled", 0.2)
    line = arc((0, 0), bend, 195, 345, 22)
    thick = 0.0235 * np.sqrt(np.clip(1 - np.linspace(-0.93, 0.97, 22) ** 4, 0, 1)) + 0.003
    lie = rotation_about("x", 90)
    body = tube(line, thick, 14).turned(lie)
    a, b = arc((0, 0), bend, 345, 356, 5), arc((0, 0), bend, 192, 195, 3)
    stem = tube(a, np.array([0.009, 0.007, 0.006, 0.007, 0.0001]), 10).turned(lie)
    tip = tube(b, np.array([0.0001, 0.007, 0.0095]), 10).turned(lie)
    lift = (0.0, -0.7 * bend, 0.026)
    return Thing("banana", "yellow", (
        Piece("peel", "", body.moved(lift), skin),
        Piece("stem", "", stem.moved(lift), kit.paint("green")),
        Piece("tip", "", tip.moved(lift), kit.paint("brown")),
    ))  # fmt: skip


def carrot(kit: Kit, colour: str) -> Thing:
    n, r = kit.size(0.16, 0.2), kit.size(0.026, 0.032)
    profile = [(0.0, 0.0), (0.08, 0.02), (0.35, 0.3), (0.72, 0.68), (0.98, 0.93), (0.9, 0.99), (0.3, 1.0)]
    lie = rotation_about("y", 90 - float(np.degrees(np.arctan(r / n))))
    root = lathe([(a * r, b * n) for a, b in profile], 24).moved((0, 0, -n / 2)).turned(lie)
    leaves = []
    for _ in range(9):
        lean = rotation_about("z", kit.size(0, 360)) @ rotation_about("y", kit.size(4, 30))
        leaves.append(rod((0, 0, 0), lean @ (0, 0, kit.size(0.07, 0.11)), 0.004, 0.009, 8))
    top = join(leaves).moved((0, 0, n / 2 - 0.004)).turned(lie)
    lift = (0.0, 0.0, -float(root.vertices[:, 2].min()))
    green = top.moved(lift)
    flat = TriMesh(np.maximum(green.vertices, (-9, -9, 0.003)), green.triangles, green.normals)
    return Thing("carrot", "orange", (
        Piece("root", "", root.moved(lift), kit.paint("orange", "peel", 0.2)),
        Piece("leaves", "", flat, kit.paint("green", "leaf", 0.15)),
    )).centred()  # fmt: skip


def _disc_sector(profile: list[tuple[float, float]], gap: float) -> tuple[TriMesh, TriMesh]:
    """A turned body with a wedge of `gap` degrees missing at -y, and the two cut faces."""
    full = lathe(profile, 42, 0.02)
    angle = np.degrees(np.arctan2(full.vertices[:, 1], full.vertices[:, 0]) + np.pi / 2) % 360
    inside = (angle > gap / 2 - 1e-6) & (angle < 360 - gap / 2 + 1e-6)
    on_axis = np.hypot(full.vertices[:, 0], full.vertices[:, 1]) < 1e-9
    keep = (inside | on_axis)[full.triangles].all(1)
    r, z0, z1 = max(p[0] for p in profile), profile[0][1], max(p[1] for p in profile)
    face = sheet(r, z1 - z0, 0.015).spun("x", 90).moved((r / 2, 0, (z0 + z1) / 2))
    cuts = [
        face.spun("z", -90 + gap / 2),
        face.spun("x", 180).moved((0, 0, z0 + z1)).spun("z", -90 - gap / 2),
    ]
    return TriMesh(full.vertices, full.triangles[keep], full.normals), join(cuts)


def cake(kit: Kit, colour: str) -> Thing:
    """Round, on a board, with a slice taken out, cream and cherries on top."""
    r, h = kit.size(0.085, 0.1), kit.size(0.07, 0.085)
    icing = kit.paint(colour, gloss=0.35)
    coat, cut = _disc_sector([(r, 0.01), (r, 0.01 + h), (0.0, 0.01 + h)], 60)
    sponge = kit.paint(kit.other(colour, "beige", "brown"), "speckled", 0.05)
    second = kit.paint(kit.other(colour, "white", "pink", "brown"), gloss=0.35)
    layer = cut.stretched((0.998, 0.998, 0.16))
    filling = [layer.moved((0, -0.0006, 0.01 + h * s - 0.006)) for s in (0.42, 0.84)]
    places = [rotation_about("z", -90 + 30 + 30 * k + 15) @ (0.78 * r, 0, 0) for k in range(10)]
    cream = [ball(0.02, 12).stretched((1, 1, 0.7)).moved(p + (0, 0, 0.014 + h)) for p in places]
    cherry = [ball(0.0125, 10).moved(p + (0, 0, 0.034 + h)) for p in places]
    board = cylinder(r * 1.3, 0.01, 44, 0.03)
    return Thing("cake", colour, (
        Piece("icing", "", coat, icing),
        Piece("icing", "cream", join(cream), second),
        Piece("icing", "cherries", join(cherry), kit.paint(kit.other(colour, "red", "purple"), gloss=0.8)),
        Piece("slice", "", cut, sponge),
        Piece("slice", "filling", join(filling), second),
        Piece("board", "", board, kit.paint(kit.other(colour, "white", "gray", "blue"), substance="ceramic")),
    ))  # fmt: skip


def donut(kit: Kit, colour: str) -> Thing:
    r, t = kit.size(0.06, 0.07), kit.size(0.027, 0.032)
    dough = ring(r, t, 40, 18).moved((0, 0, t))
    crown = ring(r, t * 1.06, 48, 20)
    wave = 0.25 * np.sin(7 * np.arctan2(crown.vertices[:, 1], crown.vertices[:, 0])) * t
    keep = (crown.vertices[:, 2] > wave + 0.1 * t)[crown.triangles].any(1)
    glaze = TriMesh(crown.vertices, crown.triangles[keep], crown.normals).moved((0, 0, t))
    hues = [word for word in ("red", "yellow", "blue", "green", "white") if word != colour]
    bits: list[TriMesh] = []
    for _ in range(26):
        lean = kit.size(-0.75, 0.75)
        spot: Array = np.array([r + t * 1.08 * np.sin(lean), 0, t + t * 1.08 * np.cos(lean)])
        turn = rotation_about("z", kit.size(0, 360))
        along = rotation_about("z", kit.size(0, 180)) @ (0.005, 0, 0)
        bits.append(rod(spot - along, spot + along, 0.0026, around=5).turned(turn))
    return Thing("donut", colour, (
        Piece("dough", "", dough, kit.paint("brown", "peel", 0.1)),
        Piece("icing", "", glaze, kit.paint(colour, gloss=0.7)),
        Piece("icing", "sprinkles", join(bits), kit.paint(kit.pick(*hues), gloss=0.4)),
    ))  # fmt: skip


def ice_cream(kit: Kit, colour: str) -> Thing:
    """Two scoops in a cone, in a stand."""
    r, h = kit.size(0.05, 0.058), kit.size(0.13, 0.15)
    low = 0.012
    wafer = join(
        [lathe([(0.0, low), (0.95 * r, low + h)], 28), ring(0.95 * r, 0.006, 28, 8).moved((0, 0, low + h))]
    )
    first = ball(r, 22).moved((0, 0, low + h + 0.42 * r))
    skirt = ring(0.82 * r, 0.2 * r, 28, 10).moved((0, 0, low + h + 0.12 * r))
    second = ball(0.84 * r, 22).moved((0, 0, low + h + 1.62 * r))
    cherry = ball(0.27 * r, 16).moved((0, 0, low + h + 2.58 * r))
    hold = low + 0.4 * h
    legs = [rod(rotation_about("z", 120 * k) @ (0.052, 0, 0.006),
                rotation_about("z", 120 * k) @ (0.44 * r, 0, hold), 0.004) for k in range(3)]  # fmt: skip
    stand = join([*legs, ring(0.4 * r + 0.004, 0.005, 28, 8).moved((0, 0, hold)),
                  ring(0.052, 0.006, 32, 8).moved((0, 0, 0.006))])  # fmt: skip
    other = kit.other(colour, "white", "pink", "brown", "green", "yellow")
    return Thing("ice cream", colour, (
        Piece("cone", "", wafer, kit.pattern("beige", "brown", "dotted", 0.05)),
        Piece("scoop", "", join([first, skirt]), kit.paint(colour, "peel", 0.25), 0),
        Piece("scoop", "", second, kit.paint(other, "peel", 0.25), 1),
        Piece("cherry", "", cherry, kit.paint("red", gloss=0.9)),
        Piece("stand", "", stand, kit.metal()),
    ))  # fmt: skip


def burger(kit: Kit, colour: str) -> Thing:
    r = kit.size(0.075, 0.088)
    bun = kit.paint("brown", "peel", 0.25)
    crown = lathe([(0.96 * r, 0.088), (1.02 * r, 0.1), (0.97 * r, 0.122), (0.75 * r, 0.148),
                   (0.4 * r, 0.162), (0, 0.166)], 40)  # fmt: skip
    under = lathe([(0.0, 0.0), (0.9 * r, 0.0), (1.0 * r, 0.012), (0.98 * r, 0.03), (0, 0.031)], 36, 0.02)
    meat = pillow(2.04 * r, 2.04 * r, 0.026, 3, 30).moved((0, 0, 0.03))
    cheese = sheet(1.62 * r, 1.62 * r, 0.02)
    droop = np.maximum(np.abs(cheese.vertices[:, :2]).sum(1) - 1.15 * r, 0) * 0.55
    leaf = lathe([(0.7 * r, 0.067), (1.1 * r, 0.07), (1.12 * r, 0.073), (0.7 * r, 0.076)], 52, 0.02)
    angle = np.arctan2(leaf.vertices[:, 1], leaf.vertices[:, 0])
    ruffle = 0.009 * np.sin(13 * angle) * (np.hypot(leaf.vertices[:, 0], leaf.vertices[:, 1]) > r)
    salad = TriMesh(
        leaf.vertices + np.stack([0 * ruffle, 0 * ruffle, ruffle], 1), leaf.triangles, leaf.normals
    )
    slices = lathe([(0, 0.076), (0.98 * r, 0.076), (1.02 * r, 0.083), (0.97 * r, 0.09)], 36)
    seeds = []
    for _ in range(20):
        tilt, turn = kit.size(0.1, 0.8) * r, rotation_about("z", kit.size(0, 360))
        height = np.interp(tilt / r, [0, 0.4, 0.75, 0.97], [0.166, 0.162, 0.148, 0.122])
        seeds.append(ball(0.004, 6).stretched((1.5, 1, 0.6)).moved((tilt, 0, height + 0.001)).turned(turn))
    flat = TriMesh(
        cheese.vertices - np.stack([0 * droop, 0 * droop, droop], 1), cheese.triangles, cheese.normals
    )
    return Thing("burger", "brown", (
        Piece("bun", "", crown, bun, 0),
        Piece("bun", "seeds", join(seeds), kit.paint("beige"), 0),
        Piece("bun", "", under, bun, 1),
        Piece("meat", "", meat, kit.paint("brown", "peel", 0.1, 20)),
        Piece("cheese", "", flat.moved((0, 0, 0.062)), kit.paint(kit.pick("yellow", "orange"), gloss=0.3)),
        Piece("lettuce", "", salad, kit.paint("green", "leaf", 0.2)),
        Piece("tomato", "", slices, kit.paint("red", gloss=0.5)),
    ))  # fmt: skip
