"""LangSplat: 3D Gaussian scenes that can be searched with words.

The public names below load on first use, so that importing the package costs nothing.
"""

import os
from importlib import import_module
from typing import TYPE_CHECKING, Any

from langsplat_core.errors import optional_imports

# Threads of torch wait by spinning, which takes the cores from whatever else runs: beside six busy processes
# masks took five times as long to describe. Read when torch is imported; Turkish locales know no capital I.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")

if TYPE_CHECKING:
    from langsplat_core.config import TrainConfig
    from langsplat_core.io.scenes import load_scene, save_scene
    from langsplat_core.io.sidecar import Words, read_words, write_words
    from langsplat_core.pipeline.notebook import draw, show
    from langsplat_core.pipeline.train import train_scene
    from langsplat_core.query.answers import QueryResult
    from langsplat_core.query.compose import run_phrase
    from langsplat_core.query.engine import QueryEngine
    from langsplat_core.raster import load_lifting_rasterizer, load_rasterizer
    from langsplat_core.raster.render import Rendering, render, view_of
    from langsplat_core.scene import Camera, Gaussians, Intrinsics, LanguageField, Scene, look_at
    from langsplat_core.semantics.encoders import load_text_encoder

__version__ = "0.1.0"

_HOMES = {
    name: f"langsplat_core.{module}"
    for module, names in {
        "io.scenes": "load_scene save_scene",
        "io.sidecar": "Words read_words write_words",
        "raster.render": "render Rendering view_of",
        "raster": "load_rasterizer load_lifting_rasterizer",
        "semantics.encoders": "load_text_encoder",
        "query.engine": "QueryEngine QueryResult",
        "query.compose": "run_phrase",
        "pipeline.train": "train_scene",
        "pipeline.notebook": "show draw",
        "config": "TrainConfig",
        "scene": "Camera Gaussians Intrinsics LanguageField Scene look_at",
    }.items()
    for name in names.split()
}

__all__ = sorted(_HOMES)


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'langsplat_core' has no attribute {name!r}")
    with optional_imports():
        return getattr(import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return [*__all__, "__version__", "errors"]
