"""The report `formats`: what writing a scene in each format and reading it back changes."""

import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import tyro

from langsplat_core.arrays import Array, psnr, sigmoid, unit
from langsplat_core.bench.measure import markdown
from langsplat_core.io.scenes import FORMATS, load_scene, save_scene
from langsplat_core.raster.render import render
from langsplat_core.scene import Gaussians, Scene
from langsplat_core.scene.transform import C0

DEMO = Path(__file__).parents[2] / "assets" / "demo" / "scene.ply"
VIEWS = 4  # that images are compared in
HEAD = ("format", "MB", "position", "scale, %", "rotation, °", "opacity", "colour", "SH", "PSNR, dB")


@dataclass(frozen=True)
class Formats:
    """The largest errors of a scene written in each format and read back, and the lowest PSNR of images."""

    scenes: tyro.conf.Positional[tuple[Path, ...]] = (DEMO,)
    """Scenes to write."""

    def run(self) -> None:
        for path in self.scenes:
            scene = replace(load_scene(path), language=None, unread=())
            print(f"{path.name}: {len(scene.gaussians)} Gaussians of degree {scene.gaussians.sh_degree}\n")
            print(markdown(HEAD, rows(scene)))


def rows(scene: Scene) -> list[list[str]]:
    """The table's rows: format, megabytes, errors, lowest PSNR."""
    table = []
    with tempfile.TemporaryDirectory() as folder:
        for suffix in (row.suffix for row in FORMATS if row.write is not None):
            path = Path(folder) / f"scene{suffix}"
            save_scene(path, scene)
            got = load_scene(path).gaussians
            size, lowest = path.stat().st_size / 1e6, lowest_psnr(scene, got)
            told = [f"{error:.2g}" if error else "0" for error in errors(scene.gaussians, got)]
            table.append([suffix, f"{size:.2f}", *told, f"{lowest:.1f}"])
    return table


def errors(want: Gaussians, got: Gaussians) -> list[float]:
    """Largest error of rows that can be drawn: of positions (world units), scales (percent of the Gaussian's
    longest), rotations (degrees), opacities and base colours (of 1), and higher coefficients."""
    valid = want.valid()
    want, got = want.take(valid), got.take(valid)
    count = min(want.sh.shape[1], got.sh.shape[1])
    rest = got.sh[:, 1:count].astype(np.float64) - want.sh[:, 1:count]
    lost = want.sh[:, count:]

    def largest(difference: Array) -> float:
        return float(np.abs(difference).max(initial=0))

    # Of two unit quaternions, by the sine of half the angle: a cosine knows no small angles.
    one, other = (unit(rows.quats_wxyz.astype(np.float64), 1e-30) for rows in (want, got))
    halves = np.minimum(np.linalg.norm(one - other, axis=1), np.linalg.norm(one + other, axis=1)) / 2
    axes, others = (np.exp(rows.log_scales.astype(np.float64)) for rows in (want, got))
    scales = (others - axes) / np.maximum(axes.max(axis=1, keepdims=True), 1e-300)
    return [
        largest(got.means.astype(np.float64) - want.means),
        100 * largest(scales),
        largest(np.degrees(4 * np.arcsin(halves.clip(0, 1)))),
        largest(sigmoid(got.opacity_logits.astype(float)) - sigmoid(want.opacity_logits.astype(float))),
        C0 * largest(got.sh[:, 0].astype(np.float64) - want.sh[:, 0]),
        max(largest(rest), largest(lost)),
    ]


def lowest_psnr(scene: Scene, got: Gaussians) -> float:
    """Of images of `got` against those of the scene, dB; at most 100."""
    step = max(1, len(scene.cameras) // VIEWS)
    cameras = scene.cameras[::step][:VIEWS] or (scene.framing_camera((400, 320)),)
    scenes = (scene, replace(scene, gaussians=got))
    images = [[render(one, camera).colours.clip(0, 1) for one in scenes] for camera in cameras]
    return min(psnr(*pair) for pair in images)
