"""Photographs and masks to train on and to lift from: pictures of the bundled scene, so nothing is needed."""

from dataclasses import replace
from importlib.resources import files
from pathlib import Path

import numpy as np

from gpu_sections import Plan
from langsplat_core import load_scene, render
from langsplat_core.arrays import unit
from langsplat_core.bench.measure import label_maps
from langsplat_core.datasets.capture import Capture
from langsplat_core.scene import Camera, Scene
from langsplat_core.semantics.store import ImageFeatures

POINTS = 10_000  # of the scene's own centres, shaken, in place of structure from motion's


def bundled_scene(plan: Plan) -> Scene:
    """The demo, at most so many of its Gaussians, without what they mean."""
    whole = load_scene(Path(str(files("langsplat_assets"))) / "demo" / "scene.ply")
    rows = np.arange(min(len(whole.gaussians), plan.most))
    return Scene(whole.gaussians.take(rows), cameras=whole.cameras)


def cameras(scene: Scene, plan: Plan) -> list[Camera]:
    """Of the scene, evenly chosen, of the plan's size."""
    chosen = np.linspace(0, len(scene.cameras) - 1, plan.pictures).round().astype(int)
    return [replace(scene.cameras[index].resized(*plan.size), name=f"{index:03}") for index in chosen]


def capture(scene: Scene, plan: Plan) -> Capture:
    """What a photographer would have brought home."""
    views = cameras(scene, plan)
    images = [
        np.round(255 * np.clip(render(scene, view, backend="cpu").colours, 0, 1)).astype(np.uint8)
        for view in views
    ]
    rng = np.random.default_rng(0)
    means = scene.gaussians.means[scene.gaussians.valid()].astype(np.float64)
    points = means[rng.choice(len(means), min(POINTS, len(means)), replace=False)]
    points = points + 0.005 * np.ptp(means, axis=0).max() * rng.normal(size=points.shape)
    return Capture(tuple(views), tuple(images), points, np.full(points.shape, 128, np.uint8))


def masked_views(scene: Scene, plan: Plan) -> list[tuple[Camera, ImageFeatures]]:
    """Grids of cells at three levels, 252 in each picture."""
    rng = np.random.default_rng(0)
    views = []
    for camera in cameras(scene, plan):
        maps, count = label_maps(camera)
        views.append((camera, ImageFeatures(maps, unit(rng.normal(size=(count, 8))).astype(np.float32))))
    return views
