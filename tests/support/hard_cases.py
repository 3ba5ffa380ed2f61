"""What the table of hard cases is built from: a drawing, and what a rasterizer made of it."""

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from langsplat_core.arrays import Array, logit
from langsplat_core.config import GSPLAT, INRIA, RasterSettings
from langsplat_core.scene import Camera, Gaussians
from tests.support.backends import Backend
from tests.support.scenes import random_camera, random_gaussians, random_values, shifted

AXIS = Camera(21, 21, 30.0, 30.0, 10.5, 10.5, np.eye(4))  # at the origin, looks along z; (10, 10) on the axis


@dataclass(frozen=True, eq=False)
class Drawing:
    gaussians: Gaussians
    camera: Camera = AXIS
    settings: RasterSettings = INRIA
    values: Array | None = None  # (N, C); random ones if None

    def features(self) -> Array:
        """Return (N, C) values to splat."""
        return random_values(len(self.gaussians), 3) if self.values is None else self.values


@dataclass(frozen=True, eq=False)
class Seen:
    backend: Backend
    drawing: Drawing
    view: Any
    image: Array
    alpha: Array

    def again(self, **changes: Any) -> "Seen":
        """The same backend's output for the same drawing with some fields changed."""
        return draw(self.backend, replace(self.drawing, **changes))

    def within(self, atol: float) -> float:
        """`atol`; half floats within their own error."""
        return max(atol, 1e-3) if self.backend.name == "opengl-half" else atol


Check = Callable[[Seen], None]


@dataclass(frozen=True)
class Case:
    name: str
    build: Callable[[], Drawing]
    check: Check  # of what must happen beside all that `run_case` promises
    compare: bool = True  # with the reference; False where the reference would take too long
    only: tuple[str, ...] = ()  # backends; all if empty


def draw(backend: Backend, drawing: Drawing) -> Seen:
    view = backend.raster.view(drawing.gaussians, drawing.camera, drawing.settings)
    return Seen(backend, drawing, view, *view.splat(drawing.features()))


def crowd(seed: int = 0, n: int = 24, sh_degree: int = 0, **options: Any) -> Drawing:
    return Drawing(random_gaussians(n, seed, sh_degree, **options), random_camera(seed, 40, 27))


def altered(field: str, rows: Any, value: Any, **options: Any) -> Drawing:
    """A crowd in which `field`[rows] is `value`."""
    drawing = crowd(**options)
    array = getattr(drawing.gaussians, field).copy()
    array[rows] = value
    return replace(drawing, gaussians=replace(drawing.gaussians, **{field: array}))


def balls(z: Any, opacity: Any = 0.8, scale: Any = 0.2, x: Any = 0.0, y: Any = 0.0) -> Gaussians:
    """Gaussians at (x, y, z), each argument one number for all or one per Gaussian; a scale may be (N, 3)."""
    n = np.size(z)
    means = np.stack(np.broadcast_arrays(x, y, np.atleast_1d(z)), -1).astype(np.float64)
    scales = np.broadcast_to(scale if np.ndim(scale) > 1 else np.reshape(scale, (-1, 1)), (n, 3))
    with np.errstate(divide="ignore"):
        opacities = logit(np.broadcast_to(np.asarray(opacity, np.float64), n))
        quats = np.tile([1.0, 0, 0, 0], (n, 1))
        return Gaussians(means, np.log(scales), quats, opacities, np.zeros((n, 1, 3)))


def identical(seen: Seen, other: Seen) -> None:
    assert np.array_equal(seen.image, other.image)
    assert np.array_equal(seen.alpha, other.alpha)


def close(seen: Seen, other: Seen, atol: float) -> None:
    """Image and alpha within `atol`."""
    np.testing.assert_allclose(seen.image, other.image, atol=seen.within(atol))
    np.testing.assert_allclose(seen.alpha, other.alpha, atol=seen.within(atol))


def draws_nothing(seen: Seen) -> None:
    assert not seen.image.any()
    assert not seen.alpha.any()


def draws_something(seen: Seen) -> None:
    assert seen.alpha.max() > 0.1


