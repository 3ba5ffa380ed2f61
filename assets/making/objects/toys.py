"""Builders of toys, toy vehicles and animals.

Each takes a `Kit` and a colour word. Front is -x for vehicles and -y for the others, metres.
"""

from dataclasses import replace

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
    plate_of,
    rod,
    rotation_about,
    slab,
    smooth_outline,
    tube,
)


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
    hub_paint = kit.paint(kit.pick("gray", "white", "yellow"), substance="plastic")
    side = rotation_about("x", 90)
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
        tube(arc((0.028, 0), 0.026, -165, 165, 14), 0.009, 8).stretched((1, 1.7, 0.8)).spun("z", 90 * k + 45)
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
    tiles = [plank.moved((x * span / 2, 0, 0)).spun("y", x * slope).moved((0, 0, peak)) for x in (-1, 1)]
    stack = box(0.026, 0.026, 0.06).moved((w * 0.25, 0, h + 0.03))
    roof = kit.paint(kit.other(colour, "red", "brown", "blue", "gray"), "striped", 0.1)
    glass = kit.paint(kit.other(colour, "turquoise", "white", "yellow"), substance="glass")
    door = kit.paint(kit.other(colour, "brown", "green", "red"), substance="wood")
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
        arm = join([cylinder(0.012, 0.085, 16), ball(0.018, 14)]).spun("y", x * -14)
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


def _wheel(radius: float, width: float, x: float, y: float) -> tuple[TriMesh, TriMesh]:
    """Tyre and hub that stand on z = 0 at x, with their axle along y."""
    turn = rotation_about("x", 90)
    place = (x, y + width / 2, radius)
    hub = (
        cylinder(radius * 0.55, width * 1.12, 14, 0.03).moved((0, 0, -0.06 * width)).turned(turn).moved(place)
    )
    return cylinder(radius, width, 22, 0.03).turned(turn).moved(place), hub


def train(kit: Kit, colour: str) -> Thing:
    """A steam engine: boiler with funnel, driver's cab, wheels."""
    n, w = kit.size(0.21, 0.24), 0.075
    coat = kit.plastic(colour)
    second = kit.plastic(kit.other(colour, "red", "blue", "yellow", "green", "black"))
    r = 0.036
    boiler = cylinder(r, 0.6 * n, 28).spun("y", 90).moved((-n / 2 + 0.008, 0, 0.1))
    nose = cylinder(0.82 * r, 0.006, 28).spun("y", 90).moved((-n / 2 + 0.003, 0, 0.1))
    funnel = lathe([(0.012, 0), (0.012, 0.035), (0.023, 0.06), (0.024, 0.066), (0.017, 0.066), (0, 0.05)], 24)
    dome = ball(0.019, 18).moved((0.02 * n, 0, 0.1 + r))
    cab = box(0.32 * n, 1.15 * w, 0.1).moved((0.33 * n, 0, 0.056))
    roof = box(0.42 * n, 1.45 * w, 0.01).moved((0.33 * n, 0, 0.156))
    catcher = slab([(-n / 2 - 0.03, 0.012), (-n / 2 + 0.012, 0.012), (-n / 2 + 0.012, 0.055)], w * 0.9)
    panes = join([box(0.17 * n, 1.17 * w, 0.04).moved((0.33 * n, 0, 0.1)),
                  box(0.33 * n, 0.75 * w, 0.04).moved((0.33 * n, 0, 0.1))])  # fmt: skip
    pieces: list[Piece] = []
    for k, (x, y) in enumerate((x, y) for x in (-0.34, -0.05, 0.34) for y in (-1, 1)):
        tyre, hub = _wheel(0.031 if x < 0.3 else 0.036, 0.016, x * n, y * w * 0.62)
        pieces += [Piece("wheel", "", tyre, kit.plastic("black") if k == 0 else pieces[0].material, k),
                   Piece("wheel", "hub", hub, second, k)]  # fmt: skip
    return Thing("train", colour, (
        Piece("boiler", "", boiler, coat),
        Piece("boiler", "front", nose, second),
        Piece("boiler", "dome", dome, kit.steel("yellow")),
        Piece("funnel", "", funnel.moved((-0.36 * n, 0, 0.1 + 0.9 * r)), second),
        Piece("cab", "", cab, coat),
        Piece("cab", "roof", roof, second),
        Piece("cab", "window", panes, kit.glass("turquoise")),
        Piece("frame", "", join([box(n, w * 0.85, 0.022).moved((0, 0, 0.036)), catcher]), second),
        *pieces,
    ))  # fmt: skip


