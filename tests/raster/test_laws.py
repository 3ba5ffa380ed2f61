"""Rasterizers over random parameters, hard cases and trained scenes: laws, and errors against the reference.

Hypothesis draws scene, camera and settings: 25 examples per law, 1000 with `--slow`, the same in every run.
Away from cut-offs the error is bounded (`tests/support/backends.py`); at cut-offs, where rounding decides
whether an alpha of 1/255 counts, the pixels that flip have a budget. Figures: run with `--measured`.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from langsplat_core.arrays import Array
from langsplat_core.config import GSPLAT, INRIA, RasterSettings
from langsplat_core.errors import BackendError
from langsplat_core.io.scenes import load_scene
from langsplat_core.raster import LiftingView, load_rasterizer
from langsplat_core.raster.cpu import projection as cpu_colour
from langsplat_core.raster.cpu.rasterizer import CpuRasterizer
from langsplat_core.raster.reference import ReferenceRasterizer, ReferenceView, project
from langsplat_core.raster.reference import colours as true_colours
from langsplat_core.raster.render import splat_colours
from langsplat_core.scene import Camera, Gaussians
from tests.support.backends import Backend, Measure, assert_adjoint
from tests.support.hard_cases import CASES, ROW, Case, Drawing, Seen, altered, balls, crowd, draw
from tests.support.scenes import DEMO, random_camera, random_gaussians, random_values, without_perspective

Drawn = tuple[Gaussians, Camera, RasterSettings]


@st.composite
def cases(draw: st.DrawFn) -> Drawn:
    """1 to 80 Gaussians, sizes 1e-6 to 10 world units, opacities from 0 to 1, any camera of both kinds."""
    count, seed = draw(st.integers(1, 80)), draw(st.integers(0, 2**31))
    rng = np.random.default_rng(seed)
    base = random_gaussians(count, seed)
    size, anisotropy = draw(st.floats(-6, 1)), draw(st.floats(0, 6))
    logs = np.log(10.0) * (size - rng.uniform(0, anisotropy, (count, 3)))
    opacity = draw(st.sampled_from([-np.inf, -5.0, -2.0, 0.0, 2.0, 6.0, np.inf]))
    gaussians = replace(
        base,
        means=base.means * draw(st.sampled_from([0.01, 1.0, 3.0])),
        log_scales=logs,
        quats_wxyz=base.quats_wxyz * 10 ** draw(st.floats(-3, 3)),
        opacity_logits=opacity + rng.normal(size=count),
    )
    width, height = draw(st.integers(1, 50)), draw(st.integers(1, 50))
    camera = random_camera(seed, width, height, distance=draw(st.floats(0.05, 6)))
    if draw(st.booleans()):
        camera = without_perspective(camera, draw(st.floats(0.05, 6)))
    profile = draw(st.sampled_from([INRIA, GSPLAT]))
    focal = draw(st.sampled_from([None, None, 0.3 * camera.fx, 2.5 * camera.fx]))
    return gaussians, camera, replace(profile, antialiased=draw(st.booleans()), focal=focal)


def over_random_cases(law: Callable[[Drawn], None], slow: bool, few: int = 25) -> None:
    """Run `law` on as many cases as the tier has."""
    count = 1000 if slow else few
    examples = settings(max_examples=count, derandomize=True, suppress_health_check=list(HealthCheck))
    examples(given(cases())(law))()


@pytest.fixture
def slow(request: pytest.FixtureRequest) -> bool:
    return bool(request.config.getoption("--slow"))


def test_splat_is_linear(backend: Backend, slow: bool) -> None:
    """W (2 x - 3 y) = 2 W x - 3 W y."""
    atol = {"reference": 1e-12, "opengl-half": 2.5e-2}.get(backend.name, 1e-5)

    def law(case: Drawn) -> None:
        n, view = len(case[0]), backend.raster.view(*case)
        x, y = (random_values(n, 2, seed).astype(np.float64) for seed in (1, 2))
        mixed = view.splat(2 * x - 3 * y)[0]
        np.testing.assert_allclose(mixed, 2 * view.splat(x)[0] - 3 * view.splat(y)[0], atol=atol)

    over_random_cases(law, slow)


# How far every fast rasterizer is from the reference.

FLIPS = 1e-3  # of the pixels; each costs one alpha of 1/255


@dataclass(frozen=True, eq=False)
class Truth:
    """What the reference makes of a drawing."""

    image: Array  # (H, W, C) of its features
    alpha: Array
    depth: Array
    band: Array  # (H, W) True at a cut-off
    view: ReferenceView


def truth_of(seen: Seen) -> Truth:
    return _truth(seen.drawing, seen.backend.expected_settings(seen.drawing.settings), seen.backend.band)


@lru_cache(maxsize=4)  # shared by the backends
def _truth(drawing: Drawing, settings: RasterSettings, width: float) -> Truth:
    """One pass for image, alpha and depth: the reference is slow."""
    view = ReferenceRasterizer().view(drawing.gaussians, drawing.camera, settings)
    sums, alpha = view.splat(np.column_stack([drawing.features(), view.footprints.depths]))
    depth = sums[..., -1] / np.where(alpha > 0, alpha, 1)
    return Truth(sums[..., :-1], alpha, depth, view.cut_off_band(width), view)


@dataclass(frozen=True, eq=False)
class Scored:
    """Error of one picture."""

    worst: float  # away from cut-offs: image, alpha
    mean: float
    depth: float  # relative, where alpha > 0.01
    flips: int  # pixels at a cut-off that are off by more than the tolerance
    pixels: int
    largest: float  # at a cut-off


LABELS = ("error away from cut-offs", "mean error", "relative error of depth", "pixels flipped", "pixels")


def score(seen: Seen, group: str, measured: Measure) -> Scored:
    """Image, alpha and depth against the reference."""
    backend, truth = seen.backend, truth_of(seen)
    error = np.abs(np.dstack([seen.image - truth.image, seen.alpha - truth.alpha])).max(-1)
    covered = ~truth.band & (truth.alpha > 0.01)
    scored = Scored(
        worst=float(error[~truth.band].max(initial=0)),
        mean=float(error.mean()),
        depth=float(np.abs(seen.view.depth()[covered] / truth.depth[covered] - 1).max(initial=0)),
        flips=int((error[truth.band] > backend.tolerance).sum()),
        pixels=error.size,
        largest=float(error[truth.band].max(initial=0)),
    )
    for label, value in zip(LABELS, vars(scored).values(), strict=False):
        measured(f"{backend.name}, {group}", label, value)
    return scored


def check_gather(seen: Seen) -> None:
    """W^T y is the reference's, to a part of the largest entry."""
    if not hasattr(seen.view, "gather"):
        return
    truth, features, rtol = truth_of(seen), seen.drawing.features(), seen.backend.adjoint_tolerance
    y = np.random.default_rng(4).normal(size=truth.image.shape).astype(np.float32)
    y[truth.band] = 0  # flipped weights of the band would enter every sum
    want = truth.view.gather(y)
    assert_adjoint(lambda v: seen.view.splat(v)[0], seen.view.gather, features, y, rtol)
    assert np.abs(seen.view.gather(y) - want).max(initial=0) <= rtol * max(np.abs(want).max(initial=0), 1e-3)