# The table of what is hard for a rasterizer: `test_laws.py` runs each row on every backend that loads and
# asserts, beside the row's own check, that nothing is NaN, that rows were dropped as said, the picture is
# the reference's, and that adjoint and gradients are finite and zero for dropped rows.

ROW = 5  # the row that is made hard where only one is
_SLOTS = {"means": (ROW, 1), "log_scales": (ROW, 0), "quats_wxyz": (ROW, 2)}
_SLOTS |= {"opacity_logits": (ROW,), "sh": (ROW, 3, 2)}
_POISONS = {"nan": np.nan, "inf": np.inf, "-inf": -np.inf, "1e38": 1e38, "-1e38": -1e38}
_POISONS |= {"a denormal": 1e-40, "-0": -0.0}
_FATAL = {
    **dict.fromkeys(("means", "quats_wxyz"), ("nan", "inf", "-inf")),
    "sh": ("nan", "inf", "-inf", "1e38", "-1e38"),
    "log_scales": ("nan", "inf", "1e38"),
    "opacity_logits": ("nan",),
}


def _as_without_the_row(seen: Seen) -> None:
    gaussians, values = seen.drawing.gaussians, seen.drawing.features()
    others = np.arange(len(gaussians)) != ROW
    identical(seen, seen.again(gaussians=gaussians.take(others), values=values[others]))
    noise = values.copy()
    noise[ROW] = np.nan  # whatever is asked of a dropped row is not looked at
    identical(seen, seen.again(values=noise))


def _poisoned(field: str, poison: str) -> Case:
    fatal = poison in _FATAL[field]
    return Case(
        f"{poison} in {field}",
        lambda: altered(field, _SLOTS[field], _POISONS[poison], sh_degree=1),
        _as_without_the_row if fatal else draws_something,
    )


def _thresholds(seen: Seen) -> None:
    """Below 1/255 nothing is drawn, above it all of it, at it one or the other."""
    np.testing.assert_allclose(seen.alpha[10, 5:10], [0, 0, 0, 0, 1.001 / 255], atol=seen.within(1e-6))
    assert seen.alpha[10, 7] == 0 or abs(seen.alpha[10, 7] * 255 - 1) < 1e-3


def _dot_of_the_dilation(seen: Seen) -> None:
    squared = (np.arange(21) - 10.0) ** 2
    want = 0.8 * np.exp(-0.5 * (squared[:, None] + squared) / 0.3)
    want[want < 1 / 255] = 0
    np.testing.assert_allclose(seen.alpha, want, atol=seen.within(1e-6))


def _quaternions_of_length(factor: float) -> Case:
    def check(seen: Seen) -> None:
        gaussians = seen.drawing.gaussians
        other = seen.again(gaussians=replace(gaussians, quats_wxyz=gaussians.quats_wxyz * np.float32(factor)))
        if np.log2(factor) % 1 == 0:
            identical(seen, other)
        else:
            close(seen, other, 1e-5)

    return Case(f"quaternions times {factor:g}", crowd, check)


def _needles(ratio: float, length: float) -> Drawing:
    drawing = crowd(3)
    scales = np.tile(np.log([length, length / ratio, length / ratio]), (24, 1))
    return replace(drawing, gaussians=replace(drawing.gaussians, log_scales=scales))


def _pancakes_edge_on() -> Drawing:
    thin = [[0.4, 0.4, 1e-7], [0.4, 1e-7, 0.4], [1e-7, 0.4, 0.4]]  # seen along the third, x and y plane
    return Drawing(balls([2.0, 3.0, 4.0], [0.5, 0.6, 0.7], thin, x=[0.0, 0.1, -0.2]))


def _no_more_than_the_cap(seen: Seen) -> None:
    assert abs(float(seen.alpha[10, 10]) - 0.99) < seen.within(1e-6)


def _stack_stops(seen: Seen) -> None:
    """The second would leave 1e-4: it and all behind it weigh nothing."""
    if hasattr(seen.view, "gather"):
        weights = seen.view.gather(np.ones((21, 21, 1), np.float32))[:, 0]
        assert weights[0] > 0
        assert not weights[1:].any()


