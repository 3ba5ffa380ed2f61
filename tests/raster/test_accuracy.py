"""How far every fast rasterizer is from the float64 reference: the bundled scene, real scenes, random ones.

Away from cut-offs the error is bounded (`tests/support/backends.py`); at cut-offs, where rounding decides
whether an alpha of 1/255 counts, pixels may flip, and their number has a budget. Figures: run with
`--measured`.
"""

from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest

from langsplat_core.arrays import Array
from langsplat_core.config import GSPLAT, INRIA, RasterSettings
from langsplat_core.io.scenes import load_scene
from langsplat_core.raster.reference import ReferenceRasterizer, ReferenceView
from langsplat_core.scene import Camera, Gaussians, Scene
from tests.support.backends import Backend, Measure
from tests.support.comparing import assert_adjoint
from tests.support.scenes import random_camera, random_gaussians, random_values

pytestmark = pytest.mark.long

REFERENCE = ReferenceRasterizer()
DEMO = Path(__file__).parent.parent.parent / "assets" / "demo" / "scene.ply"
REAL = ("guitar.compressed.ply", "playbot_8k_sog", "playbot_31k_sog")
FLIPS = 1e-3  # of the pixels; each costs one alpha of 1/255


@dataclass(frozen=True, eq=False)
class Scored:
    """Error of one picture."""

    worst: float  # away from cut-offs: image, alpha
    mean: float
    depth: float  # relative, where alpha > 0.01
    flips: int  # pixels at a cut-off that are off by more than the tolerance
    pixels: int


@dataclass(frozen=True, eq=False)
class Truth:
    """What the reference makes of a view."""

    image: Array  # (H, W, 3) of `VALUES`
    alpha: Array
    depth: Array
    band: Array  # (H, W) True at a cut-off
    view: ReferenceView


def truth_of(gaussians: Gaussians, camera: Camera, settings: RasterSettings, width: float) -> Truth:
    """One pass for image, alpha and depth: the reference is slow."""
    view = REFERENCE.view(gaussians, camera, settings)
    both = np.column_stack([random_values(len(gaussians), 3), view.footprints.depths])
    sums, alpha = view.splat(both)
    depth = sums[..., 3] / np.where(alpha > 0, alpha, 1)
    return Truth(sums[..., :3], alpha, depth, view.cut_off_band(width), view)


truth_of_scene = lru_cache(maxsize=4)(truth_of)  # shared by the backends


def score(
    backend: Backend, gaussians: Gaussians, camera: Camera, settings: RasterSettings, truth: Truth
) -> Scored:
    """Image, alpha and depth against the reference; also that `gather` is the adjoint."""
    values = random_values(len(gaussians), 3)
    view = backend.raster.view(gaussians, camera, settings)
    image, alpha = view.splat(values)
    error = np.abs(np.dstack([image - truth.image, alpha - truth.alpha])).max(-1)
    seen = ~truth.band & (truth.alpha > 0.01)
    check_gather(view, truth, values)
    return Scored(
        worst=float(error[~truth.band].max(initial=0)),
        mean=float(error.mean()),
        depth=float(np.abs(view.depth()[seen] / truth.depth[seen] - 1).max(initial=0)),
        flips=int((error[truth.band] > backend.tolerance).sum()),
        pixels=error.size,
    )


def check_gather(view: object, truth: Truth, x: Array) -> None:
    """<W x, y> = <x, W^T y> to 1e-5, and W^T y is the reference's to 1e-5 of its largest entry."""
    if not hasattr(view, "gather"):
        return
    y = np.random.default_rng(4).normal(size=truth.image.shape).astype(np.float32)
    y[truth.band] = 0  # flipped weights of the band would enter every sum
    assert_adjoint(lambda v: view.splat(v)[0], view.gather, x, y, rtol=1e-5)
    want = truth.view.gather(y)
    assert np.abs(view.gather(y) - want).max(initial=0) <= 1e-5 * max(np.abs(want).max(initial=0), 1e-3)


LABELS = ("error away from cut-offs", "mean error", "relative error of depth", "pixels flipped", "pixels")


def record(scored: Scored, backend: Backend, group: str, measured: Measure) -> None:
    for label, value in zip(LABELS, vars(scored).values(), strict=True):
        measured(f"{backend.name}, {group}", label, value)


def part_of(camera: Camera, width: int = 48, height: int = 36) -> Camera:
    """The middle of a photograph at its own resolution."""
    left, top = (camera.width - width) // 2, (camera.height - height) // 2
    return replace(camera, width=width, height=height, cx=camera.cx - left, cy=camera.cy - top)


@lru_cache
def scene_and_camera(path: Path, size: tuple[int, int]) -> tuple[Scene, Camera]:
    """A scene, and its first photograph or, without any, the camera that frames it."""
    scene = load_scene(path)
    return scene, scene.cameras[0].resized(*size) if scene.cameras else scene.framing_camera(size)


def check_scene(
    backend: Backend, scene: Scene, camera: Camera, settings: RasterSettings, group: str, measured: Measure
) -> None:
    truth = truth_of_scene(scene.gaussians, camera, backend.expected_settings(settings), backend.band)
    scored = score(backend, scene.gaussians, camera, settings, truth)
    record(scored, backend, group, measured)
    # Half floats: dozens of layers at every pixel, each rounded once; towards zero in software.
    assert scored.worst <= (2e-2 if backend.name == "opengl-half" else backend.tolerance)
    assert scored.depth <= 2e-5
    if backend.name != "opengl-half":
        assert scored.flips <= max(FLIPS * scored.pixels, 2)