def test_random_scenes_equal_the_reference(fast_backend: Backend, slow: bool, measured: Measure) -> None:
    """Image and depth away from cut-offs, within the backend's promise; sums of what is gathered."""
    flips = pixels = 0

    def law(case: Drawn) -> None:
        nonlocal flips, pixels
        seen = draw(fast_backend, Drawing(*case))
        if not fast_backend.promises(truth_of(seen).view.footprints):
            return
        scored = score(seen, "random scenes", measured)
        assert scored.worst <= fast_backend.tolerance
        assert scored.depth <= 2e-5
        check_gather(seen)
        flips, pixels = flips + scored.flips, pixels + scored.pixels

    over_random_cases(law, slow, few=100)
    assert flips <= FLIPS * pixels


def check_gradients(view: Any, values: Array, without: Array) -> None:
    """Finite everywhere, and exactly zero for the rows `without`."""
    rng, size = np.random.default_rng(2), (view.camera.height, view.camera.width)
    by_image, by_alpha = rng.normal(size=(*size, values.shape[1])), rng.normal(size=size)
    for name, gradient in view.backward(values, by_image, by_alpha)._asdict().items():
        assert len(gradient) == len(values)
        assert np.isfinite(gradient).all(), name
        assert not gradient[without].any(), name


def test_gradients_are_finite(slow: bool) -> None:
    """Of the CPU backend; those that are not drawn have none."""

    def law(case: Drawn) -> None:
        view = CpuRasterizer().view(*case)
        check_gradients(view, random_values(len(case[0]), 2), ~view.drawn)

    over_random_cases(law, slow)


