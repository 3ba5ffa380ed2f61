"""Times of the CPU kernels of whichever copy of the package is imported; run by `kernel_steps`.

`python -m langsplat_core.lab.speed.kernel_times SETTINGS` takes `KernelStepsConfig` as JSON, prints
milliseconds as JSON and writes picture.npy into the current folder.
"""

import json
import sys
import time
from collections.abc import Callable

import numpy as np

from langsplat_core.io.scenes import load_scene
from langsplat_core.lab.config import KernelStepsConfig
from langsplat_core.lab.speed.cases import default_camera, random_scene
from langsplat_core.raster.cpu.rasterizer import CpuRasterizer
from langsplat_core.scene import Camera, Gaussians

CALLS = 9


def median_ms(call: Callable[[], object]) -> float:
    """Of the thread's own time, after a first call that is not counted."""
    call()
    spent = []
    for _ in range(CALLS):
        start = time.thread_time()
        call()
        spent.append(1e3 * (time.thread_time() - start))
    return float(np.median(spent))


def main(config: KernelStepsConfig) -> None:
    """Measure and print."""
    gaussians, camera = _scene(config)
    generator = np.random.default_rng(0)
    x = generator.uniform(size=(len(gaussians), config.channels)).astype(np.float32)
    y = generator.uniform(size=(camera.height, camera.width, config.channels)).astype(np.float32)
    raster = CpuRasterizer(1)
    view = raster.view(gaussians, camera)
    calls = {
        "view": lambda: raster.view(gaussians, camera),
        "splat": lambda: view.splat(x),
        "gather": lambda: view.gather(y),
        "backward": lambda: view.backward(x, y),
    }
    times = {name: median_ms(call) for name, call in calls.items()}
    np.save("picture.npy", view.splat(x)[0])
    print(json.dumps(times))


def _scene(config: KernelStepsConfig) -> tuple[Gaussians, Camera]:
    width, height = config.size
    if config.scene is None:
        return random_scene(config.count), default_camera(width, height)
    opened = load_scene(config.scene)
    camera = opened.cameras[0] if opened.cameras else opened.framing_camera((width, height))
    return opened.gaussians, camera.resized(width, height)


if __name__ == "__main__":
    main(KernelStepsConfig(**json.loads(sys.argv[1])))
