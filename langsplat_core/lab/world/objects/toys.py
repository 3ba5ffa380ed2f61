"""Builders of toys and presents. Each takes a `Kit` and a colour word; front is -y, metres."""

from dataclasses import replace

import numpy as np

from langsplat_core.lab.world.geometry.shapes import (
    arc,
    ball,
    box,
    cylinder,
    join,
    lathe,
    rotation_about,
    slab,
    tube,
)
from langsplat_core.lab.world.objects.kit import Kit, Piece, Thing


def car(kit: Kit, colour: str) -> Thing:
    n, w = kit.size(0.22, 0.27), kit.size(0.11, 0.125)
    r = 0.032
    hull = slab([(-n / 2, 0.03), (n / 2, 0.03), (n / 2, 0.07), (n / 2 - 0.02, 0.085), (-n / 2, 0.09)], w)
    cabin = slab([(-0.09, 0.085), (0.05, 0.085), (0.02, 0.138), (-0.07, 0.138)], w * 0.86)
    panes = [
        slab([(-0.076, 0.091), (-0.018, 0.091), (-0.018, 0.13), (-0.064, 0.13)], w * 0.87),
        slab([(-0.008, 0.091), (0.036, 0.091), (0.014, 0.13), (-0.008, 0.13)], w * 0.87),
    ]
    shield = slab([(0.024, 0.089), (0.049, 0.089), (0.021, 0.134), (0.014, 0.134)], w * 0.74).moved(
        (0.002, 0, 0)
    )
    paint, tyre = kit.paint(colour, gloss=0.8, substance="plastic"), kit.paint("black", substance="rubber")
    glass = kit.paint("turquoise", gloss=0.9, substance="glass")
    hub_paint, side = (
        kit.paint(kit.pick("gray", "white", "yellow"), substance="plastic"),
        rotation_about("x", 90),
    )
    pieces = []
    for k, (x, y) in enumerate([(-0.3, -1), (0.3, -1), (-0.3, 1), (0.3, 1)]):
        wheel = cylinder(r, 0.03, 24).moved((0, 0, -0.015)).turned(side)
        hub = cylinder(r * 0.5, 0.032, 16).moved((0, 0, -0.016)).turned(side)
        at = (x * n, y * w / 2, r)
        pieces += [
            Piece("wheel", "tyre", wheel.moved(at), tyre, k),
            Piece("wheel", "hub", hub.moved(at), hub_paint, k),
        ]
    lights = join([ball(0.012, 12).moved((n / 2, y * w * 0.33, 0.058)) for y in (-1, 1)])
    return Thing("car", colour, (
        Piece("body", "", hull, paint),
        Piece("body", "roof", cabin, paint),
        Piece("body", "lights", lights, kit.paint("yellow", gloss=0.6, substance="plastic")),
        Piece("window", "", join(panes), glass, 0),
        Piece("window", "", shield, glass, 1),
        *pieces,
    ))  # fmt: skip


def block(kit: Kit, colour: str) -> Thing:
    a = kit.size(0.06, 0.08)
    dot = kit.paint(kit.other(colour, "white", "yellow", "red", "blue"))
    disc = cylinder(a * 0.28, 0.002, 24)
    marks = [disc.moved((0, 0, a))]
    for k in range(4):
        turn = rotation_about("z", 90 * k) @ rotation_about("x", 90)
        marks.append(disc.moved((0, 0, a / 2)).turned(turn).moved((0, 0, a / 2)))
    coat = kit.paint(colour, "wood", 0.15, 9)
    return Thing("block", colour, (
        Piece("side", "", box(a, a, a), coat),
        Piece("side", "dot", join(marks), dot),
    ))  # fmt: skip


def toy_ball(kit: Kit, colour: str) -> Thing:
    r = kit.size(0.06, 0.075)
    line = np.linspace(-0.3, 0.3, 9)
    band = lathe([(r * 1.006 * float(np.cos(a)), r * 1.006 * float(np.sin(a))) for a in line], 36)
    second = kit.other(colour, "white", "yellow", "blue", "red", "black")
    tilt = rotation_about("x", kit.size(-40, 40))
    return Thing("ball", colour, (
        Piece("surface", "", ball(r, 36).turned(tilt).moved((0, 0, r)),
              kit.paint(colour, gloss=0.6, substance="plastic")),
        Piece("stripe", "", band.turned(tilt).moved((0, 0, r)),
              kit.paint(second, gloss=0.6, substance="plastic")),
    ))  # fmt: skip


