"""gsplat's gradients beside the CPU kernels', against float64 autograd; and W^T as the adjoint of W."""

from collections.abc import Iterator

import numpy as np
import torch

from gpu_sections import Plan, need_cuda, table
from gpu_sections.raster import device_gaussians
from langsplat_core.arrays import Array
from langsplat_core.bench.measure import Case, default_camera, random_scene
from langsplat_core.bench.torch_rasterizer import TorchRasterizer
from langsplat_core.config import INRIA
from langsplat_core.raster import gsplat, load_lifting_rasterizer
from langsplat_core.raster.reference import ReferenceRasterizer

BAND = 1e-3  # relative distance to a cut-off within which a pixel is left out
NAMES = ("means", "log_scales", "quats_wxyz", "opacity_logits", "values", "means_px")


def measure(plan: Plan) -> Iterator[str]:
    """Two tables."""
    need_cuda()
    count, size = plan.gradients
    case = Case("random", random_scene(count), default_camera(*size))
    rng = np.random.default_rng(0)
    values = rng.random((count, 3), np.float32)
    image = 2 * rng.random((case.camera.height, case.camera.width, 3), np.float32) - 1
    settings = gsplat.drawn_settings(INRIA)
    band = ReferenceRasterizer().view(case.gaussians, case.camera, settings).cut_off_band(BAND)
    image[band] = 0
    exact = vars(
        TorchRasterizer(torch.float64).view(case.gaussians, case.camera, settings).backward(values, image)
    )
    on_cpu = load_lifting_rasterizer("cpu").view(case.gaussians, case.camera, settings)
    cpu = vars(on_cpu.backward(values, image))  # type: ignore[attr-defined]
    cuda = gradients(case, values, image)
    rows = [(name, _error(cpu[name], exact[name]), _error(cuda[name], exact[name])) for name in NAMES]
    yield f"# Gradients: {count} Gaussians at {size[0]}x{size[1]}\n"
    yield f"{int(band.sum())} pixels at cut-offs are left out.\n"
    yield "Largest error of each gradient, relative to its greatest entry, against float64 autograd:\n"
    yield table(("gradient by", "CPU kernels", "gsplat"), rows)
    yield "Relative difference of <W x, y> and <x, W^T y>:\n"
    yield table(("backend", "difference"), [(name, _adjoint(name, case)) for name in ("cpu", "cuda")])


def gradients(case: Case, values: Array, image: Array) -> dict[str, Array]:
    """Of <picture, image> by every parameter and by the projected means, through gsplat."""
    kept = device_gaussians(case.gaussians)
    x = gsplat.to_device(values).requires_grad_()
    drawn = gsplat.draw(kept, x, case.camera, INRIA)
    (drawn.image * gsplat.to_device(image)).sum().backward()
    leaves = {**vars(kept), "values": x, "means_px": drawn.means_px}
    return {name: leaf.grad.reshape(len(values), -1).cpu().numpy() for name, leaf in leaves.items()}


def _error(got: Array, want: Array) -> float:
    flat = want.reshape(len(want), -1)
    return float(np.abs(got.reshape(flat.shape) - flat).max() / np.abs(flat).max())


def _adjoint(name: str, case: Case) -> float:
    rng = np.random.default_rng(1)
    x = rng.normal(size=(len(case.gaussians), 5)).astype(np.float32)
    y = rng.normal(size=(case.camera.height, case.camera.width, 5)).astype(np.float32)
    view = load_lifting_rasterizer(name).view(case.gaussians, case.camera)
    forth = np.sum(view.splat(x)[0].astype(np.float64) * y)
    back = np.sum(view.gather(y).astype(np.float64) * x)
    return float(abs(forth - back) / max(abs(forth), abs(back)))
