"""Draws langsplat-viewer.png: three Gaussians, blended front to back like any scene."""

from pathlib import Path

import numpy as np

from langsplat_core.arrays import Array
from langsplat_viewer.output import save_png

SIDE = 256  # pixels
EDGE, SOFT = 2.0, 0.08  # standard deviations: where a Gaussian ends, and within what
# Nearest first: centre, standard deviations (shares of the side), turn in degrees, colour.
BLOBS = (
    ((0.33, 0.64), (0.15, 0.085), -35, (1.00, 0.40, 0.22)),
    ((0.67, 0.64), (0.15, 0.085), 35, (0.10, 0.62, 0.96)),
    ((0.50, 0.37), (0.095, 0.17), 0, (0.98, 0.80, 0.20)),
)


def icon() -> Array:
    """(SIDE, SIDE, 4) uint8."""
    at = (np.stack(np.meshgrid(np.arange(SIDE), np.arange(SIDE)), -1) + 0.5) / SIDE
    colour, light = np.zeros((SIDE, SIDE, 3)), np.ones((SIDE, SIDE, 1))
    for centre, sigma, turn, paint in BLOBS:
        angle = np.radians(turn)
        axes = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        distance = (((at - centre) @ axes / sigma) ** 2).sum(-1, keepdims=True)
        inside = np.clip((EDGE - np.sqrt(distance)) / SOFT, 0, 1)  # so that it has an outline at 16 pixels
        alpha = inside * (0.45 + 0.5 * np.exp(-0.5 * distance))
        colour += light * alpha * paint
        light = light * (1 - alpha)
    opaque = 1 - light
    straight = colour / np.maximum(opaque, 1e-6)
    return np.rint(255 * np.concatenate([straight, opaque], 2)).astype(np.uint8)


if __name__ == "__main__":
    save_png(Path(__file__).with_name("langsplat-viewer.png"), icon())
