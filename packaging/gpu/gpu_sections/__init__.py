"""What a machine with a GPU is asked, section by section; `packaging/gpu/run.py` gives each its own process.

Every section is a module with `measure(plan)`, which yields pieces of Markdown as they are found, so that a
section that is stopped leaves what it had. It raises `Missing` where the machine lacks what it is about.
"""

from collections.abc import Callable
from dataclasses import dataclass


class Missing(Exception):
    """What the section needs is not on this machine; its text is the reason, one line."""


@dataclass(frozen=True)
class Plan:
    """How much is measured."""

    scenes: tuple[tuple[int, tuple[int, int]], ...]  # random Gaussians and (width, height) of their picture
    channels: tuple[int, ...]  # values per Gaussian
    gradients: tuple[int, tuple[int, int]]  # a scene whose gradients are compared
    steps: int  # of training
    most: int  # Gaussians of the bundled scene, where it is lifted onto or drawn
    pictures: int  # drawn from the bundled scene: to train on, and to lift from
    size: tuple[int, int]  # of those
    models: tuple[str, ...]  # of `tests.support.full_size.MODELS`
    crops: int  # shown to an encoder at once
    batches: int  # of 64 points that a segmenter is asked at
    million: int  # Gaussians of the larger OpenGL scene
    tests: tuple[str, ...]  # arguments of pytest


FULL = Plan(
    scenes=((31_000, (640, 480)), (200_000, (960, 720)), (1_000_000, (960, 720))),
    channels=(3, 12, 32),
    gradients=(2_000, (128, 96)),
    steps=300,
    most=1_000_000,
    pictures=16,
    size=(400, 300),
    models=("clip", "sam-vit-huge"),
    crops=64,
    batches=16,
    million=1_000_000,
    tests=("tests/raster", "-k", "(cuda or opengl) and not twin"),
)
TINY = Plan(
    scenes=((300, (64, 48)),),
    channels=(3,),
    gradients=(60, (32, 24)),
    steps=4,
    most=400,
    pictures=3,
    size=(40, 30),
    models=("clip",),
    crops=1,
    batches=1,
    million=500,
    tests=("tests/raster/test_render.py", "-k", "reference"),
)
PLANS = {"full": FULL, "tiny": TINY}


def table(head: tuple[str, ...], rows: list[tuple[object, ...]]) -> str:
    """In Markdown; floats with four digits, None as a dash."""
    lines = [head, ("---",) * len(head), *rows]
    return "\n".join("| " + " | ".join(_cell(cell) for cell in line) + " |" for line in lines) + "\n"


def _cell(value: object) -> str:
    if value is None:
        return "-"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def need_cuda() -> None:
    """Raises Missing unless gsplat has its device."""
    from langsplat_core.raster.gsplat import has_device

    if not has_device():
        raise Missing("no CUDA device")


def milliseconds(call: Callable[[], object], times: int = 10) -> float:
    """Median of `times` calls after one that does not count; the device has finished at both ends of each."""
    import statistics
    import time

    found = []
    for _ in range(times + 1):
        wait()
        start = time.perf_counter()
        kept = call()
        wait()
        found.append(1e3 * (time.perf_counter() - start))
        del kept
    return statistics.median(found[1:])


def wait() -> None:
    """Until the device has done what it was told."""
    import torch

    if torch.cuda.is_available():
        torch.cuda.synchronize()


def forget_peak() -> None:
    """Count the device's memory from here."""
    import torch

    if torch.cuda.is_available():
        torch.cuda.empty_cache()
        torch.cuda.reset_peak_memory_stats()


def peak_mib() -> float | None:
    """Most memory that torch held on the device since `forget_peak`; None without a device."""
    import torch

    return torch.cuda.max_memory_allocated() / 2**20 if torch.cuda.is_available() else None