def airplane(kit: Kit, colour: str) -> Thing:
    n = kit.size(0.23, 0.26)
    coat = kit.plastic(colour)
    second = kit.plastic(kit.other(colour, "white", "red", "yellow", "blue", "orange"))
    up, r = 0.075, 0.028
    place = np.linspace(0, 1, 16)
    line = np.stack([n * (place - 0.5), 0 * place, up + 0.018 * place**3], 1)
    thick = (
        r * np.sqrt(np.clip(1 - (1 - np.minimum(place / 0.22, 1)) ** 2, 0, 1)) * (1 - 0.82 * place**3) + 1e-4
    )
    wing = plate_of(smooth_outline([(-0.055, 0), (-0.03, -0.15), (0.018, -0.15), (0.03, 0), (0.018, 0.15),
                                    (-0.03, 0.15)], 48), 0.009)  # fmt: skip
    rudder = slab([(0, 0), (0.05, 0), (0.062, 0.062), (0.034, 0.062)], 0.008)
    tail = plate_of(
        smooth_outline([(-0.02, 0), (0.0, -0.065), (0.026, -0.065), (0.026, 0.065), (0, 0.065)], 30), 0.007
    )
    blades = [box(0.006, 0.012, 0.048).moved((0, 0, 0.006)).spun("x", 120 * k + 20) for k in range(3)]
    nose = (-n / 2 - 0.006, 0.0, up)
    panes = [ball(0.0075, 10).stretched((1, 0.4, 1)).moved((x * n, y * 0.93 * r, up + 0.008))
             for x in (-0.12, -0.03, 0.06, 0.15) for y in (-1, 1)]  # fmt: skip
    glass = ball(0.023, 18).stretched((1.5, 0.85, 0.8)).moved((-0.22 * n, 0, up + 0.018))
    gear = []
    for x, y in ((-0.28, 0), (0.06, -0.05), (0.06, 0.05)):
        tyre, _ = _wheel(0.015, 0.01, x * n, y)
        gear += [tyre, rod((x * n, y, 0.015), (x * n, y * 0.7, up - 0.01), 0.004)]
    return Thing("airplane", colour, (
        Piece("body", "", tube(line, thick, 24), coat),
        Piece("body", "window", join(panes), kit.glass("turquoise")),
        Piece("body", "cockpit", glass, kit.glass(kit.pick("blue", "black"))),
        Piece("wing", "", wing.moved((0.0, 0, up - 0.012)), second, 0),
        Piece("tail", "", tail.moved((n / 2 - 0.032, 0, up + 0.012)), second),
        Piece("tail", "rudder", rudder.moved((n / 2 - 0.052, 0, up + 0.016)), second),
        Piece("propeller", "", join([*[b.moved(nose) for b in blades], ball(0.011, 14).moved(nose)]),
              kit.steel("gray")),
        Piece("wheel", "", join(gear), kit.plastic("black")),
    ))  # fmt: skip


def boat(kit: Kit, colour: str) -> Thing:
    """A sailing boat: hull, deck, mast, two sails."""
    n, h = kit.size(0.2, 0.24), kit.size(0.23, 0.27)
    w, deep = 0.36 * n, 0.052
    place = np.linspace(0, 1, 17)
    wide = np.where(
        place < 0.75, np.sin(np.minimum(place, 0.55) / 0.55 * np.pi / 2) ** 0.8, 1 - (place - 0.75) * 0.9
    )
    outline = np.concatenate([
        np.stack([n * (place - 0.5), -w / 2 * wide], 1), np.stack([n * (place - 0.5), w / 2 * wide], 1)[::-1],
    ])[1:]  # fmt: skip
    deck = plate_of(outline * (0.97, 0.94), 0.006, (0.05, 0)).moved((0, 0, deep - 0.004))
    shell = plate_of(outline, deep, (0.05, 0))
    rise = shell.vertices[:, 2:] / deep
    squeeze = np.where(rise > 0, 1, 0.55)
    lifted = shell.vertices * np.concatenate([0.5 + squeeze / 2, squeeze, 1 + 0 * rise], 1)
    hull = TriMesh(lifted, shell.triangles, shell.normals)
    mast = rod((0, 0, deep), (0, 0, h), 0.0055)
    boom = rod((0, 0, deep + 0.025), (0.42 * n, 0, deep + 0.025), 0.0045)
    main = slab([(0.008, deep + 0.032), (0.41 * n, deep + 0.032), (0.008, h - 0.006)], 0.004)
    jib = slab([(-0.46 * n, deep + 0.014), (-0.008, deep + 0.024), (-0.008, h - 0.04)], 0.004)
    flag = slab([(0.004, h - 0.002), (0.045, h + 0.008), (0.004, h + 0.022)], 0.003)
    canvas = kit.other(colour, "white", "red", "yellow", "blue", "orange")
    return Thing("boat", colour, (
        Piece("hull", "", hull, kit.plastic(colour)),
        Piece("hull", "deck", deck, kit.wood(kit.pick("brown", "beige"))),
        Piece("mast", "", join([mast, boom]), kit.wood()),
        Piece("mast", "flag", flag, kit.cloth(kit.other(canvas, "red", "blue", "green"))),
        Piece("sail", "", main, kit.cloth(canvas), 0),
        Piece("sail", "", jib, kit.cloth(kit.pick(canvas, "white")), 1),
    ))  # fmt: skip


