"""Builders of animals as toys and figures. Each takes a `Kit` and a colour word; front is -y, metres."""

import numpy as np

from langsplat_core.lab.world.geometry.shapes import Mesh, ball, join, rotation_about, slab, tube
from langsplat_core.lab.world.geometry.solids import plate_of, rod, smooth_outline
from langsplat_core.lab.world.objects.kit import Kit, Material, Piece, Thing


def _pair(mesh: Mesh, x: float, y: float, z: float) -> list[Mesh]:
    """The mesh on both sides of the plane x = 0."""
    return [mesh.moved((side * x, y, z)) for side in (-1, 1)]


def _eyes(kit: Kit, size: float, x: float, y: float, z: float) -> Piece:
    return Piece("head", "eyes", join(_pair(ball(size, 12), x, y, z)), _black(kit))


def _black(kit: Kit) -> Material:
    return kit.paint("black", gloss=0.9)


def teddy_bear(kit: Kit, colour: str) -> Thing:
    r = kit.size(0.058, 0.068)
    fur, pale = kit.cloth(colour), kit.cloth(kit.other(colour, "beige", "white", "pink"))
    belly = ball(0.72 * r, 20).stretched((1, 0.4, 1)).moved((0, -0.72 * r, 1.15 * r))
    up = 2.75 * r
    muzzle = ball(0.38 * r, 18).stretched((1.1, 0.8, 0.85)).moved((0, -0.78 * r, up - 0.2 * r))
    nose = ball(0.14 * r, 12).stretched((1.3, 1, 0.8)).moved((0, -1.08 * r, up - 0.08 * r))
    ears = _pair(ball(0.34 * r, 18).stretched((1, 0.5, 1)), 0.68 * r, 0, up + 0.62 * r)
    inner = _pair(ball(0.2 * r, 12).stretched((1, 0.4, 1)), 0.68 * r, -0.13 * r, up + 0.62 * r)
    pieces = []
    for k, x in enumerate((-1, 1)):
        arm = rod((x * 0.8 * r, 0, 1.75 * r), (x * 1.4 * r, -0.45 * r, 1.05 * r), 0.3 * r, 0.33 * r)
        leg = rod((x * 0.55 * r, -0.2 * r, 0.42 * r), (x * 0.85 * r, -1.35 * r, 0.42 * r), 0.42 * r)
        sole = ball(0.3 * r, 16).stretched((1, 0.35, 1)).moved((x * 0.88 * r, -1.72 * r, 0.42 * r))
        pieces += [
            Piece("arm", "", arm, fur, k), Piece("leg", "", leg, fur, k), Piece("leg", "paw", sole, pale, k),
        ]  # fmt: skip
    return Thing("teddy bear", colour, (
        Piece("body", "", ball(r, 24).stretched((1, 0.9, 1.15)).moved((0, 0, 1.12 * r)), fur),
        Piece("body", "belly", belly, pale),
        Piece("head", "", ball(0.92 * r, 24).moved((0, 0, up)), fur),
        Piece("head", "muzzle", muzzle, pale),
        Piece("head", "nose", nose, _black(kit)),
        Piece("head", "ears", join(ears), fur),
        Piece("head", "ears", join(inner), pale),
        _eyes(kit, 0.11 * r, 0.34 * r, -0.84 * r, up + 0.22 * r),
        *pieces,
    ))  # fmt: skip


def rabbit(kit: Kit, colour: str) -> Thing:
    r = kit.size(0.055, 0.065)
    fur, inner = kit.cloth(colour), kit.cloth(kit.other(colour, "pink", "white"))
    up, long = 2.35 * r, kit.size(1.5, 1.9) * r
    ears, lining = [], []
    for x in (-1, 1):
        turn = rotation_about("y", x * kit.size(8, 18))
        spot = (x * 0.3 * r, -0.35 * r, up + 0.5 * r)
        ear = ball(0.5, 20).stretched((0.5 * r, 0.26 * r, long)).moved((0, 0, 0.42 * long))
        ears.append(ear.turned(turn).moved(spot))
        bit = ball(0.5, 16).stretched((0.3 * r, 0.12 * r, 0.72 * long)).moved((0, -0.1 * r, 0.44 * long))
        lining.append(bit.turned(turn).moved(spot))
    paws = _pair(ball(0.3 * r, 16).stretched((0.8, 1.4, 0.7)), 0.45 * r, -0.95 * r, 0.21 * r)
    feet = _pair(ball(0.4 * r, 16).stretched((0.8, 1.6, 0.6)), 0.75 * r, 0.2 * r, 0.24 * r)
    nose = ball(0.11 * r, 10).moved((0, -1.05 * r, up - 0.05 * r))
    cheeks = _pair(ball(0.22 * r, 14), 0.16 * r, -0.88 * r, up - 0.2 * r)
    return Thing("rabbit", colour, (
        Piece("body", "", ball(r, 24).stretched((0.95, 1.15, 1.05)).moved((0, 0.15 * r, 1.05 * r)), fur),
        Piece("body", "tail", ball(0.32 * r, 16).moved((0, 1.35 * r, 0.7 * r)), kit.cloth("white")),
        Piece("head", "", ball(0.72 * r, 22).moved((0, -0.35 * r, up)), fur),
        Piece("head", "nose", nose, kit.paint("pink")),
        Piece("head", "cheeks", join(cheeks), fur),
        _eyes(kit, 0.11 * r, 0.42 * r, -0.88 * r, up + 0.15 * r),
        Piece("ears", "", join(ears), fur),
        Piece("ears", "lining", join(lining), inner),
        Piece("paw", "", join(paws + feet), fur),
    ))  # fmt: skip


