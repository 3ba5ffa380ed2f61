"""Latent colours of things that lie side by side: how far apart they are to the eye."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from skimage.color import deltaE_ciede2000, rgb2lab

from langsplat_core.arrays import Array
from langsplat_core.bench.measure import markdown
from langsplat_core.display.displays import latent_colours
from langsplat_core.errors import InputError
from langsplat_core.io.scenes import load_scene
from langsplat_core.scene import LEVELS, NO_NODE, Scene
from langsplat_core.scene.surface import build_surface
from langsplat_core.training.language.palette import FEWEST_LINKS, LEAST

SHARES = (0.0, 0.1, 0.25, 0.5)  # quantiles that are stated


@dataclass(frozen=True)
class Colours:
    """CIEDE2000 differences between the mean latent colours of neighbouring nodes of scenes."""

    scenes: tyro.conf.Positional[tuple[Path, ...]]

    def run(self) -> None:
        head = ("scene", "level", "neighbours", "smallest", "10 %", "25 %", "median")
        rows = []
        for path in self.scenes:
            scene = load_scene(path)
            if scene.language is None or scene.language.tree is None:
                raise InputError(
                    f"{path}: has no language field with a tree; train one, or choose another scene"
                )
            for level in range(len(LEVELS)):
                found = differences(scene, level)
                stated = np.quantile(found, SHARES) if len(found) else np.full(len(SHARES), np.nan)
                rows.append((path.parent.name, LEVELS[level], str(len(found)), *(f"{v:.1f}" for v in stated)))
        print(markdown(head, rows))


def differences(scene: Scene, level: int) -> Array:
    """(P,) of the pairs of neighbouring nodes at a level."""
    field = scene.language
    assert field is not None
    assert field.tree is not None
    node, surface = field.tree.at(level), build_surface(scene.gaussians)
    names, number, sizes = np.unique(node, return_inverse=True, return_counts=True)
    colours = latent_colours(field)[level].astype(np.float64)
    means = np.stack([np.bincount(number, colours[:, k]) / sizes for k in range(3)], 1)
    ends = np.sort(np.stack([number[surface.rows[end]] for end in surface.ends]), axis=0)
    pairs, links = np.unique(ends[:, ends[0] != ends[1]], axis=1, return_counts=True)
    counted = (names[pairs] != NO_NODE).all(0) & (sizes[pairs] >= LEAST).all(0) & (links >= FEWEST_LINKS)
    first, second = (rgb2lab(means[one]) for one in pairs[:, counted])
    return np.asarray(deltaE_ciede2000(first, second))
