"""Text files of coloured points, `x y z red green blue` a line, as scenes; the command `langsplat extent`."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from langsplat_core import Gaussians, Scene, load_scene
from langsplat_core.cli.arguments import AnyScene
from langsplat_core.errors import FormatError
from langsplat_core.io.scenes import SceneFormat
from langsplat_core.registry import Extension


def read_xyz(path: Path) -> Scene:
    """Return a round Gaussian per point, as wide as the points lie apart on average."""
    try:
        table = np.loadtxt(path, np.float64, ndmin=2)
    except ValueError as error:
        raise FormatError(f"{path}: not numbers in rows ({error}); expected x y z red green blue") from None
    if table.shape[1:] != (6,) or len(table) == 0:
        raise FormatError(f"{path}: expected x y z red green blue in every line")
    means, count = table[:, :3], len(table)
    spacing = np.ptp(means, axis=0).max() / np.cbrt(count) or 1.0
    colours = (table[:, 3:] / 255 - 0.5) / 0.2820948  # coefficients of the constant spherical harmonic
    gaussians = Gaussians(
        means=means,
        log_scales=np.full((count, 3), np.log(spacing / 2)),
        quats_wxyz=np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)),
        opacity_logits=np.full(count, 3.0),
        sh=colours[:, None],
    )
    return Scene(gaussians)


@dataclass(frozen=True)
class Extent:
    """Print how far a scene extends along each axis, in its units."""

    scene: AnyScene

    def run(self) -> None:
        """Read the scene and print."""
        means = load_scene(self.scene).gaussians.means
        print("extent", *(f"{length:.3f}" for length in np.ptp(means, axis=0)))


FORMAT = SceneFormat(".xyz", read_xyz, own_companions=True)
EXTENSION = Extension(formats={".xyz": "langsplat_xyz:FORMAT"}, commands={"extent": "langsplat_xyz:Extent"})
