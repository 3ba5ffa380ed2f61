"""Masks that all photographs agree on, in place of those that each photograph was given.

A segmenter without weights divides every photograph by itself, each one differently. Their consensus is a
tree of things on the Gaussians (`training.language.merge_tree`); three cuts of it, drawn into each
photograph, are masks that fit from all sides, and these are shown to the encoder.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.pipeline.language_field import Views, kept_mask_weights
from langsplat_core.pipeline.stages import ProcessGroup, features_digest, gaussians_digest, kept, stage_key
from langsplat_core.progress import Progress
from langsplat_core.raster.protocol import LiftingRasterizer
from langsplat_core.scene import Gaussians
from langsplat_core.scene.surface import build_surface
from langsplat_core.semantics.regions import ImageEncoder, embed_regions, fingerprint, within
from langsplat_core.semantics.store import FeatureStore, ImageFeatures, StoredFeatures
from langsplat_core.training.language.merge_tree import MergeTree, find_tree
from langsplat_core.training.language.patch_maps import draw_patches, nested_maps

CUTS = (0.15, 0.4, 0.8)  # costs up to which subparts, parts and wholes grow; chosen in rooms 201 and 203
LEAST = 2.5e-4  # of the image: smaller regions show the encoder nothing
STAGE = "describing what masks agree on"
VERSION = 1


def agreed_features(
    gaussians: Gaussians,
    views: Views,
    photographs: Sequence[tuple[Array, Array | None]],
    encoder: ImageEncoder,
    rasterizer: LiftingRasterizer,
    work: Path,
    progress: Progress,
    processes: ProcessGroup | None = None,
) -> StoredFeatures:
    """Describe masks by the consensus of all views' masks, whose vectors are not read.

    photographs: (H, W, 3) uint8 of each view, and its (H, W) bool mask of pixels that count (None: all do).
    What is finished is kept in `work`.
    """
    processes = processes or ProcessGroup()
    inputs = gaussians_digest(gaussians), [features_digest(features) for _, features in views]
    folder = work / stage_key("rough-memberships", VERSION, *inputs)
    mask_weights = kept_mask_weights(gaussians, views, folder, rasterizer, processes, progress)
    counts = [len(features.vectors) for _, features in views]
    eyes = np.stack([camera.position for camera, _ in views])

    def make() -> MergeTree:
        return find_tree(gaussians, build_surface(gaussians), mask_weights, counts, eyes, progress)

    key = stage_key("tree", VERSION, *inputs)
    tree = processes.once(lambda: kept(work / f"{key}.npz", make, vars, lambda arrays: MergeTree(**arrays)))
    cuts = [tree.cut(cost) for cost in CUTS]
    store = FeatureStore(work / "features")
    made_by = stage_key(key, VERSION, CUTS, LEAST, fingerprint(encoder))
    for index in processes.share(range(len(views))):
        camera, _ = views[index]
        if not store.has(camera.name, made_by):
            drawn = draw_patches(rasterizer.view(gaussians, camera), gaussians, tree.patches)
            image, mask = photographs[index]
            maps = within(nested_maps(drawn, cuts, LEAST), mask)
            vectors = embed_regions(image, maps, encoder)
            store.save(camera.name, ImageFeatures(maps, vectors), made_by)
        progress(STAGE, (index + 1) / len(views))
    processes.barrier()
    return StoredFeatures(store, [camera.name for camera, _ in views])