@pytest.mark.parametrize("antialiased", [False, True])
def test_bundled_scene(fast_backend: Backend, measured: Measure, antialiased: bool) -> None:
    scene, camera = scene_and_camera(DEMO, (320, 240))
    settings = replace(INRIA, antialiased=antialiased)
    check_scene(fast_backend, scene, part_of(camera), settings, "bundled scene", measured)


@pytest.mark.parametrize("name", REAL)
def test_real_scene(real_data: Path, fast_backend: Backend, measured: Measure, name: str) -> None:
    """Trained Gaussians: anisotropy up to 2.5e7, opacities of exactly 1, equal depths."""
    scene, camera = scene_and_camera(real_data / "gaussians" / name, (320, 240))
    check_scene(fast_backend, scene, part_of(camera), INRIA, name, measured)


def random_case(seed: int) -> tuple[Gaussians, Camera, RasterSettings]:
    """Every seed another kind: few or many, small or large, opaque or faint, near or far, both profiles."""
    rng = np.random.default_rng(seed)
    smallest = 10 ** rng.uniform(-4, -1)
    gaussians = random_gaussians(
        int(rng.integers(1, 80)), seed, scale_range=(smallest, smallest * 10 ** rng.uniform(0.1, 1.5))
    )
    logits = gaussians.opacity_logits + np.float32(rng.uniform(-3, 6))
    settings = replace((INRIA, GSPLAT)[seed % 2], antialiased=bool(rng.integers(2)))
    width, height = (int(size) for size in rng.integers(1, 50, 2))
    camera = random_camera(
        seed, width, height, distance=rng.uniform(0.3, 5), off_centre=bool(rng.integers(2))
    )
    return replace(gaussians, opacity_logits=logits), camera, settings


def check_random_scenes(seeds: range, backend: Backend, measured: Measure) -> None:
    flips = pixels = 0
    for seed in seeds:
        gaussians, camera, settings = random_case(seed)
        truth = truth_of(gaussians, camera, backend.expected_settings(settings), backend.band)
        scored = score(backend, gaussians, camera, settings, truth)
        record(scored, backend, "random scenes", measured)
        assert scored.worst <= backend.tolerance, f"seed {seed}"
        assert scored.depth <= 2e-5, f"seed {seed}"
        flips, pixels = flips + scored.flips, pixels + scored.pixels
    assert flips <= FLIPS * pixels


@pytest.mark.parametrize("start", [0, pytest.param(200, marks=pytest.mark.slow)])
def test_random_scenes(fast_backend: Backend, measured: Measure, start: int) -> None:
    count = (1_000 if start else 200) if fast_backend.name == "cpu" else (160 if start else 40)
    check_random_scenes(range(start, start + count), fast_backend, measured)


def corner_case(width: int, height: int) -> tuple[Gaussians, Camera, Camera]:
    """Gaussians of a few pixels in the last corner of an image, its camera, and that of the corner alone."""
    camera = random_camera(3, width, height, distance=3.0, off_centre=False)
    rng, n = np.random.default_rng(0), 300
    depths = rng.uniform(2, 4, n)
    pixels = rng.uniform((width - 40, height - 30), (width, height), (n, 2))
    in_camera = np.column_stack([(pixels - (camera.cx, camera.cy)) / camera.fx, np.ones(n)]) * depths[:, None]
    means = (in_camera - camera.world_to_camera[:3, 3]) @ camera.rotation
    log_scales = np.log(rng.uniform(0.2, 3, (n, 3)) * 3 / camera.fx)
    corner = replace(camera, width=40, height=30, cx=camera.cx - (width - 40), cy=camera.cy - (height - 30))
    return replace(random_gaussians(n, 3), means=means, log_scales=log_scales), camera, corner


@pytest.mark.parametrize("size", [(1920, 1080), pytest.param((3840, 2160), marks=pytest.mark.slow)])
def test_far_corner_of_a_large_image(fast_backend: Backend, measured: Measure, size: tuple[int, int]) -> None:
    """Pixel positions are largest there, and a float32 has the fewest digits left for the fraction: on the
    GPU an opaque Gaussian of sub-pixel size is off by 5e-8 per pixel of the image's width."""
    gaussians, camera, corner = corner_case(*size)
    x = random_values(len(gaussians), 3)
    reference = REFERENCE.view(gaussians, corner, fast_backend.expected_settings(INRIA))
    band = reference.cut_off_band(3 * fast_backend.band)
    image = fast_backend.raster.view(gaussians, camera).splat(x)[0][-30:, -40:]
    error = np.abs(image - reference.splat(x)[0]).max(-1)
    measured(f"{fast_backend.name}, corner of {size[0]} px", "error away from cut-offs", error[~band].max())
    positions = 5e-8 * size[0] if fast_backend.name == "opengl-single" else 0.0
    assert error[~band].max() <= max(fast_backend.tolerance, positions)


@pytest.mark.slow
@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("name", REAL)
def test_whole_view_of_a_real_scene(
    real_data: Path, fast_backend: Backend, measured: Measure, name: str, antialiased: bool
) -> None:
    scene, camera = scene_and_camera(real_data / "gaussians" / name, (160, 120))
    settings = replace(INRIA, antialiased=antialiased)
    check_scene(fast_backend, scene, camera, settings, f"{name} whole", measured)