def _only(*drawn: int) -> Check:
    """A check that exactly these rows weigh anything, told by splatting an indicator of every row."""

    def check(seen: Seen) -> None:
        one_hot = seen.again(values=np.eye(len(seen.drawing.gaussians), dtype=np.float32))
        assert tuple(np.flatnonzero(one_hot.image.max((0, 1)))) == drawn

    return check


def _crowded_pixel(count: int) -> Drawing:
    gaussians = balls(np.linspace(2.0, 3.0, count), 0.005, 50.0)
    return Drawing(gaussians, Camera(1, 1, 1.0, 1.0, 0.5, 0.5, np.eye(4)), values=np.ones((count, 1)))


def _crowded_alpha(seen: Seen) -> None:
    """alpha = 1 - (1 - a)^n, where n Gaussians fit before T <= 1e-4."""
    a = 1 / (1 + np.exp(-np.float64(np.float32(np.log(0.005 / 0.995)))))
    n = np.ceil(np.log(1e-4) / np.log1p(-a)) - 1
    want = 1 - (1 - a) ** n if seen.backend.stops_early else 1.0
    tolerance = {"cpu": 1e-5, "opengl-single": 1e-4}.get(seen.backend.name, 0.1)
    assert abs(float(seen.alpha[0, 0]) - want) < tolerance
    assert abs(float(seen.image[0, 0, 0]) - want) < tolerance


def _permuted(seen: Seen) -> None:
    order = np.random.default_rng(0).permutation(len(seen.drawing.gaussians))
    drawing = seen.drawing
    identical(seen, seen.again(gaussians=drawing.gaussians.take(order), values=drawing.features()[order]))


def _ties_by_index(seen: Seen) -> None:
    weights = seen.again(values=np.eye(3, dtype=np.float32)).image[10, 10]
    np.testing.assert_allclose(weights, [0.5, 0.3, 0.08], atol=seen.within(1e-6))


def _crop_of(width: int, height: int, left: int, top: int) -> Case:
    """A crop has its principal point anywhere."""

    def build() -> Drawing:
        return Drawing(random_gaussians(30, 7), random_camera(7, 64, 40, off_centre=False, distance=8.0))

    def check(seen: Seen) -> None:
        wide = seen.drawing.camera
        camera = replace(wide, width=width, height=height, cx=wide.cx - left, cy=wide.cy - top)
        cropped = seen.again(camera=camera)
        window = np.s_[top : top + height, left : left + width]
        close(cropped, replace(seen, image=seen.image[window], alpha=seen.alpha[window]), 2e-5)

    name = f"principal point at ({32 - left}, {20 - top})"
    return Case(name, build, check)


def _in_half(seen: Seen) -> None:
    gaussians = seen.drawing.gaussians
    half = [getattr(gaussians, field.name).astype(np.float16) for field in fields(gaussians)]
    values = seen.drawing.features().astype(np.float16)
    promoted = Gaussians(*(array.astype(np.float32) for array in half))
    identical(
        seen.again(gaussians=Gaussians(*half), values=values),
        seen.again(gaussians=promoted, values=values.astype(np.float32)),
    )


def _world_times(exponent: int) -> Case:
    factor = 2.0**exponent

    def check(seen: Seen) -> None:
        g, camera = seen.drawing.gaussians, seen.drawing.camera
        matrix = camera.world_to_camera.copy()
        matrix[:3, 3] *= factor
        bigger = replace(g, means=g.means * factor, log_scales=g.log_scales + exponent * np.log(2.0))
        settings, farther = replace(INRIA, near=INRIA.near * factor), replace(camera, world_to_camera=matrix)
        other = seen.again(gaussians=bigger, camera=farther, settings=settings)
        close(seen, other, 2e-5)  # the logarithms round to 1e-6

    return Case(
        f"a world of 2^{exponent} units",
        lambda: Drawing(random_gaussians(24, 8), random_camera(8, 40, 27, distance=1.0)),
        check,
    )


def _far_away() -> Drawing:
    drawing = crowd(16)
    on_a_grid = np.round(drawing.gaussians.means * 16) / 16  # float32 holds these at 1e6
    gaussians = replace(drawing.gaussians, means=on_a_grid)
    return Drawing(*shifted(gaussians, drawing.camera, np.array([1e6, -5e5, 2e5])))


