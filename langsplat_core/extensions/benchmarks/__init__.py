"""Published benchmarks with their protocols, and speed against error of rasterizers on this machine."""

from langsplat_core.registry import Extension

_HERE = "langsplat_core.extensions.benchmarks"
EXTENSION = Extension(
    groups={
        "eval": "Measure a scene against ground truth.",
        "bench": "Measure speed against error in one run.",
    },
    commands={
        "eval lerf-ovs": f"{_HERE}.commands:EvalLerfOvs",
        "eval gr-lerf": f"{_HERE}.commands:EvalGrLerf",
        "eval 3d-ovs": f"{_HERE}.commands:EvalOvs3d",
        "bench raster": f"{_HERE}.raster_speed:BenchRaster",
    },
)
