"""Builders of toy vehicles. Each takes a `Kit` and a colour word; front is -x, metres."""

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
from langsplat_core.lab.world.geometry.solids import pillow, plate_of, rod, smooth_outline
from langsplat_core.lab.world.objects.kit import Kit, Piece, Thing


def _wheel(radius: float, width: float, x: float, y: float) -> tuple[Mesh, Mesh]:
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
    coat, second = (
        kit.plastic(colour),
        kit.plastic(kit.other(colour, "red", "blue", "yellow", "green", "black")),
    )
    r = 0.036
    boiler = cylinder(r, 0.6 * n, 28).turned(rotation_about("y", 90)).moved((-n / 2 + 0.008, 0, 0.1))
    nose = cylinder(0.82 * r, 0.006, 28).turned(rotation_about("y", 90)).moved((-n / 2 + 0.003, 0, 0.1))
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
    coat, second = (
        kit.plastic(colour),
        kit.plastic(kit.other(colour, "white", "red", "yellow", "blue", "orange")),
    )
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
    blades = [
        box(0.006, 0.012, 0.048).moved((0, 0, 0.006)).turned(rotation_about("x", 120 * k + 20))
        for k in range(3)
    ]
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
    hull = Mesh(lifted, shell.triangles, shell.normals)
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
    trunk = lathe(
        [
            (0, low),
            (0.7 * r, low),
            (0.94 * r, low + 0.2 * h),
            (r, low + 0.42 * h),
            (0.84 * r, low + 0.66 * h),
        ],
        30,
    )
    nose = lathe(
        [(0.84 * r, low + 0.66 * h), (0.62 * r, low + 0.8 * h), (0.3 * r, low + 0.93 * h), (0, low + h)], 30
    )
    nozzle = lathe([(0.0, 0.03), (0.62 * r, 0.018), (0.5 * r, low), (0, low)], 24)
    ring = cylinder(0.42 * r, 0.008, 24).turned(rotation_about("x", 90)).moved((0, -0.95 * r, low + 0.46 * h))
    pane = (
        cylinder(0.3 * r, 0.008, 24)
        .turned(rotation_about("x", 90))
        .moved((0, -0.97 * r - 0.003, low + 0.46 * h))
    )
    fin = slab(
        [
            (0.6 * r, low + 0.06 * h),
            (1.55 * r, 0.0),
            (1.95 * r, 0.0),
            (1.75 * r, low),
            (0.9 * r, low + 0.34 * h),
        ],
        0.009,
    )
    turns = [rotation_about("z", 45 + 90 * k) for k in range(4)]
    ports = [mesh.turned(rotation_about("z", 180)) for mesh in (ring, pane)]
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
