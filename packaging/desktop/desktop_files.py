"""Make what a desktop is told of the viewer.

python packaging/desktop/desktop_files.py         print the description of scene files (shared-mime-info)
python packaging/desktop/desktop_files.py icon    draw langsplat-viewer.png again
"""

import sys
from pathlib import Path

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.io.scenes import formats
from langsplat_viewer.output import save_png

HEAD = '<?xml version="1.0" encoding="UTF-8"?>\n<mime-info xmlns="http://www.freedesktop.org/standards/shared-mime-info">'
NAMES = {
    "model/x-gaussian-splat": "3D Gaussian scene",
    "model/x-ply": "3D points, mesh or Gaussians (PLY)",
    "model/gltf-binary": "3D scene (glTF, binary)",
    "model/gltf+json": "3D scene (glTF)",
    "model/vnd.usd": "3D scene (OpenUSD)",
}
FURTHER = {
    "model/x-gaussian-splat": ['<glob pattern="*.compressed.ply" weight="60"/>'],
    "model/x-ply": [
        '<magic priority="50">',
        '  <match type="string" offset="0" value="ply\\n"/>',
        '  <match type="string" offset="0" value="ply\\r\\n"/>',
        "</magic>",
    ],
}


def mime_info() -> str:
    """Return the XML, a glob for each suffix."""
    lines = [HEAD]
    for mime, name in NAMES.items():
        globs = [f'<glob pattern="*{row.suffix}"/>' for row in formats() if row.mime == mime]
        inside = [f"<comment>{name}</comment>", *FURTHER.get(mime, []), *globs]
        lines += [f'  <mime-type type="{mime}">', *(f"    {line}" for line in inside), "  </mime-type>"]
    return "\n".join([*lines, "</mime-info>"])


SIDE = 256  # pixels
EDGE, SOFT = 2.0, 0.08  # standard deviations: where a Gaussian ends, and within what
# Nearest first: centre, standard deviations (shares of the side), turn in degrees, colour.
BLOBS = (
    ((0.33, 0.64), (0.15, 0.085), -35, (1.00, 0.40, 0.22)),
    ((0.67, 0.64), (0.15, 0.085), 35, (0.10, 0.62, 0.96)),
    ((0.50, 0.37), (0.095, 0.17), 0, (0.98, 0.80, 0.20)),
)


def icon() -> Array:
    """Return (SIDE, SIDE, 4) uint8: three Gaussians, blended front to back like any scene."""
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
    if sys.argv[1:] == ["icon"]:
        save_png(Path(__file__).with_name("langsplat-viewer.png"), icon())
    else:
        print(mime_info())
