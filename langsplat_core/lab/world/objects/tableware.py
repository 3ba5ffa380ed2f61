"""Builders of household objects. Each takes a `Kit` and a colour word; front is -y, size in metres."""

import numpy as np

from langsplat_core.lab.world.geometry.shapes import (
    arc,
    ball,
    box,
    cylinder,
    join,
    lathe,
    rotation_about,
    tube,
)
from langsplat_core.lab.world.objects.kit import Kit, Material, Piece, Thing


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
            ball(0.022, 10).stretched((1, 0.7, 0.35)).moved((0.024, 0, 0)).turned(rotation_about("z", 60 * j))
            for j in range(6)
        ]
        pieces += [
            Piece(
                "flower", "stem", tube(stalk, 0.0035, 8), kit.paint("green", gloss=0.1, substance="leaf"), k
            ),
            Piece("flower", "petals", join(petals).moved(head), petal_paint, k),
        ]
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
    bars = [
        box(0.01, 0.004, r * 0.5),
        box(0.008, 0.004, r * 0.72).turned(rotation_about("y", kit.size(60, 150))),
    ]
    marks = [
        box(0.008, 0.003, 0.014).moved((0, 0, r * 0.66)).turned(rotation_about("y", 30 * k))
        for k in range(12)
    ]
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