def _as_at_the_origin(seen: Seen) -> None:
    here = shifted(seen.drawing.gaussians, seen.drawing.camera, np.array([-1e6, 5e5, -2e5]))
    close(seen, seen.again(gaussians=here[0], camera=here[1]), 2e-5)


def _fills_the_frame(seen: Seen) -> None:
    """3857 times the width: the widest splat of a public scene."""
    assert seen.alpha.min() > 0.79
    assert seen.alpha.max() < 0.81


def _energy(seen: Seen) -> None:
    """An eighth of the resolution has 1/64 of the energy, to 1 %, if antialiased; else 0.3 px^2 more."""
    totals = {}
    for antialiased in (False, True):
        settings = replace(INRIA, antialiased=antialiased)
        full = seen.again(settings=settings)
        eighth = seen.again(settings=settings, camera=seen.drawing.camera.resized(15, 15))
        totals[antialiased] = full.alpha.sum(dtype=float) / eighth.alpha.sum(dtype=float)
    assert abs(totals[True] / 64 - 1) < 0.01
    assert abs(totals[False] / ((64 + 0.3) / (1 + 0.3)) - 1) < 0.01


def _sub_pixel(antialiased: bool) -> Drawing:
    small = random_gaussians(60, 10, scale_range=(0.001, 0.05))
    camera = random_camera(10, 240, 160).resized(30, 20)
    return Drawing(small, camera, replace(INRIA, antialiased=antialiased))


def _sizes(width: int, height: int) -> Case:
    return Case(
        f"an image of {width}x{height}",
        lambda: Drawing(random_gaussians(40, 9), random_camera(9, width, height)),
        lambda seen: None,
    )


def _plane_steps(**plane: float) -> Drawing:
    """Before, at and behind a plane whose distance float32 holds."""
    (at,) = (np.float32(distance) for distance in plane.values())
    steps = [np.nextafter(at, np.float32(0)), at, np.nextafter(at, np.float32(9))]
    return Drawing(balls(steps, 0.5, 0.01), settings=replace(INRIA, **plane))


def _logits() -> Drawing:
    values = np.tile([np.inf, -np.inf, 100.0, -100.0, 88.8, -88.8, 800.0, -800.0], 3)
    return altered("opacity_logits", np.s_[:], values)


