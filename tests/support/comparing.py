"""Comparisons: of a fast rasterizer with the reference, of gradients, bit for bit of scenes; and refusals.

Image formation has steps: an alpha of just 1/255 counts or does not, a transmittance of just 1e-4 stops a
pixel or does not. Pixels where rounding may decide are the *band*: a counted allowance of them may differ.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from operator import attrgetter
from pathlib import Path

import numpy as np
import pytest

from langsplat_core.arrays import Array
from langsplat_core.config import RasterSettings
from langsplat_core.errors import FormatError
from langsplat_core.raster.reference import Footprints, ReferenceView, project
from langsplat_core.scene import Camera, Gaussians, LanguageField, Tree

BAND = 1e-4  # relative distance to a cut-off; float32 kernels are within about 1e-6 of it


def assert_close_off_cuts(got: Array, want: Array, band: Array, atol: float = 2e-5) -> None:
    """`got` equals `want` within `atol` outside the band; in the band at most half the pixels are off.

    The band must be small (under 2 % of the pixels), or the comparison would say little.
    """
    assert got.shape == want.shape
    assert np.isfinite(got).all()
    error = np.abs(got - want).reshape(*band.shape, -1).max(-1)
    assert band.mean() < 0.02, f"{band.sum()} of {band.size} pixels lie at a cut-off: change the scene"
    worst = float(error[~band].max(initial=0))
    assert worst <= atol, f"off by {worst:.2e} in {(error[~band] > atol).sum()} pixels away from cut-offs"
    flipped = error[band] > atol
    assert flipped.sum() <= max(0.5 * band.sum(), 1), f"{flipped.sum()} of {band.sum()} band pixels flipped"


def assert_adjoint(
    splat: Callable[[Array], Array], gather: Callable[[Array], Array], x: Array, y: Array, rtol: float = 1e-5
) -> None:
    """<W x, y> = <x, W^T y>, relative to |W x| |y|."""
    image = splat(x).astype(np.float64)
    left, right = np.vdot(image, y), np.vdot(x.astype(np.float64), gather(y))
    scale = np.linalg.norm(image) * np.linalg.norm(y)
    assert abs(left - right) <= rtol * scale, f"{left} against {right}, scale {scale}"


def assert_gradient(
    name: str, got: Array, want: Array, rtol: float = 1e-3, largest: float | None = None
) -> None:
    """Equal within `rtol` of each entry, plus 1e-5 of the largest one for float32 sums."""
    allowed = rtol * np.abs(want) + 1e-5 * (np.abs(want).max() if largest is None else largest)
    off = np.abs(got - want) > allowed
    assert not off.any(), f"{name}: {off.sum()} of {off.size} off, worst {np.abs(got - want).max():.2e}"


TREE = ("leaves", "parents", "levels", "votes")
FIELDS = ("means", "log_scales", "quats_wxyz", "opacity_logits", "sh")


def assert_same(got: Gaussians, want: Gaussians) -> None:
    """Bit for bit, NaN included."""
    for field in FIELDS:
        a, b = getattr(got, field), getattr(want, field)
        assert a.dtype == np.float32
        np.testing.assert_array_equal(a.view(np.uint32), b.view(np.uint32), field)


def assert_same_extras(got: Mapping[str, Array], want: Mapping[str, Array]) -> None:
    """Named arrays, in this order."""
    assert list(got) == list(want)
    for name, values in want.items():
        assert got[name].dtype == values.dtype
        np.testing.assert_array_equal(got[name], values, name)


def assert_same_tree(got: Tree, want: Tree) -> None:
    """Node by node."""
    assert_same_extras(_arrays(got, TREE), _arrays(want, TREE))


def assert_same_field(got: LanguageField, want: LanguageField) -> None:
    """Bit for bit: a saved scene must answer exactly like the one in memory."""
    for name in ("encoder_id", "temperature", "found", "calibration", "codec.kind"):
        assert attrgetter(name)(got) == attrgetter(name)(want)
    for part in (_parts, lambda field: field.codec.tensors(), lambda field: field.phrasebook):
        assert_same_extras(part(got), part(want))


def _parts(field: LanguageField) -> dict[str, Array]:
    found = _arrays(field, ("latents", "confidence", "canonical"))
    found |= {} if field.tree is None else _arrays(field.tree, TREE)
    found |= {} if field.everyday is None else {"everyday": field.everyday}
    for word in field.taught:
        found |= _arrays(word, ("vectors", "rivals"), f"{word.name} {word.level} ")
    return found


def _arrays(owner: object, names: Sequence[str], prefix: str = "") -> dict[str, Array]:
    return {prefix + name: getattr(owner, name) for name in names}


def assert_refused(read: Callable[[Path], object], path: Path) -> None:
    """A FormatError of one short printable line that begins with the path and ends with a remedy."""
    with pytest.raises(FormatError) as caught:
        read(path)
    said = str(caught.value)
    assert said.startswith(str(path))
    assert said.isprintable()
    assert "; " in said
    assert len(said) < len(str(path)) + 200  # whatever a library adds


# Gradients of the float64 reference by central differences: what backward passes are compared with.


PARAMETERS = ("means", "log_scales", "quats_wxyz", "opacity_logits")
STEP = 1e-6  # in every parameter's own unit


@dataclass(frozen=True, eq=False)
class Exact:
    """Gaussians in float64, as the reference reads them; all rows valid."""

    means: Array
    log_scales: Array
    quats_wxyz: Array
    opacity_logits: Array

    def __len__(self) -> int:
        return len(self.means)

    def valid(self) -> Array:
        return np.ones(len(self), bool)


def reference_gradients(
    gaussians: Gaussians,
    camera: Camera,
    settings: RasterSettings,
    values: Array,
    image_grad: Array,
    alpha_grad: Array,
    rows: Array | None = None,
) -> dict[str, Array]:
    """Gradients of <image, image_grad> + <alpha, alpha_grad> by the parameters, values and pixel means of the
    Gaussians at `rows`, by default of all.

    Pixels at a cut-off must carry no loss: there the image jumps.
    """
    rows = np.arange(len(gaussians)) if rows is None else rows
    exact = Exact(*(getattr(gaussians, name).astype(np.float64) for name in PARAMETERS))

    def loss(footprints: Footprints) -> float:
        image, alpha = ReferenceView(footprints, camera, settings, 0).splat(values)
        return float((image * image_grad).sum() + (alpha * alpha_grad).sum())

    def moved(array: Array, place: tuple[int, ...], step: float) -> Array:
        array = array.copy()
        array[place] += step
        return array

    footprints, found = project(exact, camera, settings), {}  # type: ignore[arg-type]
    for name in PARAMETERS:
        whole = getattr(exact, name)
        grad = found[name] = np.empty((len(rows), *whole.shape[1:]))
        for place in np.ndindex(grad.shape):
            at = (int(rows[place[0]]), *place[1:])
            ends = [replace(exact, **{name: moved(whole, at, step)}) for step in (STEP, -STEP)]
            high, low = (loss(project(end, camera, settings)) for end in ends)  # type: ignore[arg-type]
            grad[place] = (high - low) / (2 * STEP)
    grad = found["means_px"] = np.empty((len(rows), 2))
    for place in np.ndindex(grad.shape):
        at = (int(rows[place[0]]), place[1])
        ends_px = [moved(footprints.means_px, at, step) for step in (STEP, -STEP)]
        high, low = (loss(replace(footprints, means_px=end)) for end in ends_px)
        grad[place] = (high - low) / (2 * STEP)
    found["values"] = ReferenceView(footprints, camera, settings, 0).gather(image_grad)[rows]  # linear
    return found
