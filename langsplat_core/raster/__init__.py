"""Rasterizers: one small interface (`protocol`), one file each, loaded at first use."""

from collections.abc import Mapping
from importlib import import_module
from types import MappingProxyType
from typing import Any, NamedTuple, cast

from langsplat_core.errors import BackendError, InputError, optional_imports
from langsplat_core.raster.protocol import LiftingRasterizer, LiftingView, Rasterizer, View

__all__ = [
    "BACKENDS", "LiftingRasterizer", "LiftingView", "Rasterizer", "View", "load_lifting_rasterizer",
    "load_rasterizer",
]  # fmt: skip


class _Backend(NamedTuple):
    module: str
    class_name: str
    lifts: bool  # whether its views can gather
    otherwise: str  # backend to suggest where this one cannot load


BACKENDS: Mapping[str, _Backend] = MappingProxyType(
    {
        "reference": _Backend("langsplat_core.raster.reference", "ReferenceRasterizer", True, "cpu"),
        "cpu": _Backend("langsplat_core.raster.cpu.rasterizer", "CpuRasterizer", True, "reference"),
        "opengl": _Backend("langsplat_core.raster.opengl.rasterizer", "GlRasterizer", False, "cpu"),
        "cuda": _Backend("langsplat_core.raster.gsplat", "GsplatRasterizer", True, "cpu"),
    }
)


def load_rasterizer(name: str, **resources: Any) -> Rasterizer:
    """Return the rasterizer called `name`, one of `BACKENDS`, given the resources it needs (opengl: `ctx`).

    Raises InputError for an unknown name and BackendError where its library or device is missing.
    """
    if name not in BACKENDS:
        raise InputError(f"unknown rasterizer {name!r}; choose one of {', '.join(BACKENDS)}")
    backend = BACKENDS[name]
    try:
        if name == "opengl" and "ctx" not in resources:
            raise BackendError("draws into a context that is given, ctx=create_egl_context(), by `view_of`")
        with optional_imports():
            rasterizer: Rasterizer = getattr(import_module(backend.module), backend.class_name)(**resources)
    except (ImportError, OSError, BackendError) as error:
        reason = " ".join(str(error).split())
        raise BackendError(f"rasterizer {name!r}: {reason}; try --backend {backend.otherwise}") from error
    return rasterizer


def load_lifting_rasterizer(backend: str = "auto") -> LiftingRasterizer:
    """Return a rasterizer whose views can gather.

    backend: "cpu", "cuda", "reference", or "auto", the CPU: it gathers the labels of masks several times as
    fast as gsplat on an H200 (docs/benchmarks/gpu). InputError if it cannot gather, BackendError if not run.
    """
    backend = "cpu" if backend == "auto" else backend
    if backend in BACKENDS and not BACKENDS[backend].lifts:
        able = ", ".join(name for name, entry in BACKENDS.items() if entry.lifts)
        raise InputError(f"rasterizer {backend!r} cannot lift; choose one of {able}")
    return cast(LiftingRasterizer, load_rasterizer(backend))
