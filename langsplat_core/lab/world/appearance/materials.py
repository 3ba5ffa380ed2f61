"""How substances take light: highlight, relief, and the table of numbers that shading reads."""

from dataclasses import dataclass

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.lab.world.appearance.colours import to_linear
from langsplat_core.lab.world.appearance.textures import KINDS
from langsplat_core.lab.world.objects.kit import Material


@dataclass(frozen=True)
class Finish:
    """One substance. Highlights stay weak: a scene of few Gaussians cannot follow mirrors."""

    mirror: float  # reflectance straight on, [0, 1]
    sharpness: float  # exponent of the highlight
    diffuse: float = 1.0  # share of the colour that scatters light
    tint: float = 0.0  # share of the highlight that takes the surface's colour


FINISHES: dict[str, Finish] = {
    "plastic": Finish(0.04, 60),
    "ceramic": Finish(0.055, 150),
    "glass": Finish(0.09, 200, 0.9),
    "metal": Finish(0.45, 35, 0.55, 0.7),
    "wood": Finish(0.03, 25),
    "cloth": Finish(0.0, 4),
    "paper": Finish(0.01, 8),
    "plaster": Finish(0.0, 4),
    "leaf": Finish(0.035, 22),
    "skin": Finish(0.04, 28),
    "rubber": Finish(0.02, 10),
    "wax": Finish(0.03, 18),
}
_BY_TEXTURE = {
    "wood": "wood", "planks": "wood", "cloth": "cloth", "rug": "cloth", "metal": "metal", "pages": "paper",
    "painting": "paper", "leaf": "leaf", "peel": "skin", "plaster": "plaster", "tiles": "ceramic",
}  # fmt: skip
# How strongly a pattern is also carved: change of the light per unit of the pattern's weight.
_RELIEF = {
    "wood": 0.1, "planks": 0.2, "cloth": 0.3, "tiles": 0.22, "rug": 0.5, "plaster": 0.12, "leaf": 0.35,
    "peel": 0.5, "pages": 0.15, "striped": 0.2, "painting": 0.1, "metal": 0.05,
}  # fmt: skip


def finish_of(material: Material) -> Finish:
    """What a material is made of, or what its texture and gloss suggest."""
    by_gloss = "glass" if material.gloss >= 0.85 else "ceramic" if material.gloss >= 0.5 else "plastic"
    if material.gloss < 0.2:
        by_gloss = "paper"
    return FINISHES[material.substance or _BY_TEXTURE.get(material.texture, by_gloss)]


def material_table(materials: tuple[Material, ...]) -> tuple[Array, Array]:
    """(P,) int32 pattern of every piece, and (P, 12) float32: colour, second colour (sRGB), mirror,
    sharpness, diffuse, tint, relief, 0."""
    kinds = np.array([KINDS.index(m.texture) for m in materials], np.int32)
    rows = np.zeros((len(materials), 12), np.float32)
    for row, material in zip(rows, materials, strict=True):
        finish = finish_of(material)
        mirror = finish.mirror * min(1.0, 0.25 + 1.5 * material.gloss)
        row[:3], row[3:6] = material.colour, material.second
        row[6:11] = mirror, finish.sharpness, finish.diffuse, finish.tint, _RELIEF.get(material.texture, 0)
    return kinds, rows


def mean_reflectance(materials: tuple[Material, ...]) -> Array:
    """(P, 3) linear reflectance of every piece on average, for light that bounces off it."""
    return np.array([to_linear(0.75 * m.colour + 0.25 * m.second) * finish_of(m).diffuse for m in materials])
