"""`langsplat bench`: speed against error."""

import json
from dataclasses import dataclass
from pathlib import Path

from langsplat_core.errors import BackendError
from langsplat_core.evaluation.speed_error import (
    as_records,
    as_table,
    default_camera,
    measure,
    random_scene,
)
from langsplat_core.files import atomic_path
from langsplat_core.formats import load_scene
from langsplat_core.progress import TerminalProgress
from langsplat_core.raster import load_rasterizer
from langsplat_core.raster.gl_context import create_egl_context
from langsplat_core.raster.protocol import Rasterizer
from langsplat_core.scene import Camera, Gaussians

REFERENCE_LIMIT = 50_000  # Gaussians; the float64 reference draws them one by one


@dataclass(frozen=True)
class BenchRaster:
    """Time every rasterizer that loads here, with its error against the float64 reference beside it."""

    scenes: tuple[Path, ...] = ()
    """Real scenes to measure, seen from their first camera, beside the random ones."""
    counts: tuple[int, ...] = (10_000, 50_000, 200_000)
    """Sizes of the random scenes."""
    size: tuple[int, int] = (640, 480)
    """Width and height of the picture, pixels."""
    channels: tuple[int, ...] = (3, 12)
    """Values per Gaussian."""
    repeats: int = 5
    """Calls per measurement; the median counts."""
    out: Path = Path("bench_out")
    """Folder for raster.md and raster.json."""

    def run(self) -> None:
        cases: list[tuple[Gaussians, Camera]] = []
        for count in self.counts:
            cases.append((random_scene(count), default_camera(*self.size)))
        for path in self.scenes:
            scene = load_scene(path)
            camera = scene.cameras[0] if scene.cameras else scene.framing_camera(self.size)
            cases.append((scene.gaussians, camera.resized(*self.size)))
        backends = _backends()
        rows = []
        with TerminalProgress() as progress:
            for gaussians, camera in cases:
                reference = load_rasterizer("reference") if len(gaussians) <= REFERENCE_LIMIT else None
                for channels in self.channels:
                    rows += measure(gaussians, camera, backends, reference, channels, self.repeats, progress)
        table = as_table(rows)
        with atomic_path(self.out / "raster.md") as path:
            path.write_text(table)
        with atomic_path(self.out / "raster.json") as path:
            path.write_text(json.dumps(as_records(rows), indent=1))
        print(table)


def _backends() -> list[Rasterizer]:
    """Every fast backend of this machine; those that cannot load are named and left out."""
    backends = [load_rasterizer("cpu")]
    try:
        context = create_egl_context()
        backends += [load_rasterizer("opengl", ctx=context, precision=p) for p in ("half", "single")]
    except BackendError as error:
        print(f"without OpenGL: {error}")
    try:
        backends.append(load_rasterizer("cuda"))
    except BackendError as error:
        print(f"without CUDA: {error}")
    return backends