def rocket(kit: Kit, colour: str) -> Thing:
    r, h = kit.size(0.036, 0.044), kit.size(0.2, 0.24)
    low = 0.045
    second = kit.plastic(kit.other(colour, "red", "blue", "yellow", "orange", "white"))
    trunk = lathe([(0, low), (0.7 * r, low), (0.94 * r, low + 0.2 * h), (r, low + 0.42 * h),
                   (0.84 * r, low + 0.66 * h)], 30)  # fmt: skip
    nose = lathe(
        [(0.84 * r, low + 0.66 * h), (0.62 * r, low + 0.8 * h), (0.3 * r, low + 0.93 * h), (0, low + h)], 30
    )
    nozzle = lathe([(0.0, 0.03), (0.62 * r, 0.018), (0.5 * r, low), (0, low)], 24)
    ring = cylinder(0.42 * r, 0.008, 24).spun("x", 90).moved((0, -0.95 * r, low + 0.46 * h))
    pane = cylinder(0.3 * r, 0.008, 24).spun("x", 90).moved((0, -0.97 * r - 0.003, low + 0.46 * h))
    fin = slab([(0.6 * r, low + 0.06 * h), (1.55 * r, 0.0), (1.95 * r, 0.0), (1.75 * r, low),
                (0.9 * r, low + 0.34 * h)], 0.009)  # fmt: skip
    turns = [rotation_about("z", 45 + 90 * k) for k in range(4)]
    ports = [mesh.spun("z", 180) for mesh in (ring, pane)]
    return Thing("rocket", colour, (
        Piece("body", "", trunk, kit.plastic(colour)),
        Piece("body", "window", join([pane, ports[1]]), kit.glass(kit.pick("turquoise", "blue"))),
        Piece("body", "window", join([ring, ports[0]]), kit.metal()),
        Piece("nose", "", nose, second),
        Piece("nozzle", "", nozzle, kit.metal()),
        *(Piece("fin", "", fin.turned(turn), second, k) for k, turn in enumerate(turns)),
    ))  # fmt: skip


def truck(kit: Kit, colour: str) -> Thing:
    """A tipper: cab in front, an open load bed of another colour."""
    n, w = kit.size(0.24, 0.27), 0.11
    bed_paint = kit.plastic(kit.other(colour, "yellow", "gray", "orange", "blue", "red", "green"))
    cab = pillow(0.3 * n, w, 0.115, 9, 30).moved((-0.34 * n, 0, 0.04))
    shield = box(0.004, 0.8 * w, 0.04).moved((-0.493 * n, 0, 0.095))
    sides = join([box(0.13 * n, w * 1.01, 0.036).moved((-0.36 * n, 0, 0.097))])
    lights = join([ball(0.009, 12).moved((-0.487 * n, y * 0.36 * w, 0.062)) for y in (-1, 1)])
    chassis = box(0.96 * n, 0.7 * w, 0.02).moved((0, 0, 0.035))
    bed = join([
        box(0.62 * n, w * 1.08, 0.008).moved((0.18 * n, 0, 0.06)),
        *[box(0.62 * n, 0.007, 0.055).moved((0.18 * n, y * 0.54 * w, 0.06)) for y in (-1, 1)],
        *[box(0.007, w * 1.08, 0.055).moved((0.18 * n + x * 0.31 * n, 0, 0.06)) for x in (-1, 1)],
    ])  # fmt: skip
    heap = lathe([(0.47 * w, 0.066), (0.3 * w, 0.1), (0.1 * w, 0.122), (0, 0.124)], 24).stretched(
        (1.15, 1, 1)
    )
    sand = kit.paint(kit.pick("brown", "beige"), "rug", 0.0, substance="skin")
    pieces = []
    black = kit.paint("black", gloss=0.3, substance="rubber")
    for k, (x, y) in enumerate((x, y) for x in (-0.32, 0.08, 0.36) for y in (-1, 1)):
        tyre, hub = _wheel(0.031, 0.024, x * n, y * w * 0.46)
        pieces += [Piece("wheel", "", tyre, black, k), Piece("wheel", "hub", hub, kit.metal(), k)]
    return Thing("truck", colour, (
        Piece("cab", "", join([cab, chassis]), kit.plastic(colour)),
        Piece("cab", "window", join([shield, sides]), kit.glass("turquoise")),
        Piece("cab", "lights", lights, kit.plastic("yellow")),
        Piece("container", "", bed, bed_paint),
        Piece("container", "load", heap.moved((0.18 * n, 0, 0)), sand),
        *pieces,
    ))  # fmt: skip


def _pair(mesh: TriMesh, x: float, y: float, z: float) -> list[TriMesh]:
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
        .spun("y", x * -24).moved((x * 0.88 * r, 0, 2.5 * r)) for x in (-1, 1)
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
    flap = ball(0.5, 14).stretched((0.2 * n, 0.025, 0.13 * n)).spun("y", 30)
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
