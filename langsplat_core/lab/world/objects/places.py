"""Builders of model buildings and outdoor things, of a `Kit` and a colour word; front is -y, metres."""

import numpy as np

from langsplat_core.lab.world.geometry.shapes import (
    Mesh,
    ball,
    box,
    cylinder,
    join,
    lathe,
    rotation_about,
    slab,
    tube,
)
from langsplat_core.lab.world.geometry.solids import cone, ring, rod
from langsplat_core.lab.world.objects.kit import Kit, Piece, Thing


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
    nose = cone(0.09 * r, 0.55 * r, around=14).turned(rotation_about("x", 90)).moved((0, -0.48 * r, up[2]))
    scarf_paint = kit.cloth(kit.other(colour, "red", "blue", "green", "yellow", "purple"))
    tail = slab([(0.0, 0), (0.26 * r, 0), (0.26 * r, 0.85 * r), (0.0, 0.85 * r)], 0.16 * r)
    tail = tail.turned(rotation_about("x", -14)).moved((0.2 * r, -0.84 * r, 1.95 * r))
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
    panes = [pane.turned(rotation_about("z", angle)) for angle in (0, 90, 180, 270)]
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
    crown = [
        cylinder(0.03, 0.012, 24).moved((-a, -a, 1.3 * h)).turned(rotation_about("z", 90 * k))
        for k in range(4)
    ]
    roofs = [
        cone(0.034, 0.062, around=20).moved((-a, -a, 1.3 * h + 0.012)).turned(rotation_about("z", 90 * k))
        for k in range(4)
    ]
    top = 1.3 * h + 0.07
    pole = [rod((-a, -a, top - 0.01), (-a, -a, top + 0.036), 0.002, around=6),
            slab([(0, 0), (0.03, 0.009), (0, 0.018)], 0.003).moved((-a, -a, top + 0.018))]  # fmt: skip
    flags = [join(pole).turned(rotation_about("z", 180 * k)) for k in range(2)]
    arch = [
        (-0.02, 0.0),
        (0.02, 0.0),
        (0.02, 0.03),
        (0.014, 0.044),
        (0.0, 0.05),
        (-0.014, 0.044),
        (-0.02, 0.03),
    ]
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
    petals = [ball(0.012, 8).stretched((1, 0.6, 0.4)).moved((0.011, 0, 0)).turned(rotation_about("z", 60 * k))
              for k in range(6)]  # fmt: skip
    bloom = join([*petals, ball(0.007, 8)]).moved((0, 0, 0.06 + h))
    green = kit.paint("green", "plain", 0.15, substance="leaf")
    shaft = Mesh(ribbed, trunk.triangles, trunk.normals)
    return Thing("cactus", "green", (
        Piece("pot", "", join([pot, lip]), kit.paint(colour, "speckled", 0.2, substance="ceramic")),
        Piece("soil", "", soil, kit.paint("brown", "rug", 0.0, substance="skin")),
        Piece("body", "", shaft, green),
        Piece("body", "spines", join(spines), kit.paint("white")),
        Piece("arm", "", join(arms), green),
        Piece("flower", "", bloom, kit.paint(kit.pick("pink", "red", "yellow", "purple"))),
    ))  # fmt: skip
