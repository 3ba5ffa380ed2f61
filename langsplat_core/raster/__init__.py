"""Rasterizers: one small interface (`protocol`), one file each, loaded when first asked for."""

from collections.abc import Mapping
from importlib import import_module
from types import MappingProxyType
from typing import Any, NamedTuple

from langsplat_core.errors import BackendError, InputError
from langsplat_core.raster.protocol import DepthKind, LiftingRasterizer, LiftingView, Rasterizer, View

__all__ = [
    "BACKENDS",
    "DepthKind",
    "LiftingRasterizer",
    "LiftingView",
    "Rasterizer",
    "View",
    "load_rasterizer",
]


class _Backend(NamedTuple):
    module: str
    class_name: str
    otherwise: str  # what to try where it cannot load


BACKENDS: Mapping[str, _Backend] = MappingProxyType(
    {
        "reference": _Backend("langsplat_core.raster.reference", "ReferenceRasterizer", "cpu"),
        "cpu": _Backend("langsplat_core.raster.cpu.rasterizer", "CpuRasterizer", "reference"),
        "opengl": _Backend("langsplat_core.raster.opengl.rasterizer", "GlRasterizer", "cpu"),
        "cuda": _Backend("langsplat_core.raster.gsplat", "GsplatRasterizer", "cpu"),
    }
)


def load_rasterizer(name: str, **resources: Any) -> Rasterizer:
    """The rasterizer called `name`, one of `BACKENDS`, given the resources it needs (opengl: `ctx`).

    Raises InputError for an unknown name and BackendError where its library or device is missing.
    """
    if name not in BACKENDS:
        raise InputError(f"unknown rasterizer {name!r}; choose one of {', '.join(BACKENDS)}")
    backend = BACKENDS[name]
    try:
        rasterizer: Rasterizer = getattr(import_module(backend.module), backend.class_name)(**resources)
    except (ImportError, OSError, BackendError) as error:
        reason = " ".join(str(error).split())
        raise BackendError(
            f"rasterizer {name!r} cannot load ({reason}); try --backend {backend.otherwise}"
        ) from error
    return rasterizer
