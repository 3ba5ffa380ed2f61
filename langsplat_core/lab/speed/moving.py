"""What the CPU rasterizer's pictures take while a camera moves, and how far they are from the full one.

The viewer draws large scenes with fewer pixels while the camera moves, and with fewer, merged Gaussians.
Every picture here is of another camera; a coarse one is enlarged as a screen does and compared with the full
one.
"""

import time
from dataclasses import asdict, dataclass
from statistics import mean, median
from typing import Any

import numpy as np
from PIL import Image

from langsplat_core.arrays import Array, psnr
from langsplat_core.config import RasterSettings
from langsplat_core.errors import InputError
from langsplat_core.lab.config import MovingBenchConfig
from langsplat_core.lab.speed.queries import repeated
from langsplat_core.progress import Progress, silent
from langsplat_core.raster.cpu.rasterizer import CpuRasterizer
from langsplat_core.raster.render import splat_colours
from langsplat_core.scene import Camera, Gaussians, Scene
from langsplat_core.scene.gaussians import merged

WAYS = ((1.0, False), (0.5, False), (0.25, False), (0.5, True), (0.25, True))  # resolution, whether merged


@dataclass(frozen=True)
class MovingCost:
    """One way to draw; medians over pictures, errors are means."""

    scale: float  # of the resolution
    merged: bool
    gaussians: int
    milliseconds: float
    processor: float  # milliseconds, all threads together
    psnr: float  # dB, to the full picture; 100 for itself
    error: float  # mean absolute difference, values in [0, 1]


@dataclass(frozen=True)
class MovingReport:
    """Of one scene."""

    size: tuple[int, int]
    merging: float  # s, once for a scene
    costs: tuple[MovingCost, ...]


def measure_moving(scene: Scene, config: MovingBenchConfig, progress: Progress = silent) -> MovingReport:
    """`scene` must have cameras; InputError otherwise."""
    if not scene.cameras:
        raise InputError("bench moving needs a scene with training cameras")
    if config.count:
        scene = repeated(scene, config.count)
    chosen = np.linspace(0, len(scene.cameras) - 1, config.views).astype(int)
    cameras = [scene.cameras[index].resized(*config.size) for index in chosen]
    began = time.perf_counter()
    fewer = merged(scene.gaussians).gaussians
    merging = time.perf_counter() - began
    rasterizer, settings = CpuRasterizer(), scene.raster_settings()
    full = [_picture(rasterizer, scene.gaussians, camera, settings) for camera in cameras]
    costs = []
    for done, (scale, is_merged) in enumerate(WAYS):
        progress("drawing", done / len(WAYS))
        drawn = fewer if is_merged else scene.gaussians
        costs.append(_cost(rasterizer, drawn, cameras, settings, (scale, is_merged), full))
    return MovingReport(config.size, merging, tuple(costs))


def _cost(
    rasterizer: CpuRasterizer,
    gaussians: Gaussians,
    cameras: list[Camera],
    settings: RasterSettings,
    way: tuple[float, bool],
    full: list[Array],
) -> MovingCost:
    scale, is_merged = way
    seconds, processor, decibels, errors = [], [], [], []
    for camera, wanted in zip(cameras, full, strict=True):
        coarse = camera.resized(max(round(camera.width * scale), 1), max(round(camera.height * scale), 1))
        wall, cpu = time.perf_counter(), time.process_time()
        picture = _picture(rasterizer, gaussians, coarse, settings)
        seconds.append(time.perf_counter() - wall)
        processor.append(time.process_time() - cpu)
        shown = _enlarged(picture, wanted.shape[1::-1])
        decibels.append(psnr(shown, wanted))
        errors.append(float(np.abs(shown - wanted).mean()))
    times = 1e3 * median(seconds), 1e3 * median(processor)
    return MovingCost(scale, is_merged, len(gaussians), *times, mean(decibels), mean(errors))


def _picture(
    rasterizer: CpuRasterizer, gaussians: Gaussians, camera: Camera, settings: RasterSettings
) -> Array:
    """(H, W, 3) colours before black, in [0, 1]."""
    return splat_colours(rasterizer.view(gaussians, camera, settings), gaussians, camera).colours.clip(0, 1)


def _enlarged(picture: Array, size: tuple[int, ...]) -> Array:
    """To (width, height), between pixels as a texture is."""
    width, height = size
    channels = (Image.fromarray(np.ascontiguousarray(channel)) for channel in np.moveaxis(picture, -1, 0))
    enlarged = (channel.resize((width, height), Image.Resampling.BILINEAR) for channel in channels)
    return np.stack([np.asarray(channel) for channel in enlarged], -1)


def moving_table(report: MovingReport) -> str:
    """Markdown."""
    width, height = report.size
    lines = [
        f"{report.costs[0].gaussians} Gaussians, {width}x{height}, CPU rasterizer; merged once, "
        f"in {report.merging:.1f} s",
        "",
        "| resolution | Gaussians | picture, ms | a second | processor, ms | PSNR, dB | mean error |",
        "|---|---|---|---|---|---|---|",
    ]
    for cost in report.costs:
        drawn = f"{cost.gaussians}{' (merged)' if cost.merged else ''}"
        lines.append(
            f"| {cost.scale:g} | {drawn} | {cost.milliseconds:.0f} | {1e3 / cost.milliseconds:.1f} "
            f"| {cost.processor:.0f} | {cost.psnr:.1f} | {cost.error:.1e} |"
        )
    return "\n".join(lines) + "\n"


def figures(config: MovingBenchConfig, report: MovingReport) -> dict[str, Any]:
    """For the JSON."""
    return {"config": asdict(config), "report": asdict(report)}
