"""gsplat beside the CPU rasterizer: time of every operation, and its error against the float64 reference."""

from collections.abc import Iterator

import torch

from gpu_sections import Plan, forget_peak, milliseconds, need_cuda, peak_mib, table
from langsplat_core.bench.measure import (
    Case,
    Foresight,
    default_camera,
    random_scene,
    reference_windows,
    warm_up,
)
from langsplat_core.bench.measure import measure as measure_backend
from langsplat_core.bench.raster import table as speed_table
from langsplat_core.config import INRIA
from langsplat_core.raster import gsplat, load_rasterizer

LONGEST_S = 10.0  # what is likely to take the CPU longer is not begun

NOTES = """- Through the interface, arrays in and out of NumPy: every `frame` copies the scene to the device.
- Errors against the float64 reference on three windows of 64x64 pixels, values in [0, 1); the reference caps
  one Gaussian's alpha where the backend does: the CPU at 0.99, gsplat 1.5 at 0.999.
- MiB: of the process's memory, not the device's.
"""


def measure(plan: Plan) -> Iterator[str]:
    """Every scene: its table of both backends, then what stays on the device."""
    need_cuda()
    backends = [load_rasterizer("cpu"), load_rasterizer("cuda")]
    settings = {"cpu": INRIA, "cuda": gsplat.drawn_settings(INRIA)}
    warm_up(backends, plan.channels)
    yield "# gsplat's rasterizer\n\n" + NOTES
    foresight = Foresight(LONGEST_S)
    for count, size in plan.scenes:
        case = Case("random", random_scene(count), default_camera(*size))
        rows = []
        for backend in backends:
            exact = reference_windows(case.gaussians, case.camera, settings[backend.name])
            for channels in plan.channels:
                rows += measure_backend(backend, case, channels, exact, foresight)
        yield speed_table(rows)
        yield "On the device alone, scene and picture staying there:\n"
        yield _on_device(case, plan.channels)


def _on_device(case: Case, channels: tuple[int, ...]) -> str:
    """Projection and blending, without and with gradients by everything."""
    rows: list[tuple[object, ...]] = []
    kept = device_gaussians(case.gaussians)
    for count in channels:
        values = torch.rand(len(case.gaussians), count, device=gsplat.DEVICE).requires_grad_()
        leaves = [kept.means, kept.log_scales, kept.quats_wxyz, kept.opacity_logits, values]

        def forward(values: torch.Tensor = values) -> torch.Tensor:
            with torch.no_grad():
                return gsplat.draw(kept, values, case.camera, INRIA).image

        def both(values: torch.Tensor = values, leaves: list[torch.Tensor] = leaves) -> object:
            return torch.autograd.grad(gsplat.draw(kept, values, case.camera, INRIA).image.sum(), leaves)

        forget_peak()
        size = f"{case.camera.width}x{case.camera.height}"
        times = (milliseconds(forward), milliseconds(both))
        rows.append((len(case.gaussians), size, count, *times, peak_mib()))
    head = ("Gaussians", "size", "channels", "forward, ms", "forward and backward, ms", "device MiB")
    return table(head, rows)


def device_gaussians(gaussians: object) -> gsplat.DeviceGaussians:
    """On the device, each part a leaf that wants its gradient."""
    names = ("means", "log_scales", "quats_wxyz", "opacity_logits")
    return gsplat.DeviceGaussians(
        **{name: gsplat.to_device(getattr(gaussians, name)).requires_grad_() for name in names}
    )
