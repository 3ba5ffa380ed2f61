"""What speaks against a trained scene: a run that ends without an error may still have made one that nobody
wants to see, and then it says so."""

from collections.abc import Sequence

import numpy as np
from scipy.sparse.csgraph import connected_components, minimum_spanning_tree
from scipy.spatial.distance import pdist, squareform

from langsplat_core.arrays import Array
from langsplat_core.scene import Camera
from langsplat_core.training.radiance.train import ViewScore

LEAST_PSNR = 16.0  # dB: below, held-out photographs are hardly recognised
LEAST_COVERED = 0.5  # of a picture's pixels
APART = 10.0  # times the median step to a neighbouring camera; captures that went well have at most 5


def doubts(scores: Sequence[ViewScore], cameras: Sequence[Camera]) -> tuple[str, ...]:
    """One sentence each, with the remedy; none where nothing speaks against the scene.

    scores: of held-out views, or none; cameras: all that were trained on.
    """
    found = []
    if scores:
        psnr = float(np.mean([score.psnr for score in scores]))
        covered = float(np.mean([score.covered for score in scores]))
        if psnr < LEAST_PSNR:
            found.append(
                f"held-out photographs are reproduced at {psnr:.1f} dB, below {LEAST_PSNR:g}: cameras may "
                "be wrong, or photographs too few; take more that overlap, or give COLMAP's cameras"
            )
        if covered < LEAST_COVERED:
            found.append(
                f"only {100 * covered:.0f} % of the held-out pictures' pixels show anything: photograph "
                "what is there from more sides, or train for more steps"
            )
    groups = camera_groups(np.array([camera.position for camera in cameras]).reshape(-1, 3))
    if len(groups) > 1:
        sizes = " and ".join(str(size) for size in groups)
        found.append(
            f"the cameras stand in {len(groups)} groups far apart ({sizes} photographs): they may not belong "
            "together; add photographs between them, or train each group alone"
        )
    return tuple(found)


def camera_groups(positions: Array) -> tuple[int, ...]:
    """Sizes of the groups of (M, 3) positions that lie `APART`, largest first; one where they are together.
    A single camera on its own is no group."""
    if len(positions) < 4:
        return (len(positions),)
    tree = minimum_spanning_tree(squareform(pdist(positions))).toarray()
    steps = tree[tree > 0]
    if len(steps) == 0:
        return (len(positions),)
    tree[tree > APART * np.median(steps)] = 0
    _, labels = connected_components(tree, directed=False)
    sizes = np.sort(np.bincount(labels))[::-1]
    return tuple(int(size) for size in sizes if size > 1) or (len(positions),)
