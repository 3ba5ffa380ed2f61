"""Photographs of a few large Gaussians, and settings with which they train in seconds."""

import json
from pathlib import Path

import numpy as np
from PIL import Image

from langsplat_core.config import (
    ClipConfig,
    CodebookConfig,
    DatasetConfig,
    MaskConfig,
    RadianceConfig,
    TrainConfig,
)
from langsplat_core.raster.render import render
from langsplat_core.scene import Scene, look_at
from tests.support.scenes import random_gaussians
from tests.support.tiny_clip import tiny_clip

SIZE = (64, 48)
VIEWS = 5


def tiny_room(folder: Path) -> Path:
    """A nerfstudio folder in the empty `folder`, and a tiny encoder in it."""
    (folder / "images").mkdir(parents=True)
    gaussians = random_gaussians(60, 5, scale_range=(0.15, 0.4))
    frames = []
    for index in range(VIEWS):
        angle = 0.5 * index
        eye = 3 * np.array([np.sin(angle), -0.2, -np.cos(angle)])
        camera = look_at(eye, np.zeros(3), np.array([0.0, -1, 0]), SIZE)
        image = render(Scene(gaussians), camera).colours
        name = f"images/photo_{index}.png"
        Image.fromarray((255 * np.clip(image, 0, 1)).astype(np.uint8)).save(folder / name)
        pose = np.linalg.inv(camera.world_to_camera) @ np.diag([1.0, -1, -1, 1])
        frames.append({"file_path": name, "transform_matrix": pose.tolist()})
    intrinsics = {"fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy}
    header = f"ply\nformat ascii 1.0\nelement vertex {len(gaussians)}\n"
    header += "".join(f"property float {axis}\n" for axis in "xyz") + "end_header\n"
    body = "".join("{} {} {}\n".format(*mean) for mean in gaussians.means)
    (folder / "points.ply").write_text(header + body)
    transforms = {**intrinsics, "w": SIZE[0], "h": SIZE[1], "ply_file_path": "points.ply", "frames": frames}
    transforms["metres_per_unit"] = 0.5
    (folder / "transforms.json").write_text(json.dumps(transforms))
    tiny_clip(folder / "encoder")
    return folder


def tiny_settings(room: Path) -> TrainConfig:
    return TrainConfig(
        dataset=DatasetConfig(max_side=64, test_every=4, hold_out="every"),
        radiance=RadianceConfig(steps=20, sh_degree=0, checkpoint_every=5),
        masks=MaskConfig(source="graph"),
        clip=ClipConfig(model=str(room / "encoder"), device="cpu"),
        codec=CodebookConfig(),
        phrases=("red mug",),
    )
