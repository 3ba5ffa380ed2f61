"""Which renderer a training draws with."""

from typing import Literal

import torch

from langsplat_core.errors import BackendError
from langsplat_core.training.radiance.differentiable import CpuRenderer, DifferentiableRenderer

Backend = Literal["auto", "cpu", "cuda"]


def renderer_for(backend: Backend) -> DifferentiableRenderer:
    """The renderer a user asked for; `auto` takes CUDA where gsplat really draws there, else the CPU.

    Raises BackendError when `cuda` is asked for and cannot work.
    """
    if backend == "cpu" or (backend == "auto" and not torch.cuda.is_available()):
        return CpuRenderer()
    from langsplat_core.training.radiance.differentiable_cuda import CudaRenderer

    try:
        return CudaRenderer()
    except BackendError:
        if backend == "cuda":
            raise
        return CpuRenderer()
