"""What a machine with a GPU is asked, section by section; `packaging/gpu/run.py` gives each its own process.

Every section is a function `measure_NAME(plan)`, which yields pieces of Markdown as they are found, so that a
section that is stopped leaves what it had. It raises `MissingError` where the machine lacks what it is about.

    python -m gpu_sections NAME PLAN REPORT.md

writes the report anew after every piece. Exit code 3, with the reason as the last line of stderr, where the
machine lacks what the section is about.
"""

import os
import platform
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from importlib.metadata import PackageNotFoundError, version
from importlib.resources import files
from importlib.util import find_spec
from itertools import pairwise
from pathlib import Path
from typing import Literal

import moderngl
import numpy as np
import torch

from langsplat_core import load_scene, render
from langsplat_core.arrays import Array, unit
from langsplat_core.config import INRIA, RadianceConfig
from langsplat_core.datasets.capture import Capture
from langsplat_core.errors import BackendError
from langsplat_core.extensions.benchmarks.raster_speed import (
    Case,
    default_camera,
    describe_machine,
    random_scene,
    reference_window,
    warm_up,
)
from langsplat_core.extensions.benchmarks.raster_speed import measure as measure_backend
from langsplat_core.extensions.benchmarks.raster_speed import table as speed_table
from langsplat_core.io.files import atomic_path
from langsplat_core.raster import gsplat, load_lifting_rasterizer, load_rasterizer
from langsplat_core.raster.gsplat import require_device
from langsplat_core.raster.opengl.rasterizer import create_egl_context, is_software
from langsplat_core.raster.reference import ReferenceRasterizer
from langsplat_core.scene import Camera, Scene
from langsplat_core.semantics.encoders import load_encoder
from langsplat_core.semantics.features import ImageFeatures
from langsplat_core.semantics.sam import grid_points, load_segmenter
from langsplat_core.training.radiance.differentiable import evaluate_views
from langsplat_core.training.radiance.trainer import train_radiance
from tests.support.backends import drawn_settings, reference_gradients
from tests.support.scenes import find_mask_weights


class MissingError(Exception):
    """Raised where what a section needs is not on this machine; its text is the reason, one line."""


@dataclass(frozen=True)
class Plan:
    """Sizes of what is measured."""

    scenes: tuple[tuple[int, tuple[int, int]], ...]  # random Gaussians and (width, height) of their picture
    channels: tuple[int, ...]  # values per Gaussian
    gradients: tuple[int, tuple[int, int]]  # a scene whose gradients are compared
    steps: int  # of training
    most: int  # Gaussians of the bundled scene, where it is lifted onto or drawn
    pictures: int  # drawn from the bundled scene: to train on, and to lift from
    size: tuple[int, int]  # of those
    models: tuple[str, ...]  # of `MODELS`
    crops: int  # shown to an encoder at once
    batches: int  # of 64 points that a segmenter is asked at
    million: int  # Gaussians of the larger OpenGL scene
    tests: tuple[str, ...]  # arguments of pytest