CASES: tuple[Case, ...] = (
    *(_poisoned(field, poison) for field in _SLOTS for poison in _POISONS),
    Case("a zero quaternion", lambda: altered("quats_wxyz", ROW, 0), _as_without_the_row),
    *(_quaternions_of_length(factor) for factor in (2.0**-10, 2.0**10, 1e-3, 1e3)),
    *(
        Case(f"scale 0 on {axes} axes",
             lambda axes=axes: altered("log_scales", np.s_[:, :axes], -np.inf), draws_something)
        for axes in (1, 2, 3)
    ),
    Case("one point", lambda: Drawing(balls(3.0, 0.8, 0.0)), _dot_of_the_dilation),
    Case("scale e^40", lambda: Drawing(balls(3.0, 0.8, np.exp(40.0))), _fills_the_frame),
    Case("scale e^80", lambda: Drawing(balls(3.0, 0.8, np.exp(79.999))), _fills_the_frame),
    Case("scale e^120", lambda: altered("log_scales", ROW, 120.0), _as_without_the_row),
    Case("scale e^-30", lambda: altered("log_scales", np.s_[:], -30.0), draws_something),
    Case("needles 1 : 10^6", lambda: _needles(1e6, 1.0), draws_something),
    Case("needles 1 : 10^7", lambda: _needles(1e7, 1.0), draws_something),
    Case("needles longer than the world", lambda: _needles(1e9, 1e3), draws_something),
    *(
        Case(f"all scales e^{logs}", lambda logs=logs: altered("log_scales", np.s_[:], logs), draws_something)
        for logs in ((79, 79, 79), (-np.inf, 79, 79), (40, 0, -40), (7, -5, -6))
    ),
    Case("needles as wide as 3.7e-9",
         lambda: altered("log_scales", np.s_[:], np.log([0.4, 3.7e-9, 3.7e-9])), draws_something),
    Case("pancakes seen edge on", _pancakes_edge_on, draws_something),
    Case("logits of +-100, +-800 and +-inf", _logits, draws_something),
    Case("all logits -inf", lambda: altered("opacity_logits", np.s_[:], -np.inf), draws_nothing),
    Case("one opaque Gaussian", lambda: Drawing(balls(3.0, 1.0)), _no_more_than_the_cap),
    Case("alpha about 1/255",
         lambda: Drawing(balls([3.0] * 3, np.array([0.999, 1.0, 1.001]) / 255, 1e-6, x=[-0.5, -0.3, -0.1]),
                         camera=replace(AXIS, cx=10.5)), _thresholds),
    Case("a stack of opaque Gaussians",
         lambda: Drawing(balls(np.arange(2.0, 42.0), 1.0, 50.0)), _stack_stops),
    Case("at the camera's centre", lambda: Drawing(balls([0.0, 3.0], 0.5)), _only(1)),
    Case("behind the camera", lambda: Drawing(balls([-3.0, -0.2, 3.0], 0.5)), _only(2)),
    Case("one ulp about the near plane", lambda: _plane_steps(near=0.25), _only(2)),
    Case("straddling the near plane", lambda: Drawing(balls([0.19, 0.21], 0.5, 1.0)), _only(1)),
    Case("one ulp about the far plane", lambda: _plane_steps(far=2.5), _only(0, 1)),
    Case("straddling gsplat's near plane",
         lambda: Drawing(balls([0.009, 0.011], 0.5, 1.0), settings=GSPLAT), _only(1)),
    Case("far outside the field of view",
         lambda: Drawing(balls([1.0, 0.5, 2.0], 0.9, 1.5, x=[3.0, -2.0, 0.0], y=[0.0, 1.0, -8.0])),
         draws_something),
    Case("100000 Gaussians on one pixel", lambda: _crowded_pixel(100_000), _crowded_alpha, compare=False,
         only=("cpu", "opengl-half", "opengl-single")),
    Case("equal depths", lambda: Drawing(balls([3.0] * 3, [0.5, 0.6, 0.4])), _ties_by_index),
    Case("equal depths in every direction",
         lambda: replace(crowd(2), gaussians=random_gaussians(12, 2).take(np.r_[:12, 11:-1:-1])),
         draws_something),
    Case("another order of the rows", lambda: crowd(6), _permuted),
    *(_sizes(*size) for size in ((1, 1), (1, 37), (37, 1), (16, 16), (17, 33), (48, 32))),
    *(_crop_of(*crop) for crop in ((30, 17, 20, 11), (16, 16, 48, 24), (5, 5, 0, 0))),
    Case("seventy tiles",
         lambda: Drawing(random_gaussians(400, 19), random_camera(19, 150, 110)), draws_something),
    Case("no Gaussians", lambda: replace(crowd(), gaussians=random_gaussians(0)), draws_nothing),
    Case("all behind the camera", lambda: Drawing(balls([-1.0, -2.0, 0.0])), draws_nothing),
    Case("every row invalid", lambda: altered("means", np.s_[:], np.nan), draws_nothing),
    Case("float16 input", lambda: crowd(4), _in_half),
    Case("a million units from the origin", _far_away, _as_at_the_origin),
    *(_world_times(exponent) for exponent in (-20, 20)),
    Case("3857 times as wide as the image",
         lambda: Drawing(balls(3.0, 0.8, 3857 * 21 / 30.0 * 3.0)), _fills_the_frame),
    Case("sub-pixel Gaussians", lambda: _sub_pixel(False), draws_something),
    Case("sub-pixel Gaussians, antialiased", lambda: _sub_pixel(True), lambda seen: None),
    Case("energy at an eighth of the resolution",
         lambda: Drawing(balls(3.0, 0.9, 0.4, x=0.1), Camera(120, 120, 60.0, 60.0, 60.0, 60.0, np.eye(4))),
         _energy),
)  # fmt: skip
