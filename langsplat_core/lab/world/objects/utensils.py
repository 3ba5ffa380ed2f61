"""Builders of more things of the household: candle, pan, wine glass, basket. Front is -y, metres."""

import numpy as np

from langsplat_core.lab.world.geometry.shapes import (
    Mesh,
    arc,
    ball,
    cylinder,
    join,
    lathe,
    rotation_about,
    tube,
)
from langsplat_core.lab.world.geometry.solids import ring, rod
from langsplat_core.lab.world.objects.kit import Kit, Piece, Thing


def candle(kit: Kit, colour: str) -> Thing:
    """In a saucer-shaped holder with a finger ring."""
    r, h = kit.size(0.019, 0.024), kit.size(0.13, 0.17)
    low = 0.022
    dish = lathe([(0, 0), (0.042, 0), (0.064, 0.018), (0.062, 0.021), (0.04, 0.008), (0, 0.008)], 36)
    cup = lathe([(1.3 * r, 0.008), (1.3 * r, low + 0.016), (1.02 * r, low + 0.016)], 24)
    finger = ring(0.017, 0.0045, 22, 10).turned(rotation_about("x", 90)).moved((0.08, 0, 0.026))
    stick = lathe(
        [
            (r, 0.01),
            (r, low + h - 0.008),
            (0.8 * r, low + h),
            (0.3 * r, low + h - 0.006),
            (0, low + h - 0.007),
        ],
        24,
    )
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
    white = Mesh(egg.vertices * np.stack([wobble, wobble, 1 + 0 * turn], 1), egg.triangles, egg.normals)
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
    arch = tube(
        np.concatenate(
            [[[1.0 * r, 0, h - 0.015]], arc((0, h), 1.0 * r, 0, 180, 22), [[-1.0 * r, 0, h - 0.015]]]
        ),
        0.0085,
        10,
    ).stretched((1, 1.3, 1))
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
