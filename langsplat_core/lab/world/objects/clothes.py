"""Builders of things to wear and carry. Each takes a `Kit` and a colour word; front is -y, metres."""

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.lab.world.geometry.shapes import Mesh, arc, ball, box, join, lathe, rotation_about, tube
from langsplat_core.lab.world.geometry.solids import pillow, plate_of, ring, rod, smooth_outline
from langsplat_core.lab.world.objects.kit import Kit, Piece, Thing


def hat(kit: Kit, colour: str) -> Thing:
    """A sun hat with a wide brim and a band."""
    r = kit.size(0.07, 0.08)
    brim = lathe(
        [(1.0 * r, 0.012), (1.95 * r, 0.004), (2.0 * r, 0.008), (1.95 * r, 0.011), (1.0 * r, 0.02)], 48
    )
    turn = np.arctan2(brim.vertices[:, 1], brim.vertices[:, 0])
    far = np.clip(np.hypot(brim.vertices[:, 0], brim.vertices[:, 1]) / r - 1, 0, 1)
    wave = 0.012 * (1 + np.cos(2 * turn + kit.size(0, 6))) * far
    bent = Mesh(brim.vertices + np.stack([0 * wave, 0 * wave, wave], 1), brim.triangles, brim.normals)
    crown = lathe([(1.02 * r, 0.014), (0.97 * r, 0.05), (0.85 * r, 0.082), (0.5 * r, 0.1), (0, 0.104)], 40)
    band = lathe([(1.045 * r, 0.018), (1.02 * r, 0.042)], 40)
    loops = [
        ball(0.5, 14)
        .stretched((0.03, 0.012, 0.02))
        .turned(rotation_about("y", s * 25))
        .moved((s * 0.015, 0, 0))
        for s in (-1, 1)
    ]
    bow = join([*loops, ball(0.008, 10)]).moved((0, -1.07 * r, 0.03))
    straw = kit.paint(colour, "cloth", 0.02)
    ribbon = kit.cloth(kit.other(colour, "red", "blue", "black", "white", "purple", "green"))
    return Thing("hat", colour, (
        Piece("brim", "", bent, straw),
        Piece("crown", "", crown, straw),
        Piece("band", "", band, ribbon),
        Piece("band", "bow", bow, ribbon),
    ))  # fmt: skip