FULL = Plan(
    scenes=((31_000, (640, 480)), (200_000, (960, 720)), (1_000_000, (960, 720))),
    channels=(3, 32),
    gradients=(200, (128, 96)),
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
    """Return a table in Markdown: floats with four digits, None as a dash."""
    lines = [head, ("---",) * len(head), *rows]
    return "\n".join("| " + " | ".join(_cell(cell) for cell in line) + " |" for line in lines) + "\n"


def _cell(value: object) -> str:
    if value is None:
        return "-"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def need_cuda() -> None:
    """Raise MissingError unless gsplat has its device."""
    if not gsplat.has_device():
        raise MissingError("no CUDA device")


def milliseconds(call: Callable[[], object], times: int = 10) -> float:
    """Median of `times` calls after one that does not count; the device has finished at both ends of each."""
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
    """Wait until the device has finished its work."""
    if torch.cuda.is_available():
        torch.cuda.synchronize()


def forget_peak() -> None:
    """Begin to measure the peak of the device's memory anew."""
    if torch.cuda.is_available():
        torch.cuda.empty_cache()
        torch.cuda.reset_peak_memory_stats()


def peak_mib() -> float | None:
    """Most memory that torch held on the device since `forget_peak`; None without a device."""
    return torch.cuda.max_memory_allocated() / 2**20 if torch.cuda.is_available() else None


# What the machine is, and what gsplat's first use on it costs: its kernels may be compiled then.

LIBRARIES = ("torch", "gsplat", "transformers", "numpy", "numba", "moderngl")
VARIABLES = ("TORCH_CUDA_ARCH_LIST", "MAX_JOBS", "CUDA_HOME", "NO_FAST_MATH")


def measure_environment(plan: Plan) -> Iterator[str]:
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
    kernels = "compiled before" if find_spec("gsplat.csrc") else "with compiling"
    yield f"- gsplat's first picture and its gradients, {kernels}: {seconds:.0f} s\n"


def machine() -> dict[str, object]:
    """Return the properties of the machine, for the top of every report."""
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
    """Return the OpenGL renderer and version of the driver that EGL finds."""
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


# gsplat beside the CPU rasterizer: time of every operation, and its error against the float64 reference.


NOTES = """- Through the interface, arrays in and out of NumPy: every `frame` copies the scene to the device.
- Errors against the float64 reference in a window of 112x112 pixels, values in [0, 1); the reference caps
  one Gaussian's alpha where the backend does: the CPU at 0.99, gsplat 1.5 at 0.999.
- MiB: of the process's memory, not the device's.
"""


def measure_raster(plan: Plan) -> Iterator[str]:
    """Time both backends on every scene, then what stays on the device."""
    need_cuda()
    backends = [load_rasterizer("cpu"), load_rasterizer("cuda")]
    settings = {"cpu": INRIA, "cuda": drawn_settings(INRIA)}
    warm_up(backends, plan.channels)
    yield "# gsplat's rasterizer\n\n" + NOTES
    for count, size in plan.scenes:
        case = Case("random", random_scene(count), default_camera(*size))
        rows = []
        for backend in backends:
            exact = reference_window(case.gaussians, case.camera, settings[backend.name])
            for channels in plan.channels:
                rows += measure_backend(backend, case, channels, exact)
        yield speed_table(rows)
        yield "On the device alone, scene and picture staying there:\n"
        yield _on_device(case, plan.channels)


def _on_device(case: Case, channels: tuple[int, ...]) -> str:
    """Return the table of projection and blending, without and with gradients by everything."""
    rows: list[tuple[object, ...]] = []
    kept = device_gaussians(case.gaussians)
    for count in channels:
        values = torch.rand(len(case.gaussians), count, device=gsplat.DEVICE).requires_grad_()
        leaves = [*kept.values(), values]

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
    """Return Gaussians on the device, each part a leaf that requires its gradient."""
    return {name: gsplat.to_device(getattr(gaussians, name)).requires_grad_() for name in gsplat.RAW}


# gsplat's gradients beside the CPU kernels', against differences of the reference; W^T as the adjoint of W.

BAND = 1e-3  # relative distance to a cut-off within which a pixel is left out
NAMES = ("means", "log_scales", "quats_wxyz", "opacity_logits", "values", "means_px")


def measure_gradients(plan: Plan) -> Iterator[str]:
    """Compare gradients of both backends with differences of the reference; test W^T as the adjoint of W."""
    need_cuda()
    count, size = plan.gradients
    case = Case("random", random_scene(count), default_camera(*size))
    rng = np.random.default_rng(0)
    values = rng.random((count, 3), np.float32)
    image = 2 * rng.random((case.camera.height, case.camera.width, 3), np.float32) - 1
    settings = drawn_settings(INRIA)
    band = ReferenceRasterizer().view(case.gaussians, case.camera, settings).cut_off_band(BAND)
    image[band] = 0
    no_alpha = np.zeros(band.shape)
    some = rng.permutation(count)[:20]
    exact = reference_gradients(case.gaussians, case.camera, settings, values, image, no_alpha, some)
    on_cpu = load_lifting_rasterizer("cpu").view(case.gaussians, case.camera, settings)
    cpu = on_cpu.backward(values, image)._asdict()  # type: ignore[attr-defined]
    cuda = gradients(case, values, image)
    rows = [(n, _error(cpu[n][some], exact[n]), _error(cuda[n][some], exact[n])) for n in NAMES]
    yield f"# Gradients: {count} Gaussians at {size[0]}x{size[1]}\n"
    yield f"{int(band.sum())} pixels at cut-offs are left out.\n"
    yield f"Largest error of each gradient, at {len(some)} Gaussians and relative to their greatest entry,\n"
    yield "against differences of the float64 reference:\n"
    yield table(("gradient by", "CPU kernels", "gsplat"), rows)
    yield "Relative difference of <W x, y> and <x, W^T y>:\n"
    yield table(("backend", "difference"), [(name, _adjoint(name, case)) for name in ("cpu", "cuda")])


def gradients(case: Case, values: Array, image: Array) -> dict[str, Array]:
    """Return the gradients of <picture, image> by every parameter and by the projected means, by gsplat."""
    kept = device_gaussians(case.gaussians)
    x = gsplat.to_device(values).requires_grad_()
    drawn = gsplat.draw(kept, x, case.camera, INRIA)
    (drawn.image * gsplat.to_device(image)).sum().backward()
    leaves = {**kept, "values": x, "means_px": drawn.means_px}
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


# Photographs and masks to train on and to lift from: pictures of the bundled scene, so nothing is needed.

POINTS = 10_000  # of the scene's own centres, shaken, in place of structure from motion's


def bundled_scene(plan: Plan) -> Scene:
    """Return the demo, at most so many of its Gaussians, without what they mean."""
    whole = load_scene(Path(str(files("langsplat_assets"))) / "demo" / "scene.ply")
    rows = np.arange(min(len(whole.gaussians), plan.most))
    return Scene(whole.gaussians.take(rows), cameras=whole.cameras)


def cameras(scene: Scene, plan: Plan) -> list[Camera]:
    """Return evenly chosen cameras of the scene, in the plan's size."""
    chosen = np.linspace(0, len(scene.cameras) - 1, plan.pictures).round().astype(int)
    return [replace(scene.cameras[index].resized(*plan.size), name=f"{index:03}") for index in chosen]


def capture(scene: Scene, plan: Plan) -> Capture:
    """Return renders of the scene, with cameras and noisy points, as a capture to train on."""
    views = cameras(scene, plan)
    images = [
        np.round(255 * np.clip(render(scene, view, backend="cpu").colours, 0, 1)).astype(np.uint8)
        for view in views
    ]
    rng = np.random.default_rng(0)
    means = scene.gaussians.means[scene.gaussians.valid()].astype(np.float64)
    points = means[rng.choice(len(means), min(POINTS, len(means)), replace=False)]
    points = points + 0.005 * np.ptp(means, axis=0).max() * rng.normal(size=points.shape)
    return Capture(tuple(views), tuple(images), points, np.full(points.shape, 128, np.uint8))


def masked_views(scene: Scene, plan: Plan) -> list[tuple[Camera, ImageFeatures]]:
    """Return cameras with masks: grids of cells at three levels, 252 in each picture."""
    rng = np.random.default_rng(0)
    views = []
    for camera in cameras(scene, plan):
        size = np.array((camera.height, camera.width))[:, None, None]
        down, across = np.mgrid[: camera.height, : camera.width] / size
        grids = ((0, 4), (192, 2), (240, 1))  # first label; four times as many cells across, three down
        maps = np.stack([first + 4 * n * (3 * n * down // 1) + 4 * n * across // 1 for first, n in grids])
        features = ImageFeatures(maps.astype(np.int32), unit(rng.normal(size=(252, 8))).astype(np.float32))
        views.append((camera, features))
    return views


# Mask weights, W^T onehot(mask), through gsplat's gradients and through the CPU's walk.


def measure_lifting(plan: Plan) -> Iterator[str]:
    """Time the lifting of masks on both backends, and compare the weights."""
    need_cuda()
    scene = bundled_scene(plan)
    views = masked_views(scene, plan)
    masks = sum(len(features.vectors) for _, features in views)
    yield f"# Lifting: {masks} masks of {len(views)} pictures onto {len(scene.gaussians)} Gaussians\n"
    found, rows = {}, []
    for name in ("cpu", "cuda"):
        rasterizer = load_lifting_rasterizer(name)
        find_mask_weights(rasterizer, scene.gaussians, views[:1])
        start = time.perf_counter()
        members = find_mask_weights(rasterizer, scene.gaussians, views, settings=drawn_settings(INRIA))
        rows.append((name, time.perf_counter() - start, sum(len(pairs) for pairs in members.pairs)))
        found[name] = members.pairs
    yield table(("backend", "seconds", "pairs of Gaussian and mask"), rows)
    largest = max(_difference(*both, len(scene.gaussians)) for both in zip(*found.values(), strict=True))
    yield f"Largest difference of a weight: {largest:.2g} pixels, of weights up to {_largest(found):.4g}.\n"


def _difference(one: np.ndarray, two: np.ndarray, count: int) -> float:
    """Return the largest difference of two tables of weights, where a missing pair has weight 0."""
    from scipy import sparse

    width = 1 + max(int(pairs["mask"].max(initial=0)) for pairs in (one, two))
    first, second = (
        sparse.csr_matrix((p["weight"], (p["row"], p["mask"])), shape=(count, width)) for p in (one, two)
    )
    return float(abs(first - second).max())


def _largest(found: dict[str, list[np.ndarray]]) -> float:
    return max(float(pairs["weight"].max(initial=0)) for pairs in found["cpu"])


# Training on pictures of the bundled scene, through gsplat and through the CPU kernels.

BACKENDS: tuple[Literal["cuda", "cpu"], ...] = ("cuda", "cpu")


def measure_training(plan: Plan) -> Iterator[str]:
    """Train on each backend, and measure PSNR, seconds and memory."""
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


# OpenGL through EGL on the driver of the GPU: time, and error against a reference that blends as it does.

SIZE = (960, 720)
ENDLESS = replace(INRIA, transmittance_min=0.0)  # OpenGL cannot stop where a pixel is full


def measure_opengl(plan: Plan) -> Iterator[str]:
    """Time the bundled scene and a large random one, in both precisions."""
    try:
        context = create_egl_context()
    except BackendError as error:
        raise MissingError(f"no OpenGL: {error}") from error
    with context:
        if is_software(context):
            raise MissingError(f"no GPU's OpenGL driver, only {context.info['GL_RENDERER']}")
        yield from tables(plan, context)


def tables(plan: Plan, context: moderngl.Context) -> Iterator[str]:
    """Yield the report for a context on any driver."""
    yield f"# OpenGL through EGL: {context.info['GL_RENDERER']}\n"
    yield "Errors against the float64 reference without its early stop, which OpenGL has not.\n"
    scene = bundled_scene(plan)
    cases = [
        Case("bundled", scene.gaussians, scene.cameras[0].resized(*SIZE)),
        Case("random", random_scene(plan.million), default_camera(*SIZE)),
    ]
    backends = [load_rasterizer("opengl", ctx=context, precision=p) for p in ("single", "half")]
    warm_up(backends, (3,))
    for case in cases:
        exact = reference_window(case.gaussians, case.camera, ENDLESS)
        rows = []
        for backend in backends:
            rows += measure_backend(backend, case, 3, exact)
        yield speed_table(rows)


# Encoders and segmenters in their real sizes with random weights: seconds a photograph, device and CPU.

REPEATS = 5  # of a batch of crops: 320, about as many regions as a photograph has
ENLARGED = 16  # masks at once
PHOTOGRAPH = (1080, 1440)  # height, width, px: what LangSplat shrinks photographs to


@dataclass(frozen=True)
class Model:
    """A checkpoint of the hub, made in its real size with random weights."""

    id: str
    million: float  # parameters
    make: Callable[[Path], None]
    segments: bool  # else it encodes


def make_sam(folder: Path) -> None:
    """Write facebook/sam-vit-huge."""
    from transformers import SamConfig, SamModel

    vision = {"hidden_size": 1280, "num_hidden_layers": 32, "num_attention_heads": 16, "mlp_dim": 5120}
    vision |= {"global_attn_indexes": [7, 15, 23, 31], "output_channels": 256}
    # The default, 1e-10, makes numbers so small that sums of them crawl.
    torch.manual_seed(0)
    SamModel(SamConfig(vision_config=vision | {"initializer_range": 0.02})).save_pretrained(folder)


def make_clip(folder: Path) -> None:
    """Write laion/CLIP-ViT-B-16-laion2B-s34B-b88K."""
    from transformers import CLIPConfig, CLIPModel, CLIPTokenizer

    letters = "abcdefghijklmnopqrstuvwxyz"
    tokens = ["<|startoftext|>", "<|endoftext|>", *letters, *(f"{letter}</w>" for letter in letters)]
    tokens += [f"word{i}</w>" for i in range(49408 - len(tokens))]
    CLIPTokenizer(vocab={token: i for i, token in enumerate(tokens)}, merges=[]).save_pretrained(folder)
    text = {"hidden_size": 512, "intermediate_size": 2048, "num_attention_heads": 8, "hidden_act": "gelu"}
    text |= {"vocab_size": 49408, "bos_token_id": 0, "eos_token_id": 1, "projection_dim": 512}
    vision = {"patch_size": 16, "hidden_act": "gelu", "projection_dim": 512}
    torch.manual_seed(0)
    config = CLIPConfig(text_config=text, vision_config=vision, projection_dim=512)
    CLIPModel(config).save_pretrained(folder)


MODELS = {
    "sam-vit-huge": Model("facebook/sam-vit-huge", 641.1, make_sam, True),
    "clip": Model("laion/CLIP-ViT-B-16-laion2B-s34B-b88K", 149.6, make_clip, False),
}


def measure_encoders(plan: Plan) -> Iterator[str]:
    """Time each model of the plan, and compare it with the CPU."""
    need_cuda()
    yield "# Encoders and segmenters in their real sizes, random weights\n"
    for name in plan.models:
        with tempfile.TemporaryDirectory() as folder:
            torch.manual_seed(0)
            MODELS[name].make(Path(folder))
            compare = _segmenter if MODELS[name].segments else _encoder
            yield f"## {MODELS[name].id}, {MODELS[name].million:g} million weights\n"
            yield compare(folder, plan)


def _encoder(folder: str, plan: Plan) -> str:
    """Time the crops of a photograph on the device; compare the vectors of some with the CPU's."""
    forget_peak()
    start = time.perf_counter()
    encoder = load_encoder(folder, gsplat.DEVICE)
    loaded = time.perf_counter() - start
    side = encoder.image_size
    crops = np.random.default_rng(0).integers(0, 256, (plan.crops, side, side, 3), dtype=np.uint8)
    vectors = encoder.encode_images(crops)
    start = time.perf_counter()
    for _ in range(REPEATS):
        encoder.encode_images(crops)
    seconds = time.perf_counter() - start
    memory = peak_mib()
    there = load_encoder(folder, "cpu")
    start = time.perf_counter()
    wanted = there.encode_images(crops)
    slow = (time.perf_counter() - start) * REPEATS
    times = ("loading, s", f"{REPEATS * plan.crops} crops, s", "on the CPU, s")
    head = (*times, "largest error of a vector", "device MiB")
    return table(head, [(loaded, seconds, slow, _largest_difference(vectors, wanted), memory)])


def _segmenter(folder: str, plan: Plan) -> str:
    """Time a photograph, asked at its points, all masks enlarged; compare one batch with the CPU's."""
    forget_peak()
    start = time.perf_counter()
    segmenter = load_segmenter(folder, gsplat.DEVICE)
    loaded = time.perf_counter() - start
    image = np.random.default_rng(0).integers(0, 256, (*PHOTOGRAPH, 3), dtype=np.uint8)
    points = grid_points(8, PHOTOGRAPH)
    rows = []
    with torch.inference_mode():
        for _ in range(2):  # the first chooses algorithms
            laps = [_now()]
            encoded = segmenter.encode(image)
            laps.append(_now())
            answers = [encoded.masks_at(points) for _ in range(plan.batches)]
            laps.append(_now())
            for _, logits in answers:
                for some in logits.flatten(0, 1).split(ENLARGED):
                    torch.gt(encoded.enlarge(some), 0)  # what a mask is made by
            laps.append(_now())
            rows.append([after - before for before, after in pairwise(laps)])
        memory = peak_mib()
        ious, logits = (part.cpu().numpy() for part in answers[0])
        start = time.perf_counter()
        there = load_segmenter(folder, "cpu").encode(image)
        wanted = [part.numpy() for part in there.masks_at(points)]
        slow = time.perf_counter() - start
    errors = (
        _largest_difference(ious, wanted[0]),
        _largest_difference(logits, wanted[1]) / float(np.abs(wanted[1]).max()),
    )
    steps = ("picture", f"{64 * plan.batches} points", f"{192 * plan.batches} masks enlarged", "photograph")
    named = ("loading", *steps, "CPU: loading, picture, 64 points")
    quality = ("error of a quality", "relative error of a mask", "device MiB")
    head = (*(f"{name}, s" for name in named), *quality)
    return table(head, [(loaded, *rows[1], sum(rows[1]), slow, *errors, memory)])


def _now() -> float:
    wait()
    return time.perf_counter()


def _largest_difference(one: Array, two: Array) -> float:
    return float(np.abs(one - two).max())


# The project's own tests of the rasterizers, on the device.

ROOT = Path(__file__).resolve().parents[2]


def measure_tests(plan: Plan) -> Iterator[str]:
    """Run the plan's tests, and yield the end of pytest's output."""
    need_cuda()
    if find_spec("pytest") is None or find_spec("hypothesis") is None:
        raise MissingError("no pytest or no hypothesis")
    yield f"# Tests: pytest {' '.join(plan.tests)}\n"
    command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "--measured", *plan.tests]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    said = done.stdout.splitlines()
    start = next(
        (n for n, line in enumerate(said) if "measured" in line or "short test summary" in line), -10
    )
    yield "```\n" + "\n".join(said[start:]) + "\n```\n"
    if done.returncode:
        raise RuntimeError(f"pytest: {said[-1] if said else done.stderr.strip()[-300:]}")


ABSENT = 3


def main(name: str, plan: str, report: Path) -> int:
    """Run section `name` and write its report after every piece; return the exit code."""
    pieces: list[str] = []
    try:
        for piece in globals()[f"measure_{name}"](PLANS[plan]):
            pieces.append(piece)
            with atomic_path(report) as path:
                path.write_text("\n".join(pieces))
    except MissingError as reason:
        print(reason, file=sys.stderr)
        return ABSENT
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1], sys.argv[2], Path(sys.argv[3])))
