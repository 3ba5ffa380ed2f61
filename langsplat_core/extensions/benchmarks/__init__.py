"""Benchmarks of the field, protocol by protocol, and speed against error on one's own machine."""

from langsplat_core.registry import Extension

_COMMANDS = "langsplat_core.extensions.benchmarks.commands"
EXTENSION = Extension(
    groups={
        "eval": "Measure a scene against ground truth.",
        "bench": "Measure speed against error in one run.",
    },
    commands={
        "eval lerf-ovs": f"{_COMMANDS}:EvalLerfOvs",
        "eval 3d-ovs": f"{_COMMANDS}:EvalOvs3d",
        "eval scannet": f"{_COMMANDS}:EvalScanNet",
        "bench raster": f"{_COMMANDS}:BenchRaster",
        "bench query": f"{_COMMANDS}:BenchQuery",
    },
)
