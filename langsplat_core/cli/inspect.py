"""`langsplat inspect` and `langsplat doctor`: what a scene holds, what this machine can do."""

import ctypes.util
import importlib.metadata
import importlib.util
import os
import platform
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro

from langsplat_core.formats import load_scene
from langsplat_core.scene import LEVELS


@dataclass(frozen=True)
class Inspect:
    """Print what a scene file holds."""

    scene: tyro.conf.Positional[Path]
    """Any readable scene."""

    def run(self) -> None:
        scene = load_scene(self.scene)
        gaussians, field = scene.gaussians, scene.language
        valid = gaussians.valid()
        low, high = (
            np.quantile(gaussians.means[valid], [0.01, 0.99], axis=0) if valid.any() else np.zeros((2, 3))
        )
        print(f"Gaussians        {len(gaussians)} ({len(gaussians) - int(valid.sum())} invalid rows)")
        print(f"SH degree        {gaussians.sh_degree}")
        print(f"antialiased      {'yes, as Mip-Splatting' if scene.antialiased else 'no'}")
        print(f"extra properties {', '.join(scene.extras) or 'none'}")
        print(f"bounds (1-99 %)  {np.round(low, 3).tolist()} to {np.round(high, 3).tolist()}")
        print(f"cameras          {len(scene.cameras)}")
        if field is None:
            print("language field   none")
            return
        print(f"language field   codec {field.codec.kind}, d = {field.codec.latent_dim}")
        print(f"text encoder     {field.encoder_id}, {field.codec.vector_dim} numbers")
        print(f"phrasebook       {len(field.phrasebook)} phrases")
        for name, confidence in zip(LEVELS, field.confidence, strict=True):
            share = float((confidence > 0).mean()) if len(field) else 0.0
            print(f"{name:<16} {100 * share:.1f} % of the Gaussians observed")


@dataclass(frozen=True)
class Doctor:
    """Print what this machine has, for a report of trouble."""

    def run(self) -> None:
        print(
            f"python           {platform.python_version()} on {platform.platform()}, {os.cpu_count()} cores"
        )
        for package in ("numpy", "numba", "torch", "transformers", "moderngl", "imgui-bundle", "open3d"):
            print(f"{package:<16} {_version(package)}")
        for library in ("EGL", "GL", "X11", "usb-1.0"):
            print(f"lib{library:<13} {ctypes.util.find_library(library) or 'missing'}")
        print(f"DISPLAY          {os.environ.get('DISPLAY') or 'not set: use --headless'}")
        has_gsplat = importlib.util.find_spec("gsplat") is not None
        print(f"CUDA backend     {'gsplat is installed' if has_gsplat else 'gsplat is not installed'}")


def _version(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "missing"