def penguin(kit: Kit, colour: str) -> Thing:
    r = kit.size(0.052, 0.062)
    coat, orange = kit.plastic(colour), kit.plastic("orange")
    white = kit.plastic("white")
    trunk = ball(r, 26).stretched((1, 0.9, 1.55)).moved((0, 0, 1.55 * r + 0.006))
    front = ball(0.86 * r, 24).stretched((0.92, 0.6, 1.4)).moved((0, -0.46 * r, 1.35 * r))
    head = ball(0.66 * r, 22).moved((0, -0.02 * r, 3.15 * r))
    cheeks = _pair(ball(0.3 * r, 16).stretched((1, 0.6, 1.2)), 0.24 * r, -0.46 * r, 3.14 * r)
    beak = rod((0, -0.5 * r, 3.02 * r), (0, -1.02 * r, 2.9 * r), 0.17 * r, 0.03 * r)
    foot = ball(0.36 * r, 16).stretched((1, 1.5, 0.35))
    wings = [
        ball(0.5, 18).stretched((0.26 * r, 0.75 * r, 1.8 * r)).moved((0, 0, -0.75 * r))
        .turned(rotation_about("y", x * -24)).moved((x * 0.88 * r, 0, 2.5 * r)) for x in (-1, 1)
    ]  # fmt: skip
    return Thing("penguin", colour, (
        Piece("body", "", trunk, coat),
        Piece("body", "belly", front, white),
        Piece("wing", "", wings[0], coat, 0),
        Piece("wing", "", wings[1], coat, 1),
        Piece("head", "", head, coat),
        Piece("head", "cheeks", join(cheeks), white),
        Piece("head", "beak", beak, orange),
        _eyes(kit, 0.09 * r, 0.24 * r, -0.62 * r, 3.28 * r),
        Piece("feet", "", join(_pair(foot, 0.45 * r, -0.4 * r, 0.13 * r)), orange),
    ))  # fmt: skip


def fish(kit: Kit, colour: str) -> Thing:
    """Stands on its belly on a small base, head towards -x."""
    n = kit.size(0.17, 0.2)
    fin = kit.plastic(kit.other(colour, "orange", "yellow", "blue", "red", "purple", "turquoise"))
    up = 0.4 * n
    trunk = ball(0.5, 28).stretched((n, 0.34 * n, 0.56 * n)).moved((0, 0, up))
    band = ball(0.5, 28).stretched((0.13 * n, 0.345 * n, 0.545 * n)).moved((-0.06 * n, 0, up))
    lobe = smooth_outline([(0.4, 0), (0.72, -0.34), (0.64, 0), (0.72, 0.34)], 28) * n
    upright = rotation_about("x", 90)
    tail = plate_of(lobe, 0.012, (0.52 * n, 0)).turned(upright).moved((0, 0.006, up))
    comb = plate_of(smooth_outline([(-0.2, 0.2), (0.28, 0.16), (0.22, 0.4), (-0.02, 0.42)], 28) * n, 0.01,
                    (0.07 * n, 0.3 * n)).turned(upright).moved((0, 0.005, up))  # fmt: skip
    flap = ball(0.5, 14).stretched((0.2 * n, 0.025, 0.13 * n)).turned(rotation_about("y", 30))
    sides = [flap.moved((0.02 * n, y * 0.165 * n, up - 0.08 * n)) for y in (-1, 1)]
    eyes = [ball(0.045 * n, 14).moved((-0.33 * n, y * 0.125 * n, up + 0.07 * n)) for y in (-1, 1)]
    dots = [ball(0.024 * n, 12).moved((-0.345 * n, y * 0.152 * n, up + 0.075 * n)) for y in (-1, 1)]
    stand = join([rod((0, 0, 0.012), (0, 0, up - 0.2 * n), 0.007),
                  ball(0.5, 20).stretched((0.09, 0.09, 0.024)).moved((0, 0, 0.012))])  # fmt: skip
    return Thing("fish", colour, (
        Piece("body", "", trunk, kit.plastic(colour)),
        Piece("body", "band", band, kit.plastic(kit.other(colour, "white", "yellow", "black"))),
        Piece("tail", "", tail, fin),
        Piece("fin", "", comb, fin, 0),
        Piece("fin", "", join(sides), fin, 1),
        Piece("eyes", "", join(eyes), kit.plastic("white")),
        Piece("eyes", "pupil", join(dots), _black(kit)),
        Piece("base", "", stand, kit.wood()),
    ))  # fmt: skip


