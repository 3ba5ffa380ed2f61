"""What the table of hard cases is built from: a drawing, and what a rasterizer made of it."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from langsplat_core.arrays import Array, logit
from langsplat_core.config import INRIA, RasterSettings
from langsplat_core.scene import Camera, Gaussians
from tests.support.backends import Backend
from tests.support.scenes import random_camera, random_gaussians, random_values

AXIS = Camera(21, 21, 30.0, 30.0, 10.5, 10.5, np.eye(4))  # at the origin, looks along z; (10, 10) on the axis


@dataclass(frozen=True, eq=False)
class Drawing:
    """The input of a rasterizer."""

    gaussians: Gaussians
    camera: Camera = AXIS
    settings: RasterSettings = INRIA
    values: Array | None = None  # (N, C); random ones if None

    def features(self) -> Array:
        """(N, C) values to splat."""
        return random_values(len(self.gaussians), 3) if self.values is None else self.values


@dataclass(frozen=True, eq=False)
class Seen:
    """The output of a rasterizer."""

    backend: Backend
    drawing: Drawing
    view: Any
    image: Array
    alpha: Array

    def again(self, **changes: Any) -> "Seen":
        """The same backend's output for the same drawing with some fields changed."""
        return draw(self.backend, replace(self.drawing, **changes))

    def with_rows(self, **fields: Array) -> "Seen":
        """The same backend's output with some arrays of the Gaussians changed."""
        return self.again(gaussians=replace(self.drawing.gaussians, **fields))


Check = Callable[[Seen], None]


@dataclass(frozen=True)
class Case:
    """One row of the table."""

    name: str
    expect: str  # what must happen, as a sentence
    build: Callable[[], Drawing]
    check: Check  # the sentence as a test
    dropped: int = 0  # invalid rows
    compare: bool = True  # with the reference; False where the reference would take too long
    only: tuple[str, ...] = ()  # backends; all if empty


def draw(backend: Backend, drawing: Drawing) -> Seen:
    """Render."""
    view = backend.raster.view(drawing.gaussians, drawing.camera, drawing.settings)
    return Seen(backend, drawing, view, *view.splat(drawing.features()))


def crowd(seed: int = 0, n: int = 24, sh_degree: int = 0, **options: Any) -> Drawing:
    """Some ordinary Gaussians before an ordinary camera with everything off centre."""
    return Drawing(random_gaussians(n, seed, sh_degree, **options), random_camera(seed, 40, 27))


def altered(field: str, rows: Any, value: Any, **options: Any) -> Drawing:
    """A crowd in which `field`[rows] is `value`."""
    drawing = crowd(**options)
    array = getattr(drawing.gaussians, field).copy()
    array[rows] = value
    return replace(drawing, gaussians=replace(drawing.gaussians, **{field: array}))


def balls(
    z: Any, opacity: Any = 0.8, scale: Any = 0.2, x: Any = 0.0, y: Any = 0.0, quat: Any = (1.0, 0, 0, 0)
) -> Gaussians:
    """Gaussians at (x, y, z), each argument one number for all or one per Gaussian; a scale may be
    (N, 3)."""
    z = np.atleast_1d(np.asarray(z, np.float64))
    n = len(z)
    scales = np.broadcast_to(
        np.reshape(scale, (-1, np.shape(scale)[-1] if np.ndim(scale) > 1 else 1)), (n, 3)
    )
    with np.errstate(divide="ignore"):
        return Gaussians(
            np.stack([np.broadcast_to(x, n), np.broadcast_to(y, n), z], -1),
            np.log(scales),
            np.broadcast_to(np.asarray(quat, np.float64), (n, 4)),
            logit(np.broadcast_to(np.asarray(opacity, np.float64), n)),
            np.zeros((n, 1, 3)),
        )


def identical(seen: Seen, other: Seen) -> None:
    """Bit for bit."""
    assert np.array_equal(seen.image, other.image)
    assert np.array_equal(seen.alpha, other.alpha)


def close(seen: Seen, other: Seen, atol: float) -> None:
    """Image and alpha within `atol`; half floats within their own error."""
    atol = max(atol, 1e-3 if seen.backend.name == "opengl-half" else 0)
    np.testing.assert_allclose(seen.image, other.image, atol=atol)
    np.testing.assert_allclose(seen.alpha, other.alpha, atol=atol)


def draws_nothing(seen: Seen) -> None:
    """An empty picture."""
    assert not seen.image.any()
    assert not seen.alpha.any()


def draws_something(seen: Seen) -> None:
    """Not an empty picture."""
    assert seen.alpha.max() > 0.1