def test_orthographic_images_ignore_steps_along_the_view(backend: Backend) -> None:
    """Colours that depend on the view too; a step moves no Gaussian behind the camera."""
    gaussians, camera = random_gaussians(60, 3, sh_degree=3), without_perspective(random_camera(5, 41, 30))
    step = np.eye(4)
    step[2, 3] = 4.0  # a power of two: depths keep their last digit
    moved = replace(camera, world_to_camera=step @ camera.world_to_camera)
    images = []
    for at in (camera, moved):
        drawn = splat_colours(backend.raster.view(gaussians, at), gaussians)
        images.append(np.concatenate([drawn.colours, drawn.alpha[..., None]], -1))
    assert images[0].std() > 0.1
    np.testing.assert_allclose(images[1], images[0], atol=max(backend.tolerance, 1e-6))


# The table of hard cases on every rasterizer that loads.

# What rounding can decide in a pixel: two alphas of 1/255, or one last weight alpha T before T reaches 1e-4,
# which is largest for alpha = 0.99.
MOST_AT_A_CUT_OFF = 2 / 255 + 0.99 * 1e-4 / (1 - 0.99)
# Where gsplat draws something else by design: covariances overflow in float32, its cap of alpha is its own.
BEYOND_GSPLAT = {
    "scale e^40", "scale e^80", "all scales e^(79, 79, 79)", "all scales e^(-inf, 79, 79)",
    "all scales e^(40, 0, -40)", "one opaque Gaussian",
}  # fmt: skip
NAMED = [pytest.param(case, id=case.name) for case in CASES]


def run_case(case: Case, drawing: Drawing, backend: Backend, measured: Measure) -> Seen:
    """Everything the table promises of every case."""
    if case.only and backend.name not in case.only:
        pytest.skip("too long for this backend")
    if backend.gsplat and case.name in BEYOND_GSPLAT:
        pytest.skip("gsplat draws something else by design")
    try:
        seen = draw(backend, drawing)
    except BackendError as error:
        if not backend.gsplat:
            raise
        pytest.skip(str(error))  # gsplat fixes some settings
    camera, channels = seen.drawing.camera, seen.drawing.features().shape[1]
    assert seen.image.shape == (camera.height, camera.width, channels)
    assert np.isfinite(seen.image).all()
    assert np.isfinite(seen.view.depth()).all()
    median = seen.view.median_depth()
    assert np.isfinite(median).all()
    assert not median[seen.alpha < 0.5 - 1e-6].any()
    assert seen.alpha.shape == (camera.height, camera.width)
    assert seen.alpha.min() >= 0
    assert seen.alpha.max() <= 1
    if case.compare and backend.name != "reference" and backend.promises(truth_of(seen).view.footprints):
        compare(seen, measured)
    if isinstance(seen.view, LiftingView):
        check_adjoint(seen)
    if hasattr(seen.view, "backward"):
        check_gradients(seen.view, seen.drawing.features(), ~seen.drawing.gaussians.valid())
    return seen


def compare(seen: Seen, measured: Measure) -> None:
    """The picture is the reference's but at cut-offs, where an alpha of 1/255 may flip."""
    scored = score(seen, "hard cases", measured)
    assert scored.worst <= seen.backend.tolerance
    assert scored.largest <= MOST_AT_A_CUT_OFF


