"""Quantisation shared by the small scene formats, and the simplest of them: antimatter15's .splat.

A .splat is 32 bytes per Gaussian and nothing else:

    position   3 float32, world units, axes as in the PLY
    scale      3 float32, world units (not logarithms)
    colour     4 uint8: red, green, blue and opacity, as fractions of 255
    rotation   4 uint8: w x y z as (value - 128) / 128

Little endian, no header, no spherical harmonics beyond the base colour. Other writers sort the rows; here
their order is that of the language field. Source of the layout: antimatter15/splat; the code is our own.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np

from langsplat_core.arrays import Array, logit, sigmoid, unit
from langsplat_core.errors import InputError, Tell, malformed, report_loss
from langsplat_core.io.files import write_whole
from langsplat_core.io.hostile import open_for_reading
from langsplat_core.scene import Gaussians, Scene
from langsplat_core.scene.transform import C0

# Indices of the other components, by the index of the largest.
_OTHERS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])
# Axes in which each spherical harmonic is odd.
_ODD = ["", "y", "z", "x", "xy", "yz", "", "xz", "", "y", "xyz", "y", "z", "x", "z", "x"]


def to_bytes(values: Array, what: str = "") -> Array:
    """Return numbers (N, ...) rounded and clipped to uint8; reports how many rows of `what` that cuts."""
    cut = ((values < -2) | (values > 257)).any(axis=tuple(range(1, values.ndim)))  # by more than rounding
    if what and cut.any():
        report_loss("%s of %d of %d Gaussians are beyond it and are cut", what, cut.sum(), cut.size)
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


def check_steps(path: Path, gaussians: Gaussians, steps: Array) -> None:
    """Raise InputError if (N,) `steps` of positions, world units, are larger than most Gaussians."""
    if len(gaussians) == 0:
        return
    sizes = gaussians.log_scales.max(axis=1).astype(np.float64)  # logarithm of the longest axis
    with np.errstate(divide="ignore"):
        coarse = np.log(steps) > sizes
    if 2 * np.count_nonzero(coarse) > len(sizes):
        reach, size = float(np.abs(gaussians.means).max()), float(np.exp(np.median(sizes)))
        raise InputError(
            f"{path}: positions up to {reach:.3g} of Gaussians as small as {size:.3g} are beyond what "
            f"{path.suffix} tells apart; write .ply, or crop what lies far off"
        )


def smallest_three(three: Array, largest: Array, tell: Tell) -> Array:
    """Return (N, 4) unit quaternions from their (N, 3) components other than the largest.

    largest: (N,) index of the largest component, which is positive; tell: about others that are too long.
    """
    out = np.empty((len(three), 4))
    left = 1 - (three**2).sum(1)
    if longer := np.count_nonzero(left < -0.02):
        tell(f"{longer} rotations are no unit quaternions")
    np.put_along_axis(out, _OTHERS[largest], three, 1)
    np.put_along_axis(out, largest[:, None], np.sqrt(np.maximum(0, left))[:, None], 1)
    return out


def without_largest(quats: Array) -> tuple[Array, Array]:
    """Return (N, 3) components and (N,) index for `smallest_three` of (N, 4) quaternions of any length."""
    turns = unit(quats.astype(np.float64), 1e-30)
    largest = np.abs(turns).argmax(axis=1)
    turns *= np.where(np.take_along_axis(turns, largest[:, None], 1) < 0, -1, 1)
    return np.take_along_axis(turns, _OTHERS[largest], axis=1), largest


def mirrored(gaussians: Gaussians, signs: Array) -> Gaussians:
    """Return the Gaussians in axes that are reversed where (3,) `signs` is -1; other signs are 1."""
    x, y, z = signs = signs.astype(np.float32)
    odd = np.array([[axis in axes for axis in "xyz"] for axes in _ODD[: gaussians.sh.shape[1]]])
    with np.errstate(invalid="ignore"):
        return replace(
            gaussians,
            means=gaussians.means * signs,
            quats_wxyz=gaussians.quats_wxyz * np.array([1, y * z, x * z, x * y], np.float32),
            sh=gaussians.sh * np.where(odd, signs, 1).prod(axis=1)[:, None],
        )


# ---- .splat ----

_HUGE = 1e12  # world units, beyond any real scene
_RECORD = np.dtype([("position", "<f4", 3), ("scale", "<f4", 3), ("colour", "u1", 4), ("rotation", "u1", 4)])


def read_splat_scene(path: Path | str) -> Scene:
    """Return the Gaussians of a .splat file, of SH degree 0, as a scene.

    A file that is cut off between two Gaussians cannot be recognised. FormatError if it is no .splat.
    """
    path = Path(path)
    file, size = open_for_reading(path)
    with file:
        if size == 0 or size % _RECORD.itemsize:
            what = f"{size} bytes are not a whole number of Gaussians of {_RECORD.itemsize}"
            raise malformed(path, what, "it is truncated or no .splat: copy it again")
        rows = np.frombuffer(file.read(size), _RECORD)
    # The only check against other files, whose floats are often negative, not finite or huge.
    with np.errstate(invalid="ignore", divide="ignore"):
        sound = (np.abs(rows["position"]) < _HUGE).all(1) & (rows["scale"] >= 0).all(1)
        sound &= (rows["scale"] < _HUGE).all(1)
        log_scales = np.log(rows["scale"])  # -infinity of 0, a flat axis; NaN where negative: not drawn
    if sound.mean() < 0.9:
        raise malformed(path, f"not a .splat: {(~sound).sum()} of {len(rows)} rows are no Gaussians")
    colours = rows["colour"] / 255
    gaussians = Gaussians(
        means=rows["position"],
        log_scales=log_scales,
        quats_wxyz=(rows["rotation"].astype(np.float32) - 128) / 128,
        opacity_logits=logit(colours[:, 3]),
        sh=((colours[:, :3] - 0.5) / C0)[:, None],
    )
    return Scene(gaussians)


def write_splat(path: Path | str, scene: Scene) -> None:
    """Write the Gaussians in their order, atomically, without their view dependence.

    Colours and opacities are rounded to 1/255 (colours are cut to 0..1, and reported), rotations to 1/128 per
    component; positions and scales stay exact. A row that cannot be drawn is written with opacity 0.
    """
    gaussians, valid = scene.gaussians, scene.gaussians.valid()
    if len(gaussians) == 0:
        raise InputError(f"{path}: a .splat without Gaussians would be an empty file; write .ply")
    drawn = gaussians.take(valid)
    largest = np.maximum(np.abs(drawn.means).max(1), np.exp(drawn.log_scales.max(1)))
    if (largest >= _HUGE).any():
        raise InputError(f"{path}: a reader takes numbers from {_HUGE:g} on for damage; write .ply")
    rows = np.zeros(len(gaussians), _RECORD)
    rows["position"][valid] = drawn.means
    rows["scale"][valid] = np.exp(drawn.log_scales)
    colours = 0.5 + C0 * drawn.sh[:, 0].astype(np.float64)
    rows["colour"][valid, :3] = to_bytes(colours * 255, ".splat: the colours")
    rows["colour"][valid, 3] = to_bytes(sigmoid(drawn.opacity_logits) * 255)
    rows["rotation"][valid] = to_bytes(unit(drawn.quats_wxyz.astype(np.float64)) * 128 + 128)
    write_whole(path, rows.tobytes())
