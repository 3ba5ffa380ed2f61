"""MaskWeights of masks, W^T onehot(mask), through gsplat's gradients and through the CPU's walk."""

import time
from collections.abc import Iterator

import numpy as np

from gpu_sections import Plan, need_cuda, table
from gpu_sections.pictures import bundled_scene, masked_views
from langsplat_core.config import INRIA
from langsplat_core.raster import gsplat, load_lifting_rasterizer
from langsplat_core.training.language.mask_weights import find_mask_weights


def measure(plan: Plan) -> Iterator[str]:
    """Seconds of both, and how far apart they are."""
    need_cuda()
    scene = bundled_scene(plan)
    views = masked_views(scene, plan)
    masks = sum(len(features.vectors) for _, features in views)
    yield f"# Lifting: {masks} masks of {len(views)} pictures onto {len(scene.gaussians)} Gaussians\n"
    found, rows = {}, []
    for name in ("cpu", "cuda"):
        rasterizer = load_lifting_rasterizer(name)
        find_mask_weights(rasterizer, scene.gaussians, views[:1])
        start = time.perf_counter()
        members = find_mask_weights(rasterizer, scene.gaussians, views, settings=gsplat.drawn_settings(INRIA))
        rows.append((name, time.perf_counter() - start, sum(len(pairs) for pairs in members.pairs)))
        found[name] = members.pairs
    yield table(("backend", "seconds", "pairs of Gaussian and mask"), rows)
    largest = max(_difference(*both, len(scene.gaussians)) for both in zip(*found.values(), strict=True))
    yield f"Largest difference of a weight: {largest:.2g} pixels, of weights up to {_largest(found):.4g}.\n"


def _difference(one: np.ndarray, two: np.ndarray, count: int) -> float:
    """Of the weights of one view; a pair that only one has counts with its whole weight."""
    from scipy import sparse

    width = 1 + max(int(pairs["mask"].max(initial=0)) for pairs in (one, two))
    first, second = (
        sparse.csr_matrix((p["weight"], (p["row"], p["mask"])), shape=(count, width)) for p in (one, two)
    )
    return float(abs(first - second).max())


def _largest(found: dict[str, list[np.ndarray]]) -> float:
    return max(float(pairs["weight"].max(initial=0)) for pairs in found["cpu"])