def check_adjoint(seen: Seen) -> None:
    """<W x, y> = <x, W^T y>, and nothing for rows that are not drawn."""
    y = np.random.default_rng(1).normal(size=seen.image.shape).astype(np.float32)
    gathered = seen.view.gather(y)
    assert gathered.shape == seen.drawing.features().shape
    assert np.isfinite(gathered).all()
    assert not gathered[~seen.drawing.gaussians.valid()].any()
    sums = seen.view.gather(np.ones((*seen.alpha.shape, 1), np.float32))[:, 0]
    np.testing.assert_allclose(seen.view.contributions(), sums, rtol=1e-5, atol=1e-5)
    rtol = seen.backend.adjoint_tolerance
    assert_adjoint(lambda x: seen.view.splat(x)[0], seen.view.gather, seen.drawing.features(), y, rtol)


@pytest.mark.parametrize("case", NAMED)
def test_hard_cases_equal_the_reference(case: Case, backend: Backend, measured: Measure) -> None:
    case.check(run_case(case, case.build(), backend, measured))


@pytest.mark.long
@pytest.mark.parametrize("case", NAMED)
def test_antialiased_hard_cases_equal_the_reference(case: Case, backend: Backend, measured: Measure) -> None:
    """Assert what holds for every case, with Mip-Splatting's compensation."""
    drawing = case.build()
    settings = replace(drawing.settings, antialiased=True)
    run_case(case, replace(drawing, settings=settings), backend, measured)


@pytest.mark.parametrize("coefficient", [1e20, 1e10, 7e4])
def test_colours_that_overflow_are_dropped(backend: Backend, coefficient: float) -> None:
    """Finite, 0 where they would be negative, and no gradient there."""
    drawing = altered("sh", ROW, coefficient * np.array([1.0, -1.0, 0.0]), sh_degree=3)
    sh, means, eye = drawing.gaussians.sh, drawing.gaussians.means, drawing.camera.position
    want = true_colours(sh, means, eye)
    assert want.min() == 0
    assert want.max() > 1e3
    if backend.name == "cpu":
        got = cpu_colour.colours(sh, means, eye)
        np.testing.assert_allclose(got, want, rtol=1e-6)
        gradients = cpu_colour.colours_backward(sh, means, eye, np.ones_like(got))
        assert all(np.isfinite(gradient).all() for gradient in gradients)
        assert not gradients[0].transpose(0, 2, 1)[want == 0].any()
    if backend.name.startswith("opengl"):
        view = backend.raster.view(drawing.gaussians, drawing.camera)
        (texture,) = backend.raster.draw(view, ["colour"])
        image = np.frombuffer(texture.read(), texture.dtype).reshape(27, 40, 4)[..., :3]
        assert np.isfinite(image).all()
        assert image.min() >= 0
        if backend.name == "opengl-single":
            reference = ReferenceRasterizer().view(drawing.gaussians, drawing.camera).splat(want)[0]
            np.testing.assert_allclose(image, reference, atol=1e-4 * want.max())


def test_dropped_rows_are_counted_by_reason() -> None:
    """One sentence per reason; a row with several faults counts once."""
    broken = crowd().gaussians
    broken.means[:2], broken.quats_wxyz[1:5], broken.opacity_logits[4:6] = np.nan, 0, np.nan
    broken.sh[6, 0, 1], broken.log_scales[7:9, 2] = 1e38, [np.inf, 81]
    assert broken.invalid_rows() == {
        "position not finite": 2,
        "scale not a number or above e^80": 2,
        "rotation zero or not finite": 3,
        "opacity not a number": 1,
        "colour not finite or above 1e20": 1,
    }
    assert (~broken.valid()).sum() == 9
    assert crowd().gaussians.invalid_rows() == {}


@pytest.mark.long
@pytest.mark.parametrize("case", NAMED)
def test_results_do_not_depend_on_the_number_of_threads(case: Case) -> None:
    """Forward, adjoint, lifted labels and gradients of the CPU backend, bit for bit."""
    drawing = case.build()
    target = np.random.default_rng(3).normal(size=(drawing.camera.height, drawing.camera.width, 1))
    x = drawing.features()[:, :1]
    results = []
    for threads in (1, 2, 5):
        rasterizer = load_rasterizer("cpu", threads=threads)
        view = rasterizer.view(drawing.gaussians, drawing.camera, drawing.settings)
        gradients = view.backward(x, target, target[..., 0])
        labels = view.gather_labels((target[None, ..., 0] > 0).astype(np.int32), 2).toarray()
        results.append([*view.splat(x), view.gather(target), view.median_depth(), labels, *gradients])
    for other in results[1:]:
        assert all(np.array_equal(one, two) for one, two in zip(results[0], other, strict=True))