def shoe(kit: Kit, colour: str) -> Thing:
    """A trainer, toe towards -x."""
    n = kit.size(0.18, 0.2)
    outline = (
        smooth_outline(
            [
                (-0.5, 0.02),
                (-0.36, -0.19),
                (-0.1, -0.17),
                (0.2, -0.13),
                (0.46, -0.14),
                (0.5, 0),
                (0.46, 0.14),
                (0.2, 0.13),
                (-0.1, 0.17),
                (-0.36, 0.17),
            ],
            60,
        )
        * n
    )
    sole = plate_of(outline, 0.022)
    place = np.linspace(0, 1, 15)
    along = n * (-0.47 + 0.95 * place)
    top = 0.02 + n * np.interp(place, [0, 0.12, 0.35, 0.6, 0.8, 1], [0.03, 0.15, 0.23, 0.42, 0.43, 0.46])
    half = n * np.interp(place, [0, 0.1, 0.3, 0.6, 0.9, 1], [0.03, 0.12, 0.16, 0.125, 0.125, 0.07])
    angle = np.linspace(0, np.pi, 17)
    lid = np.stack(
        [
            np.repeat(along[:, None], 17, 1),
            half[:, None] * np.sign(np.cos(angle)) * np.abs(np.cos(angle)) ** 0.6,
            0.012 + (top[:, None] - 0.012) * np.sin(angle) ** 0.7,
        ],
        -1,
    )
    grid = lathe([(1.0, float(k)) for k in range(15)], 16, cell=10.0).triangles
    points = lid.reshape(-1, 3)
    upper = Mesh(points, grid, _outward(points, (0.05 * n, 0, 0.02)))
    hole = ball(0.5, 22).stretched((0.36 * n, 0.19 * n, 0.03)).turned(rotation_about("y", -5)).moved(
        (0.25 * n, 0, 0.02 + 0.425 * n)
    )  # fmt: skip
    collar = (
        ring(0.5, 0.09, 28, 10).stretched((0.36 * n, 0.2 * n, 0.12)).moved((0.25 * n, 0, 0.022 + 0.42 * n))
    )
    laces = [rod((x * n, -0.07 * n, 0.03 + z * n), (x * n, 0.07 * n, 0.03 + z * n), 0.0055)
             for x, z in ((-0.18, 0.2), (-0.115, 0.235), (-0.05, 0.285), (0.015, 0.335))]  # fmt: skip
    cap = ball(0.5, 20).stretched((0.26 * n, 0.31 * n, 0.2 * n)).moved((-0.34 * n, 0, 0.03))
    coat = kit.cloth(colour)
    white = kit.paint(kit.other(colour, "white", "white", "gray", "black"), gloss=0.2, substance="rubber")
    swoosh = [
        plate_of(
            smooth_outline([(-0.1, 0.1), (0.06, 0.12), (0.22, 0.26), (0.04, 0.18)], 24) * n,
            0.003,
            (0.04 * n, 0.15 * n),
        )
        .turned(rotation_about("x", 90))
        .moved((0.06 * n, y * (0.135 * n) + 0.002, 0.0))
        for y in (-1, 1)
    ]
    return Thing("shoe", colour, (
        Piece("sole", "", sole, white),
        Piece("upper", "", join([upper, collar]), coat),
        Piece("upper", "toe", cap, kit.paint(kit.pick("white", colour), gloss=0.2, substance="rubber")),
        Piece("upper", "opening", hole, kit.cloth(kit.other(colour, "black", "gray"))),
        Piece("upper", "stripe", join(swoosh),
              kit.plastic(kit.other(colour, "white", "yellow", "black", "red"))),
        Piece("laces", "", join(laces), kit.cloth(kit.other(colour, "white", "yellow", "black"))),
    ))  # fmt: skip


def _outward(points: Array, centre: tuple[float, float, float]) -> Array:
    away = points - np.array(centre)
    return away / np.linalg.norm(away, axis=1, keepdims=True)


def backpack(kit: Kit, colour: str) -> Thing:
    w, d, h = kit.size(0.13, 0.15), 0.08, kit.size(0.18, 0.21)
    coat = kit.cloth(colour)
    second = kit.cloth(kit.other(colour, "yellow", "blue", "red", "gray", "black", "green"))
    pocket = pillow(0.78 * w, 0.055, 0.46 * h, 5, 28).moved((0, -0.46 * d - 0.012, 0.02))
    flap = pillow(w * 1.03, d * 1.08, 0.26 * h, 4, 30).moved((0, -0.004, 0.76 * h))
    zipper = rod((-0.27 * w, -0.46 * d - 0.04, 0.38 * h), (0.27 * w, -0.46 * d - 0.04, 0.38 * h), 0.004)
    loop = tube(arc((0, 1.0 * h), 0.026, 0, 180, 14), 0.006, 10)
    buckle = box(0.022, 0.008, 0.03).moved((0, -0.56 * d, 0.7 * h))
    line = np.array([(0, 0.4, 0.94), (0, 0.85, 0.8), (0, 1.0, 0.5), (0, 0.8, 0.2), (0, 0.42, 0.08)]) * (
        1,
        d,
        h,
    )
    fine = np.linspace(0, 4, 17)
    path = np.stack([np.interp(fine, np.arange(5), line[:, c]) for c in range(3)], 1)
    straps = [tube(path, 0.009, 10).stretched((1.7, 1, 1)).moved((x * 0.27 * w, 0, 0)) for x in (-1, 1)]
    return Thing("backpack", colour, (
        Piece("body", "", pillow(w, d, h, 5, 32), coat),
        Piece("flap", "", flap, second),
        Piece("flap", "buckle", buckle, kit.steel(kit.pick("gray", "yellow"))),
        Piece("pocket", "", pocket, kit.cloth(kit.pick(colour, second.word))),
        Piece("pocket", "zip", zipper, kit.steel(kit.pick("gray", "yellow"))),
        Piece("strap", "", join(straps), second),
        Piece("handle", "", loop, second),
    ))  # fmt: skip
