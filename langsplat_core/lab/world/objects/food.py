"""Builders of food. Each takes a `Kit` and a colour word; front is -y, metres."""

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.lab.world.geometry.shapes import (
    Mesh,
    arc,
    ball,
    cylinder,
    join,
    lathe,
    rotation_about,
    sheet,
    tube,
)
from langsplat_core.lab.world.geometry.solids import pillow, ring, rod
from langsplat_core.lab.world.objects.kit import Kit, Piece, Thing


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
    blade = ball(0.5, 14).stretched((0.04, 0.018, 0.005)).turned(rotation_about("y", -25))
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
    flat = Mesh(np.maximum(green.vertices, (-9, -9, 0.003)), green.triangles, green.normals)
    return Thing("carrot", "orange", (
        Piece("root", "", root.moved(lift), kit.paint("orange", "peel", 0.2)),
        Piece("leaves", "", flat, kit.paint("green", "leaf", 0.15)),
    )).centred()  # fmt: skip


def _disc_sector(profile: list[tuple[float, float]], gap: float) -> tuple[Mesh, Mesh]:
    """A turned body with a wedge of `gap` degrees missing at -y, and the two cut faces."""
    full = lathe(profile, 42, 0.02)
    angle = np.degrees(np.arctan2(full.vertices[:, 1], full.vertices[:, 0]) + np.pi / 2) % 360
    inside = (angle > gap / 2 - 1e-6) & (angle < 360 - gap / 2 + 1e-6)
    on_axis = np.hypot(full.vertices[:, 0], full.vertices[:, 1]) < 1e-9
    keep = (inside | on_axis)[full.triangles].all(1)
    r, z0, z1 = max(p[0] for p in profile), profile[0][1], max(p[1] for p in profile)
    face = sheet(r, z1 - z0, 0.015).turned(rotation_about("x", 90)).moved((r / 2, 0, (z0 + z1) / 2))
    cuts = [
        face.turned(rotation_about("z", -90 + gap / 2)),
        face.turned(rotation_about("x", 180))
        .moved((0, 0, z0 + z1))
        .turned(rotation_about("z", -90 - gap / 2)),
    ]
    return Mesh(full.vertices, full.triangles[keep], full.normals), join(cuts)


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
    glaze = Mesh(crown.vertices, crown.triangles[keep], crown.normals).moved((0, 0, t))
    hues = [word for word in ("red", "yellow", "blue", "green", "white") if word != colour]
    bits: list[Mesh] = []
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
    legs = [
        rod(
            rotation_about("z", 120 * k) @ (0.052, 0, 0.006),
            rotation_about("z", 120 * k) @ (0.44 * r, 0, hold),
            0.004,
        )
        for k in range(3)
    ]
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
    crown = lathe(
        [
            (0.96 * r, 0.088),
            (1.02 * r, 0.1),
            (0.97 * r, 0.122),
            (0.75 * r, 0.148),
            (0.4 * r, 0.162),
            (0, 0.166),
        ],
        40,
    )
    under = lathe([(0.0, 0.0), (0.9 * r, 0.0), (1.0 * r, 0.012), (0.98 * r, 0.03), (0, 0.031)], 36, 0.02)
    meat = pillow(2.04 * r, 2.04 * r, 0.026, 3, 30).moved((0, 0, 0.03))
    cheese = sheet(1.62 * r, 1.62 * r, 0.02)
    droop = np.maximum(np.abs(cheese.vertices[:, :2]).sum(1) - 1.15 * r, 0) * 0.55
    leaf = lathe([(0.7 * r, 0.067), (1.1 * r, 0.07), (1.12 * r, 0.073), (0.7 * r, 0.076)], 52, 0.02)
    angle = np.arctan2(leaf.vertices[:, 1], leaf.vertices[:, 0])
    ruffle = 0.009 * np.sin(13 * angle) * (np.hypot(leaf.vertices[:, 0], leaf.vertices[:, 1]) > r)
    salad = Mesh(leaf.vertices + np.stack([0 * ruffle, 0 * ruffle, ruffle], 1), leaf.triangles, leaf.normals)
    slices = lathe([(0, 0.076), (0.98 * r, 0.076), (1.02 * r, 0.083), (0.97 * r, 0.09)], 36)
    seeds = []
    for _ in range(20):
        tilt, turn = kit.size(0.1, 0.8) * r, rotation_about("z", kit.size(0, 360))
        height = np.interp(tilt / r, [0, 0.4, 0.75, 0.97], [0.166, 0.162, 0.148, 0.122])
        seeds.append(ball(0.004, 6).stretched((1.5, 1, 0.6)).moved((tilt, 0, height + 0.001)).turned(turn))
    flat = Mesh(
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