@pytest.mark.slow
def test_too_many_tile_intersections_are_refused() -> None:
    """17000 Gaussians that fill 129600 tiles each: one line, before any memory is asked for."""
    gaussians = balls(np.linspace(2.0, 3.0, 17_000), 0.1, 1e6)
    with pytest.raises(BackendError, match="smaller"):
        load_rasterizer("cpu").view(gaussians, Camera(7680, 4320, 6000.0, 6000.0, 3840.0, 2160.0, np.eye(4)))


# The bundled scene, real scenes, and the corner of a large image.

REAL = ("guitar.compressed.ply", "playbot_8k_sog", "playbot_31k_sog")


@lru_cache
def drawing_of(path: Path, antialiased: bool = False) -> Drawing:
    """The middle of a scene's first photograph or, without any, of what the camera that frames it sees."""
    scene, size = load_scene(path), (320, 240)
    camera = scene.cameras[0].resized(*size) if scene.cameras else scene.framing_camera(size)
    camera = replace(camera, width=48, height=36, cx=camera.cx - 136, cy=camera.cy - 102)
    return Drawing(scene.gaussians, camera, replace(INRIA, antialiased=antialiased))


def check_scene(backend: Backend, drawing: Drawing, group: str, measured: Measure) -> None:
    seen = draw(backend, drawing)
    scored = score(seen, group, measured)
    check_gather(seen)
    # Half floats: dozens of layers at every pixel, each rounded once; towards zero in software.
    assert scored.worst <= (2e-2 if backend.name == "opengl-half" else backend.tolerance)
    assert scored.depth <= 2e-5
    if backend.name != "opengl-half":
        assert scored.flips <= max(FLIPS * scored.pixels, 2)


@pytest.mark.long
@pytest.mark.parametrize("antialiased", [False, True])
def test_bundled_scene(fast_backend: Backend, measured: Measure, antialiased: bool) -> None:
    check_scene(fast_backend, drawing_of(DEMO, antialiased), "bundled scene", measured)


@pytest.mark.long
@pytest.mark.parametrize("name", REAL)
def test_real_scene(real_data: Path, fast_backend: Backend, measured: Measure, name: str) -> None:
    """Trained Gaussians: anisotropy up to 2.5e7, opacities of exactly 1, equal depths."""
    check_scene(fast_backend, drawing_of(real_data / "gaussians" / name), name, measured)


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


@pytest.mark.long
@pytest.mark.parametrize("size", [(1920, 1080), pytest.param((7680, 4320), marks=pytest.mark.slow)])
def test_far_corner_of_a_large_image(fast_backend: Backend, measured: Measure, size: tuple[int, int]) -> None:
    """Pixel positions are largest there, and a float32 has the fewest digits left for the fraction: gsplat
    draws what has means rounded once, OpenGL is off by 5e-8 per pixel of the image's width."""
    if fast_backend.name == "cuda-twin" and size[0] > 1920:
        pytest.skip("too long for this backend")
    gaussians, camera, corner = corner_case(*size)
    x = random_values(len(gaussians), 3)
    settings, start = fast_backend.expected_settings(INRIA), np.array(size) - (40, 30)
    footprints = project(gaussians, corner, settings)
    if fast_backend.gsplat:
        rounded = np.float32(footprints.means_px + start) - np.float64(start)
        footprints = replace(footprints, means_px=rounded)
    reference = ReferenceView(footprints, corner, settings)
    band = reference.cut_off_band(3 * fast_backend.band)
    image = fast_backend.raster.view(gaussians, camera).splat(x)[0][-30:, -40:]
    error = np.abs(image - reference.splat(x)[0]).max(-1)
    measured(f"{fast_backend.name}, corner of {size[0]} px", "error away from cut-offs", error[~band].max())
    positions = 5e-8 * size[0] if fast_backend.name.startswith("opengl") else 0.0
    assert error[~band].max() <= max(fast_backend.tolerance, positions)
