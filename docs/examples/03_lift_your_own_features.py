"""Carry numbers of one's own from pictures onto the Gaussians, and look at them from somewhere else.

    python docs/examples/03_lift_your_own_features.py [FOLDER]

What is known per pixel, H of (H, W, C), becomes known per Gaussian: x = W^T H / W^T 1, summed over views.
"""

import sys
from importlib.resources import files
from pathlib import Path

import numpy as np
from PIL import Image

from langsplat_core import load_lifting_rasterizer, load_scene, render, view_of


def my_features(picture: np.ndarray) -> np.ndarray:  # (H, W, C) float32; here: the strongest colour
    return np.eye(3, dtype=np.float32)[picture.argmax(-1)]


def main() -> None:
    out = Path(sys.argv[1] if len(sys.argv) > 1 else "out")
    out.mkdir(parents=True, exist_ok=True)
    scene = load_scene(Path(str(files("langsplat_assets"))) / "demo" / "scene.ply")
    rasterizer, total, weight = load_lifting_rasterizer(), 0.0, 0.0
    for camera in [camera.resized(240, 180) for camera in scene.cameras[1::8]]:
        view = view_of(scene, camera, rasterizer)
        total = total + view.gather(my_features(render(scene, camera).colours))  # W^T H (N, C)
        weight = weight + view.contributions()  # W^T 1 (N,), in pixels
    lifted = total / np.maximum(weight, 1e-6)[:, None]
    seen = render(scene, scene.cameras[0].resized(240, 180), values=lifted)  # a view that was not used
    agree = seen.values.argmax(-1) == seen.colours.argmax(-1)
    print(f"{(weight > 0.01).sum()} Gaussians observed; {agree.mean():.0%} of a new view's pixels agree")
    Image.fromarray((255 * np.clip(seen.values, 0, 1)).astype(np.uint8)).save(out / "lifted.png")


if __name__ == "__main__":
    main()
