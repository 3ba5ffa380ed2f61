"""Training on pictures of the bundled scene, through gsplat and through the CPU kernels."""

import time
from collections.abc import Iterator
from typing import Literal

import numpy as np

from gpu_sections import Plan, forget_peak, need_cuda, peak_mib, table
from gpu_sections.pictures import bundled_scene, capture
from langsplat_core.config import RadianceConfig
from langsplat_core.training.radiance.train import evaluate_views, train_radiance

BACKENDS: tuple[Literal["cuda", "cpu"], ...] = ("cuda", "cpu")


def measure(plan: Plan) -> Iterator[str]:
    """One row a backend."""
    need_cuda()
    photographs = capture(bundled_scene(plan), plan)
    seen, held_out = photographs.split(8)
    said = f"{plan.steps} steps on {len(seen)} pictures of {plan.size[0]}x{plan.size[1]} of the bundled scene"
    yield f"# Training: {said}\n"
    yield f"PSNR of {len(held_out)} pictures that were held out. Seconds with the first step's setting up.\n"
    rows: list[tuple[object, ...]] = []
    for backend in BACKENDS:
        config = RadianceConfig(steps=plan.steps, backend=backend, sh_degree=1, max_gaussians=60_000)
        forget_peak()
        start = time.perf_counter()
        found = train_radiance(photographs, config, seen)
        seconds = time.perf_counter() - start
        scores = evaluate_views(found, photographs, held_out, backend)
        memory = peak_mib() if backend == "cuda" else None
        rows.append((backend, seconds, len(found), float(np.mean([s.psnr for s in scores])), memory))
    yield table(("backend", "seconds", "Gaussians", "PSNR, dB", "device MiB"), rows)
