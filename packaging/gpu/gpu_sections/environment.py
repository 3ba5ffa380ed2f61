"""What the machine is, and what gsplat's first use on it costs: its kernels may be compiled then."""

import os
import platform
import shutil
import subprocess
import time
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, version

from gpu_sections import Plan, need_cuda
from langsplat_core.bench.raster import describe_machine
from langsplat_core.errors import BackendError
from langsplat_core.raster.gsplat import require_device

LIBRARIES = ("torch", "gsplat", "transformers", "numpy", "numba", "moderngl")
VARIABLES = ("TORCH_CUDA_ARCH_LIST", "MAX_JOBS", "CUDA_HOME", "NO_FAST_MATH")


def measure(plan: Plan) -> Iterator[str]:
    """Device, driver, versions; then the first picture of gsplat."""
    del plan
    need_cuda()
    yield "\n".join(f"- {name}: {value}" for name, value in machine().items()) + "\n"
    start = time.perf_counter()
    try:
        require_device()
    except BackendError as error:  # its one line leaves out what the compiler said
        raise RuntimeError(f"{str(error.__cause__)[-3_000:]}\n{error}") from None
    seconds = time.perf_counter() - start
    yield f"- gsplat's first picture and its gradients, with compiling: {seconds:.0f} s\n"


def machine() -> dict[str, object]:
    """Said at the top of every report."""
    import torch

    query = "--query-gpu=name,driver_version,memory.total,power.limit"
    found = describe_machine()
    found.pop("libraries")
    return {
        "device": _said_by("nvidia-smi", query, "--format=csv,noheader") or "none",
        **found,
        "system": platform.platform(),
        "Python": platform.python_version(),
        **{name: _version(name) for name in LIBRARIES},
        "torch's CUDA": torch.version.cuda,
        "nvcc": (_said_by("nvcc", "--version") or "none").splitlines()[-1],
        "OpenGL": renderer(),
        **{name: os.environ[name] for name in VARIABLES if name in os.environ},
    }


def renderer() -> str:
    """Of the driver that EGL finds."""
    from langsplat_core.raster.opengl.scene_textures import create_egl_context

    try:
        context = create_egl_context()
    except BackendError as error:
        return f"none: {error}"
    try:
        return f"{context.info['GL_RENDERER']}, {context.info['GL_VERSION']}"
    finally:
        context.release()


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "absent"


def _said_by(*command: str) -> str:
    if shutil.which(command[0]) is None:
        return ""
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=30)
    return done.stdout.strip()