def snail(kit: Kit, colour: str) -> Thing:
    r = kit.size(0.052, 0.062)
    skin = kit.paint(kit.other(colour, "beige", "brown", "gray", "green", "pink"), gloss=0.35)
    line = np.array([(1.9, 0, 0.08), (1.2, 0, 0.3), (0.2, 0, 0.36), (-0.9, 0, 0.36), (-1.45, 0, 0.62),
                     (-1.7, 0, 1.15), (-1.85, 0, 1.5)]) * r  # fmt: skip
    thick = np.array([0.02, 0.28, 0.36, 0.36, 0.36, 0.34, 0.3]) * r
    fine = np.linspace(0, 6, 25)
    line = np.stack([np.interp(fine, np.arange(7), line[:, c]) for c in range(3)], 1)
    trunk = tube(line, np.interp(fine, np.arange(7), thick), 16)
    head = ball(0.4 * r, 18).moved((-1.9 * r, 0, 1.6 * r))
    turn = np.linspace(0, 2.4 * 2 * np.pi, 64)
    grow = np.exp(-0.13 * turn)
    coil = np.stack([np.cos(turn) * grow, 0 * turn, np.sin(turn) * grow], 1) * 0.95 * r
    shells = [
        tube(coil + np.stack([0 * turn, y * 0.4 * r * (1 - grow), 0 * turn], 1), 0.42 * r * grow, 10)
        for y in (-1, 1)
    ]
    horns = [
        rod((-2.0 * r, y * 0.16 * r, 1.85 * r), (-2.3 * r, y * 0.4 * r, 2.6 * r), 0.07 * r) for y in (-1, 1)
    ]
    tips = [ball(0.12 * r, 12).moved((-2.31 * r, y * 0.41 * r, 2.68 * r)) for y in (-1, 1)]
    place = (0.15 * r, 0.0, 1.75 * r)
    hub = ball(0.5, 20).stretched((1.3 * r, 0.95 * r, 1.3 * r)).moved(place)
    shell = kit.paint(colour, "plain", 0.5, substance="ceramic")
    return Thing("snail", colour, (
        Piece("body", "", trunk, skin),
        Piece("head", "", head, skin),
        Piece("head", "horns", join(horns), skin),
        Piece("head", "eyes", join(tips), _black(kit)),
        Piece("shell", "", join([mesh.moved(place) for mesh in shells]), shell),
        Piece("shell", "coil", hub, kit.paint(kit.other(colour, "white", "brown", "yellow"), gloss=0.4)),
    ))  # fmt: skip


def duck(kit: Kit, colour: str) -> Thing:
    r = kit.size(0.07, 0.085)
    coat = kit.paint(colour, gloss=0.45, substance="plastic")
    trunk = ball(r).stretched((1.3, 1, 0.82)).moved((0, 0, 0.8 * r))
    tail = slab([(0, 0), (0.5 * r, 0.12 * r), (0.62 * r, 0.5 * r)], 0.5 * r).moved((0.9 * r, 0, 0.9 * r))
    wings = [
        ball(r * 0.55, 18).stretched((1.2, 0.3, 0.7)).moved((0.2 * r, y * 0.95 * r, 0.9 * r)) for y in (-1, 1)
    ]
    head = ball(0.62 * r).moved((-0.75 * r, 0, 1.85 * r))
    eyes = [ball(0.1 * r, 12).moved((-1.22 * r, y * 0.33 * r, 2.02 * r)) for y in (-1, 1)]
    beak = ball(0.3 * r, 16).stretched((1.25, 0.9, 0.42)).moved((-1.42 * r, 0, 1.72 * r))
    return Thing("duck", colour, (
        Piece("body", "", join([trunk, tail]), coat),
        Piece("body", "wing", join(wings), kit.paint(colour, gloss=0.3, substance="plastic")),
        Piece("head", "", head, coat),
        Piece("head", "eyes", join(eyes), kit.paint("black", gloss=0.9)),
        Piece("head", "beak", beak, kit.paint(kit.other(colour, "orange", "red"), substance="plastic")),
    ))  # fmt: skip
