"""The .splat file of antimatter15's viewer: 32 bytes per Gaussian and nothing else.

    position   3 float32, world units, axes as in the PLY
    scale      3 float32, world units (not logarithms)
    colour     4 uint8: red, green, blue and opacity, as fractions of 255
    rotation   4 uint8: w x y z as (value - 128) / 128

Little endian, no header, no spherical harmonics beyond the base colour. Writers in the wild order the rows
by size times opacity, so that a viewer can show the first part; here the order is kept, because the
language field goes by rows. Source of the layout: antimatter15/splat; the code here is our own.
"""

from pathlib import Path

import numpy as np

from langsplat_core.arrays import Array, logit, sigmoid, unit
from langsplat_core.errors import FormatError
from langsplat_core.files import atomic_path
from langsplat_core.formats.inria_layout import SH_C0
from langsplat_core.parsing.opening import open_for_reading
from langsplat_core.scene import Gaussians

HUGE = 1e12  # world units that no Gaussian of a real scene has
_RECORD = np.dtype([("position", "<f4", 3), ("scale", "<f4", 3), ("colour", "u1", 4), ("rotation", "u1", 4)])


def read_splat(path: Path | str) -> Gaussians:
    """The Gaussians of a .splat file, of SH degree 0.

    A file cut off between two Gaussians cannot be told from a whole one. Raises InputError when the file
    cannot be opened and FormatError when it is no such file.
    """
    path = Path(path)
    file, size = open_for_reading(path)
    with file:
        if size == 0 or size % _RECORD.itemsize:
            raise FormatError(
                f"{path}: {size} bytes are not a whole number of Gaussians of {_RECORD.itemsize}; the file "
                "is truncated or not a .splat"
            )
        rows = np.frombuffer(file.read(size), _RECORD)
    # Nothing else in the file tells it from noise, whose floats are negative, not finite or enormous.
    with np.errstate(invalid="ignore"):
        sound = (np.abs(rows["position"]) < HUGE).all(1) & (rows["scale"] >= 0).all(1)
        sound &= (rows["scale"] < HUGE).all(1)
    if sound.mean() < 0.9:
        raise FormatError(f"{path}: not a .splat: {(~sound).sum()} of {len(rows)} rows are no Gaussians")
    return Gaussians(
        means=rows["position"],
        log_scales=log_of_scales(rows["scale"]),
        quats_wxyz=(rows["rotation"].astype(np.float32) - 128) / 128,
        opacity_logits=logit(rows["colour"][:, 3] / 255),
        sh=base_of_colours(rows["colour"])[:, None],
    )


def write_splat(path: Path | str, gaussians: Gaussians) -> None:
    """Write the Gaussians in their order, atomically, without their view dependence.

    Colours and opacities are rounded to 1/255 (colours beyond 0..1 are cut off), rotations to 1/128 per
    component; positions and scales stay exact. A row that cannot be drawn is written with opacity 0.
    """
    valid = gaussians.valid()
    drawn = gaussians.take(valid)
    rows = np.zeros(len(gaussians), _RECORD)
    rows["position"][valid] = drawn.means
    rows["scale"][valid] = np.exp(drawn.log_scales)
    rows["colour"][valid, :3] = to_bytes((0.5 + SH_C0 * drawn.sh[:, 0]) * 255)
    rows["colour"][valid, 3] = to_bytes(sigmoid(drawn.opacity_logits) * 255)
    rows["rotation"][valid] = to_bytes(unit(drawn.quats_wxyz.astype(np.float64)) * 128 + 128)
    with atomic_path(path) as temporary:
        temporary.write_bytes(rows.tobytes())


def base_of_colours(rgba: Array) -> Array:
    """(N, 4) uint8 -> (N, 3) coefficients f_dc."""
    return (rgba[:, :3] / 255 - 0.5) / SH_C0


def log_of_scales(scales: Array) -> Array:
    """0 becomes -infinity, a flat axis; a negative scale NaN, a row that is dropped later."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.log(scales)


def to_bytes(values: Array) -> Array:
    """Rounded and clipped to uint8."""
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)