def gift(kit: Kit, colour: str) -> Thing:
    w, d, h = kit.size(0.13, 0.17), kit.size(0.12, 0.16), kit.size(0.09, 0.13)
    second = kit.other(colour, "red", "yellow", "white", "purple", "pink", "green")
    ribbon = kit.paint(second, gloss=0.6, substance="cloth")
    wrap = (
        kit.paint(colour, "plain", 0.3, substance="paper")
        if kit.rng.random() < 0.5
        else replace(kit.pattern(colour, "white", "dotted"), substance="paper")
    )
    bands = join([box(0.025, d + 0.003, h + 0.002), box(w + 0.003, 0.025, h + 0.002)])
    loops = [
        tube(arc((0.028, 0), 0.026, -165, 165, 14), 0.009, 8).stretched((1, 1.7, 0.8)).turned(
            rotation_about("z", 90 * k + 45)
        )
        for k in range(4)
    ]  # fmt: skip
    return Thing("gift", colour, (
        Piece("box", "", box(w, d, h), wrap),
        Piece("ribbon", "", bands, ribbon),
        Piece("ribbon", "bow", join([*loops, ball(0.014, 12)]).moved((0, 0, h + 0.02)), ribbon),
    ))  # fmt: skip


def house(kit: Kit, colour: str) -> Thing:
    w, d, h = kit.size(0.13, 0.16), kit.size(0.11, 0.14), kit.size(0.1, 0.13)
    peak = h + kit.size(0.06, 0.08)
    gable = slab([(-w / 2, 0), (w / 2, 0), (w / 2, h), (0, peak), (-w / 2, h)], d)
    slope = float(np.degrees(np.arctan2(peak - h, w / 2)))
    span = float(np.hypot(w / 2, peak - h)) + 0.02
    plank = box(span, d + 0.03, 0.012)
    tiles = [
        plank.moved((x * span / 2, 0, 0)).turned(rotation_about("y", x * slope)).moved((0, 0, peak))
        for x in (-1, 1)
    ]
    stack = box(0.026, 0.026, 0.06).moved((w * 0.25, 0, h + 0.03))
    roof = kit.paint(kit.other(colour, "red", "brown", "blue", "gray"), "striped", 0.1)
    glass, door = (
        kit.paint(kit.other(colour, "turquoise", "white", "yellow"), substance="glass"),
        kit.paint(kit.other(colour, "brown", "green", "red"), substance="wood"),
    )
    panes = [box(0.03, 0.004, 0.032).moved((x * w * 0.28, -d / 2, h * 0.52)) for x in (-1, 1)]
    panes += [box(0.004, 0.03, 0.032).moved((x * w / 2, 0, h * 0.52)) for x in (-1, 1)]
    return Thing("house", colour, (
        Piece("wall", "", gable, kit.paint(colour, "plaster", 0.05)),
        Piece("roof", "", join(tiles), roof),
        Piece("roof", "chimney", stack, kit.paint(kit.pick("red", "gray", "brown"))),
        Piece("door", "", box(0.034, 0.006, 0.06).moved((0, -d / 2, 0)), door),
        *(Piece("window", "", pane, glass, k) for k, pane in enumerate(panes)),
    ))  # fmt: skip


def robot(kit: Kit, colour: str) -> Thing:
    w = kit.size(0.08, 0.1)
    limb = kit.paint(kit.other(colour, "gray", "white", "black"), gloss=0.7, substance="metal")
    coat = kit.paint(colour, gloss=0.6, substance="metal")
    pieces = []
    for k, x in enumerate((-1, 1)):
        leg = join([cylinder(0.014, 0.07, 16), box(0.036, 0.055, 0.016).moved((0, -0.008, 0))])
        arm = join([cylinder(0.012, 0.085, 16), ball(0.018, 14)]).turned(rotation_about("y", x * -14))
        pieces += [
            Piece("leg", "", leg.moved((x * w * 0.26, 0, 0)), limb, k),
            Piece("arm", "", arm.moved((x * w * 0.66, 0, 0.085)), limb, k),
        ]
    head = box(w * 0.7, w * 0.6, w * 0.58).moved((0, 0, 0.185))
    rod = join([cylinder(0.003, 0.04, 8), ball(0.009, 12).moved((0, 0, 0.043))]).moved(
        (0, 0, 0.185 + w * 0.58)
    )
    eyes = [ball(0.011, 14).moved((x * w * 0.17, -w * 0.3, 0.185 + w * 0.34)) for x in (-1, 1)]
    panel = box(w * 0.56, 0.004, 0.05).moved((0, -w * 0.31, 0.1))
    return Thing("robot", colour, (
        Piece("body", "", box(w, w * 0.6, 0.11).moved((0, 0, 0.07)), coat),
        Piece("body", "panel", panel, kit.paint(kit.other(colour, "yellow", "white", "turquoise"))),
        Piece("head", "", head, coat),
        Piece("head", "eyes", join(eyes), kit.paint(kit.pick("black", "red", "yellow"), gloss=0.9)),
        Piece("head", "antenna", rod, kit.paint(kit.pick("red", "yellow"), substance="plastic")),
        *pieces,
    ))  # fmt: skip
