"""Speed against error: every rasterizer backend on the same scene in the same run.

A time is never reported without the error against the float64 reference beside it. Times are medians of
several calls after one warm-up call, so compilation and uploads are not in them.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.progress import Progress, silent
from langsplat_core.raster.protocol import Rasterizer, View
from langsplat_core.scene import Camera, Gaussians, look_at


@dataclass(frozen=True)
class Measurement:
    """One backend doing one operation."""

    backend: str
    operation: str  # "project + splat", "splat", "gather"
    gaussians: int
    width: int
    height: int
    channels: int
    milliseconds: float  # median
    max_error: float | None  # largest absolute difference from the float64 reference; None: not computed
    mean_error: float | None


def random_scene(count: int, seed: int = 0) -> Gaussians:
    """`count` small Gaussians in a unit ball, sized so that the picture's coverage does not grow with it."""
    generator = np.random.default_rng(seed)
    directions = generator.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    radius = generator.uniform(0, 1, (count, 1)) ** (1 / 3)
    size = 0.6 * count ** (-1 / 3)
    return Gaussians(
        means=directions * radius,
        log_scales=np.log(size * np.exp(generator.normal(-1.0, 0.5, (count, 3)))),
        quats_wxyz=generator.normal(size=(count, 4)),
        opacity_logits=generator.normal(0.0, 1.5, count),
        sh=generator.normal(0, 0.5, (count, 1, 3)),
    )


def default_camera(width: int, height: int) -> Camera:
    """A camera that sees the whole ball of `random_scene`."""
    return look_at(np.array([0.0, 0.0, -2.6]), np.zeros(3), np.array([0.0, -1.0, 0.0]), (width, height))


def measure(
    gaussians: Gaussians,
    camera: Camera,
    backends: Sequence[Rasterizer],
    reference: Rasterizer | None,
    channels: int = 3,
    repeats: int = 5,
    progress: Progress = silent,
) -> list[Measurement]:
    """Time and error of each backend; `reference` None skips the errors (large scenes)."""
    generator = np.random.default_rng(1)
    values = generator.uniform(0, 1, (len(gaussians), channels)).astype(np.float32)
    image = generator.uniform(-1, 1, (camera.height, camera.width, channels)).astype(np.float32)
    truth_image = truth_values = None
    if reference is not None:
        truth = reference.view(gaussians, camera)
        truth_image = truth.splat(values)[0]
        truth_values = _gather(truth, image)
    rows = []
    for index, backend in enumerate(backends):

        def row(
            operation: str, call: Callable[[], Array], truth: Array | None, name: str = _label(backend)
        ) -> Measurement:
            seconds, result = _timed(call, repeats)
            error = None if truth is None else np.abs(result - truth)
            return Measurement(
                name,
                operation,
                len(gaussians),
                camera.width,
                camera.height,
                channels,
                1e3 * seconds,
                None if error is None else float(error.max(initial=0)),
                None if error is None else float(error.mean()) if error.size else 0.0,
            )

        def project_and_splat(backend: Rasterizer = backend) -> Array:
            return backend.view(gaussians, camera).splat(values)[0]

        view = backend.view(gaussians, camera)
        rows.append(row("project + splat", project_and_splat, truth_image))
        rows.append(row("splat", lambda view=view: view.splat(values)[0], truth_image))  # type: ignore[misc]
        if hasattr(view, "gather"):
            rows.append(row("gather", lambda view=view: _gather(view, image), truth_values))  # type: ignore[misc]
        progress(f"bench: {backend.name}", (index + 1) / len(backends))
    return rows


def _label(backend: Rasterizer) -> str:
    """Its name, with the precision where it offers several."""
    return f"{backend.name} {getattr(backend, 'precision', '')}".strip()


def _gather(view: View, image: Array) -> Array:
    result: Array = view.gather(image)  # type: ignore[attr-defined]
    return result


def _timed(call: Callable[[], Array], repeats: int) -> tuple[float, Array]:
    result = call()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        result = call()
        times.append(time.perf_counter() - start)
    return float(np.median(times)), result


def as_table(rows: Sequence[Measurement]) -> str:
    """A Markdown table."""
    lines = [
        "| Gaussians | size | channels | operation | backend | ms | max error | mean error |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for r in rows:
        errors = [("-" if e is None else f"{e:.1e}") for e in (r.max_error, r.mean_error)]
        lines.append(
            f"| {r.gaussians} | {r.width}x{r.height} | {r.channels} | {r.operation} | {r.backend} | "
            f"{r.milliseconds:.1f} | {errors[0]} | {errors[1]} |"
        )
    return "\n".join(lines) + "\n"


def as_records(rows: Sequence[Measurement]) -> list[dict[str, object]]:
    """Plain dictionaries, for JSON."""
    return [asdict(row) for row in rows]
